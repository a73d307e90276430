"""LOAM: odometry from edges and planes of scan lines.

Points where a line bends sharply are edges, those where it hardly bends lie in planes
(`curvature`). Edges are laid onto edges of the map and planes onto planes of the map
(`featurematching`), both kept by voxel (`featuremap`). LOAM matches to the sweep before at the rate
of the sensor, and to the map less often; a voxel's fit costs so little to look up that each sweep
is laid onto the map at once. Where the map is one sweep old, that is the same thing.

First all from wherever the prediction left them, with a wide reach and a soft loss; then again with
what is near.

Cost: 12 ms a sweep of 64 beams, 2 ms of 16.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.lidar.curvature import CUT, curvatures
from odomap.lidar.featureconfig import LoamConfig
from odomap.lidar.featurematching import FeatureStage
from odomap.lidar.featurepicking import pick
from odomap.lidar.features import FeatureSweep, LocalFeatures, features_of
from odomap.lidar.frontend import SweepMatch
from odomap.lidar.scanlines import scan_lines
from odomap.lidar.sweeps import SweepPoints

__all__ = ["LoamFrontEnd"]

Array = NDArray[np.float64]

NEAR = 0.6
"""Farthest that a feature may be from the middle of what it lies on in the end, in voxels."""


class LoamFrontEnd:
    """Lays edges and planes of sweeps onto those before.

    Args:
        config: how.
        T_body_lidar: (4, 4) where the LiDAR is; default: it is the body.
    """

    def __init__(self, config: LoamConfig | None = None, T_body_lidar: Array | None = None) -> None:
        self._config = config or LoamConfig()
        self._T_body_lidar = np.eye(4) if T_body_lidar is None else np.array(T_body_lidar, float)
        self._map = LocalFeatures(self._config.map)

    def prepare(self, sweep: SweepPoints) -> FeatureSweep:
        """Find edges and planes."""
        lines = scan_lines(sweep, self._T_body_lidar)
        rules = self._config.curvature
        c, reach = curvatures(lines, rules)
        marks = pick(lines, c, reach, np.full(len(c), 3, np.uint8), rules)
        ground = np.zeros(len(c), np.bool_)
        return features_of(sweep, lines, marks, ground, c == CUT, rules.least_planes)

    def match(
        self, prepared: FeatureSweep, T_map_body: Array, twist: Array, again: bool = False
    ) -> SweepMatch:
        """Find where a sweep was taken; see `frontend`."""
        limits = self._config.map
        stages = (
            FeatureStage(reach=limits.reach, iterations=4),
            FeatureStage(reach=NEAR, iterations=limits.iterations),
        )
        return self._map.match(prepared, T_map_body, twist, stages, again)

    def insert(self, prepared: FeatureSweep, T_map_body: Array, twist: Array) -> None:
        """Add a sweep to the map, and forget what is far from it."""
        self._map.insert(prepared, T_map_body, twist)

    def seed(self, points: Array) -> None:
        """Add points (N, 3) of another map, in the frame of this one."""
        self._map.seed(points)

    def clear(self) -> None:
        """Forget the map."""
        self._map.clear()
