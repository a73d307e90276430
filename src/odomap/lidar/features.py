"""Features of a sweep, and the local map they are laid onto: what LOAM and LeGO-LOAM share.

    sweep  →  edges and planes, each at its own moment      (`featurepicking`)
           →  all at the stamp, by the motion over the sweep  p' = exp(ξ t) p
           →  onto edges and planes of the map                 (`featurematching`)

Few features are matched, many are added to the map: all points of planes serve its planes. Where a
line's points are so far apart that it says nothing of most of them, as that of a sparse solid-state
LiDAR, these are taken for planes, too: whether they are, the map's voxels tell.

Where the prediction may be poor, since the map is young or far less fits than did before, the sweep
is first laid onto the sweep before (`registration`), which finds its way from a metre off, and then
onto the map once more; of two matches the one counts on which more features lie.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.lidar.deskew import deskew
from odomap.lidar.featureconfig import FeatureMapConfig
from odomap.lidar.featuremap import VoxelShapes
from odomap.lidar.featurematching import (
    EDGES,
    GROUND,
    PLANES,
    FeatureStage,
    match_features,
)
from odomap.lidar.featurepicking import EDGE, FLAT, PLANE
from odomap.lidar.frontend import SweepMatch
from odomap.lidar.registration import RegistrationConfig, register
from odomap.lidar.scanlines import ScanLines
from odomap.lidar.sweeps import SweepPoints

__all__ = ["FeatureSweep", "LocalFeatures", "features_of", "suitable_voxel"]

Array = NDArray[np.float64]
Marks = NDArray[np.uint8]

MOVED = 0.1
"""Share of the radius that the sensor moves before what is far is forgotten."""
YOUNG = 2
"""Sweeps in the map up to which a prediction is poor."""
UNSURE = 10.0
"""How many times more is off by then: surfaces that few rings have crossed are known badly."""
POOR = 0.6
"""Share of the features that fit, of what it was before, below which the prediction was poor."""
COARSE = 1.25
"""Voxel in which sweeps are laid onto one another, in voxels of planes."""
MANY = 8000
"""Points of planes from which on a sweep is dense."""
FEWEST = 20
"""Points of a sweep that can be laid onto another."""


@dataclass(frozen=True, eq=False)
class FeatureSweep:
    """Features of a sweep.

    Attributes:
        points: (N, 3) edges and planes to be matched, in the body at the moment of each.
        times: (N,) seconds since the stamp.
        kinds: (N,) EDGES, PLANES or GROUND.
        flat: (M, 3) points of planes for the map. flat_times: (M,).
        marks: (K,) of all points of the sweep: 0, FLAT, PLANE or EDGE (`featurepicking`).
        ground: (K,) which of them lie on the ground, as far as it was looked for.
    """

    points: Array
    times: Array
    kinds: Marks
    flat: Array
    flat_times: Array
    marks: Marks
    ground: NDArray[np.bool_]


def features_of(
    sweep: SweepPoints, lines: ScanLines, marks: Marks, ground: NDArray[np.bool_],
    unknown: NDArray[np.bool_], wanted: int,
) -> FeatureSweep:  # fmt: skip
    """Return the features of a sweep.

    Args:
        sweep: its points.
        lines: them in order.
        marks: (N,) of points in the order of lines. ground: (N,) which lie on it.
        unknown: (N,) of which their line says nothing.
        wanted: planes that are filled up with those where there are fewer.
    """
    is_plane = marks == PLANE
    loose = np.flatnonzero(unknown & (marks == 0))
    lacking = wanted - int(np.count_nonzero(is_plane))
    is_flat = (marks == FLAT) | is_plane
    if lacking > 0:
        is_flat[loose] = True
        is_plane[loose[:: max(-(-len(loose) // lacking), 1)]] = True
    rows = np.flatnonzero((marks == EDGE) | is_plane)
    kinds = np.where(marks[rows] == EDGE, EDGES, np.where(ground[rows], GROUND, PLANES))
    order, flat = lines.order[rows], lines.order[is_flat]
    all_marks, all_ground = np.empty_like(marks), np.empty_like(ground)
    all_marks[lines.order], all_ground[lines.order] = marks, ground
    return FeatureSweep(
        sweep.points.take(order, axis=0), sweep.times[order], kinds.astype(np.uint8),
        sweep.points.take(flat, axis=0), sweep.times[flat], all_marks, all_ground,
    )  # fmt: skip


class LocalFeatures:
    """Edges and planes around the sensor.

    Args:
        config: how they are kept.
    """

    def __init__(self, config: FeatureMapConfig) -> None:
        self._config = config
        self._resize(config.voxel or config.most_voxel)
        self.clear()

    def _resize(self, voxel: float) -> None:
        """Begin maps with voxels of a size."""
        size, most = self._config.thickness, self._config.most
        self._voxel = voxel
        self.planes = VoxelShapes(voxel, False, size, most)
        self.edges = VoxelShapes(self._config.edge_share * voxel, True, size, most)

    def clear(self) -> None:
        """Forget all."""
        self.planes.clear()
        self.edges.clear()
        self._centre, self._age, self._share = np.full(3, np.inf), 0, 0.0
        self._last, self._T_map_last = np.empty((0, 3)), np.eye(4)
        self._first: tuple[FeatureSweep, Array] | None = None

    def match(
        self,
        prepared: FeatureSweep,
        T_map_body: Array,
        twist: Array,
        stages: tuple[FeatureStage, ...],
        again: bool,
    ) -> SweepMatch:
        """Find where a sweep was taken; arguments as those of a front-end, and the stages.

        Of these a sweep that is matched again needs the last alone.
        """
        self._lay_first(twist)
        points = deskew(prepared.points, prepared.times, twist)
        rest = points, prepared.kinds, self.planes, self.edges
        common = UNSURE if self._age <= YOUNG else 1.0
        found = match_features(*rest, T_map_body, stages[-1:] if again else stages, common)
        if not again and (self._age <= YOUNG or found.share < POOR * self._share):
            guess = self._from_last(prepared, points, T_map_body, twist)
            other = found if guess is None else match_features(*rest, guess, stages, common)
            is_young = self._age <= YOUNG and other.converged
            found = other if is_young or other.num_inliers > found.num_inliers else found
        self._share = found.share
        return found

    def _from_last(
        self, prepared: FeatureSweep, points: Array, T_map_body: Array, twist: Array
    ) -> Array | None:
        """Return where a sweep is as seen from the one before; None where that says nothing."""
        flat = deskew(prepared.flat, prepared.flat_times, twist)
        cloud = np.concatenate([points, flat])
        if min(len(cloud), len(self._last)) < FEWEST:
            return None
        T_last_guess = np.linalg.inv(self._T_map_last) @ T_map_body
        config = RegistrationConfig(method="gicp", voxel=COARSE * self._voxel)
        found = register(cloud, self._last, config=config, initial=T_last_guess)
        return np.asarray(self._T_map_last @ found.T_target_source) if found.converged else None

    def insert(self, prepared: FeatureSweep, T_map_body: Array, twist: Array) -> None:
        """Add the features of a sweep, and forget what is far from it."""
        if self._age == 0 and not self._config.voxel and len(prepared.flat):
            self._resize(suitable_voxel(prepared.flat, self._config))
        self._lay_first(twist)
        self._last = self._add(prepared, T_map_body, twist)
        self._first = (prepared, T_map_body) if self._age == 0 else None
        self._T_map_last = T_map_body.copy()
        self._age += 1
        if not np.linalg.norm(T_map_body[:3, 3] - self._centre) < MOVED * self._config.radius:
            self._centre = T_map_body[:3, 3].copy()
            self.edges.forget(self._centre, self._config.radius)
            self.planes.forget(self._centre, self._config.radius)

    def seed(self, points: Array) -> None:
        """Add points (N, 3) of another map, of which nobody says what they are, to the planes."""
        self.planes.insert(np.ascontiguousarray(points))
        self._age, self._first = max(self._age, YOUNG + 1), None

    def _lay_first(self, twist: Array) -> None:
        """Add the first sweep again, as long as it is alone, by how the body moves.

        That was not known before there was a second.
        """
        if self._age == 1 and self._first is not None:
            self.planes.clear()
            self.edges.clear()
            self._last = self._add(*self._first, twist)

    def _add(self, prepared: FeatureSweep, T_map_body: Array, twist: Array) -> Array:
        """Add the features of a sweep; return them as of one instant, in the body."""
        is_edge = prepared.kinds == EDGES
        edges = deskew(prepared.points[is_edge], prepared.times[is_edge], twist)
        flat = deskew(prepared.flat, prepared.flat_times, twist)
        R, t = T_map_body[:3, :3], T_map_body[:3, 3]
        self.edges.insert(edges @ R.T + t)
        some = deskew(prepared.points[~is_edge], prepared.times[~is_edge], twist)
        self.planes.insert(flat @ R.T + t, some @ R.T + t)
        return np.concatenate([edges, flat])


def suitable_voxel(points: Array, config: FeatureMapConfig) -> float:
    """Return a voxel for a place: a share of how far half of what is seen is away.

    Where points are few it is larger, up to twice, so that as many as else are in one.
    """
    away = float(np.median(np.linalg.norm(points, axis=1)))
    voxel = float(np.clip(config.voxel_share * away, config.least_voxel, config.most_voxel))
    return voxel * float(np.clip(np.sqrt(MANY / len(points)), 1.0, 2.0))
