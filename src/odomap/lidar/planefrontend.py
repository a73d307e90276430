"""The front-end "points": sweeps laid onto surfaces, with nothing told apart beforehand.

    sweep → the first point of each small voxel, to be added → of each large one, to be matched
    match: deskewed by the motion so far, Gauss–Newton onto surfaces (`planematching`)

How far the guess may be off is learned from how far it was: its deviations from what was found,
as far as they move points at the largest range, are averaged, and three times that is how wide the
search begins.

Reference: I. Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 8(2), 2023 (thinning
and threshold); K. Koide et al., "Voxelized GICP for fast and accurate 3D point cloud registration",
ICRA 2021.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse, se3_log
from odomap.lidar.cloudconfig import PointsConfig
from odomap.lidar.degeneracy import named
from odomap.lidar.deskew import deskew
from odomap.lidar.frontend import SweepMatch
from odomap.lidar.planemap import PlaneMap
from odomap.lidar.planematching import PlaneMatch, lying, match_planes
from odomap.lidar.sweeps import SweepPoints
from odomap.lidar.voxels import first_in_voxels

__all__ = ["PlaneFrontEnd", "ThinSweep"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ThinSweep:
    """A sweep thinned out: points (N, 3) to be added, times (N,), and rows to be matched."""

    points: Array
    times: Array
    matched: Index


class PlaneFrontEnd:
    """Lays sweeps onto surfaces.

    Args:
        config: sizes; a voxel of 0 is chosen at the first sweep, by how far it sees.
    """

    def __init__(self, config: PointsConfig | None = None) -> None:
        self._config = PointsConfig() if config is None else config
        self._voxel = self._config.voxel
        self._map: PlaneMap | None = None
        self._off2 = self._config.first_off**2

    def prepare(self, sweep: SweepPoints) -> ThinSweep:
        """Thin a sweep out."""
        config = self._config
        if not self._voxel and len(sweep):
            self._voxel = suitable_voxel(sweep.points, config)
        voxel = self._voxel or 1.0
        rows = first_in_voxels(sweep.points, config.added * voxel)
        points, times = sweep.points.take(rows, axis=0), sweep.times[rows]
        return ThinSweep(points, times, first_in_voxels(points, config.matched * voxel))

    def match(
        self, prepared: ThinSweep, T_map_body: Array, twist: Array, again: bool = False
    ) -> SweepMatch:
        """Find where a sweep was taken; see `frontend`."""
        rows = prepared.matched
        points = deskew(prepared.points.take(rows, axis=0), prepared.times[rows], twist)
        if self._map is None or len(points) == 0:
            return SweepMatch(T_map_body, np.zeros((6, 6)), 0, len(points), 0.0, False, "no map")
        surfaces, config = self._map, self._config
        off2 = 0.0 if again else self._off2
        wide = 9.0 * (1.0 + off2 / surfaces.sigma**2)
        bent = _bent(prepared.times[rows])
        found = match_planes(surfaces, points, bent, T_map_body, wide)
        if not again:
            self._note(T_map_body, found.T_map_body, points)
        information = found.information / (config.alike * max(found.mean, config.least_spread))
        error = surfaces.sigma * float(np.sqrt(found.mean))
        return SweepMatch(
            found.T_map_body, information, found.on, len(points), error, found.is_still,
            _reason(found, points), found.stays, found.bends,
        )  # fmt: skip

    def lying(self, prepared: ThinSweep, T_map_body: Array, twist: Array) -> SweepMatch:
        """Say how a sweep lies where it is, and find nothing; arguments as those of `match`."""
        rows = prepared.matched
        points = deskew(prepared.points.take(rows, axis=0), prepared.times[rows], twist)
        surfaces = self._surfaces()
        on, mean = lying(surfaces, points, T_map_body)
        error = surfaces.sigma * float(np.sqrt(mean))
        return SweepMatch(T_map_body, np.zeros((6, 6)), on, len(points), error, True)

    def _note(self, T_guess: Array, T: Array, points: Array) -> None:
        """Learn from how far the guess was off."""
        xi = se3_log(se3_inverse(T_guess) @ T)
        far = float(np.sqrt(np.mean(np.einsum("ni,ni->n", points, points))))
        off = float(np.linalg.norm(xi[:3])) + far * float(np.linalg.norm(xi[3:]))
        self._off2 += self._config.learning * (off * off - self._off2)

    def insert(self, prepared: ThinSweep, T_map_body: Array, twist: Array) -> None:
        """Add a sweep, and forget what is far."""
        points = deskew(prepared.points, prepared.times, twist)
        surfaces = self._surfaces()
        surfaces.insert(points @ T_map_body[:3, :3].T + T_map_body[:3, 3])
        surfaces.evict(T_map_body[:3, 3], self._config.farthest * surfaces.voxel)

    def expect_anything(self) -> None:
        """Take the next guess to be as far off as the first may be."""
        self._off2 = self._config.first_off**2

    def seed(self, points: Array) -> None:
        """Add points (N, 3) of another map, in the frame of this one."""
        self._surfaces().insert(points)

    def _surfaces(self) -> PlaneMap:
        if self._map is None:
            self._map = PlaneMap(self._voxel or 1.0, self._config.sigma * (self._voxel or 1.0))
        return self._map

    def clear(self) -> None:
        """Forget the map."""
        self._map = None
        self.expect_anything()


def _bent(times: Array) -> Array:
    """Return by how much (N,) of a change of the motion from sweep to sweep points are off.

    Where a motion changes by Δξ from sweep to sweep of length Δt, that from the middle of the last
    one to that of this is ½ Δξ behind, and over the sweep it changes on: ½ Δξ (t + t² / Δt).
    """
    lasts = float(np.ptp(times)) if len(times) else 0.0
    return 0.5 * times * (1.0 + times / lasts) if lasts > 0.0 else np.zeros(len(times))


def _reason(found: PlaneMatch, points: Array) -> str:
    """Say what is wrong with a match; empty if nothing is."""
    if len(found.weak):
        far = float(np.sqrt(np.mean(np.einsum("ni,ni->n", points, points))))
        return named(found.weak * np.repeat((1.0, far), 3))
    return "" if found.is_still else "it did not come to rest"


def suitable_voxel(points: Array, config: PointsConfig) -> float:
    """Return a voxel for a place: a share of how far half of what is seen is away."""
    away = float(np.median(np.linalg.norm(points, axis=1)))
    return float(np.clip(config.voxel_share * away, config.least_voxel, config.most_voxel))
