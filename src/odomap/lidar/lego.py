"""LeGO-LOAM: odometry from the ground, and from edges and planes of things that stand on it.

The sweep is sorted into an image, in which ground and things are told apart and small things, such
as leaves, dropped (`rangeimage`). Edges are taken from things alone, planes from things and the
ground (`curvature`). Then, in two steps and as LeGO-LOAM has it,

    z, roll, pitch   from planes of the ground, which say hardly anything else
    x, y, yaw        from edges, with those held

which takes less time than all six at once, and starts the third, all from all on the local map.

Cost: 20 ms a sweep of 64 beams, 4 ms of 16.

Reference: T. Shan, B. Englot, "LeGO-LOAM: lightweight and ground-optimized lidar odometry and
mapping on variable terrain", IROS 2018.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.lidar.curvature import CUT, curvatures
from odomap.lidar.featureconfig import LegoConfig
from odomap.lidar.featurematching import EDGES, GROUND, FeatureStage
from odomap.lidar.featurepicking import pick
from odomap.lidar.features import FeatureSweep, LocalFeatures, features_of
from odomap.lidar.frontend import SweepMatch
from odomap.lidar.rangeimage import find_clusters, find_ground, range_image
from odomap.lidar.scanlines import scan_lines
from odomap.lidar.sweeps import SweepPoints

__all__ = ["LegoFrontEnd"]

Array = NDArray[np.float64]

NEAR = 0.6
"""Farthest that a feature may be from the middle of what it lies on in the end, in voxels."""

LEVEL, UPRIGHT = 1 | 2 | 32, 4 | 8 | 16
"""What is held of (x, y, z, roll, pitch, yaw): in the step from the ground, in that from edges."""
STEPS = 3
"""Of each of the two."""


class LegoFrontEnd:
    """Lays ground, edges and planes of sweeps onto those before.

    Args:
        config: how.
        T_body_lidar: (4, 4) where the LiDAR is; default: it is the body, whose z is up.
    """

    def __init__(self, config: LegoConfig | None = None, T_body_lidar: Array | None = None) -> None:
        self._config = config or LegoConfig()
        self._T_body_lidar = np.eye(4) if T_body_lidar is None else np.array(T_body_lidar, float)
        self._map = LocalFeatures(self._config.map)

    def prepare(self, sweep: SweepPoints) -> FeatureSweep:
        """Find ground and things, and edges and planes of them."""
        config = self._config
        lines = scan_lines(sweep, self._T_body_lidar)
        image = range_image(lines, self._T_body_lidar[:3, :3])
        rules = config.ground
        ground = find_ground(image, rules.slope)
        things = find_clusters(image, ground, rules.same, rules.smallest, rules.narrow)
        is_ground, is_thing = image.spread(ground), image.spread(things >= 0)
        may = np.where(is_thing, 3, np.where(is_ground, 1, 0)).astype(np.uint8)
        c, reach = curvatures(lines, config.curvature)
        marks = pick(lines, c, reach, may, config.curvature)
        unknown = (c == CUT) & (may > 0)
        return features_of(sweep, lines, marks, is_ground, unknown, config.curvature.least_planes)

    def match(
        self, prepared: FeatureSweep, T_map_body: Array, twist: Array, again: bool = False
    ) -> SweepMatch:
        """Find where a sweep was taken; see `frontend`."""
        limits = self._config.map
        stages = (
            FeatureStage(GROUND, LEVEL, limits.reach, STEPS),
            FeatureStage(EDGES, UPRIGHT, limits.reach, STEPS),
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
