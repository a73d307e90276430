"""Searching for places that a keyframe's cloud may be of: by how they look, and by where they are.

What a place looks like needs no path, and brings a first guess of how it is turned (`lidar/
scancontext`). But streets look like streets: so it is asked only of places that the keyframe can be
at, if the path is no further off than its covariance says, with something added since that is
modest:

    |p_k - p_m| ≤ 10 m + 3 (σ_k + σ_m) + 3 % of the way from m to k,    way ≥ 25 m.

In other pieces of the map nothing is known of where it is, and all places may be it. Where the path
is sure the place nearest to it is tried as well, whatever it looks like.

Cost: 3 ms for a keyframe, among a thousand.

Reference: G. Kim, A. Kim, "Scan Context: egocentric spatial descriptor for place recognition within
3D point cloud map", IROS 2018.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.lidar.scancontext import Alike, Context, Contexts, Layout, describe, leveled
from odomap.system.cloudconfig import CloudClosingConfig
from odomap.system.cloudplaces import Places, cloud_points

__all__ = ["Candidate", "CloudSearch"]

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]

SIGMAS = 3.0
"""Standard deviations of the path that are searched."""
SIDESTEP = 2.0
"""How far apart the places beside are that a cloud is described from, metres."""
ANOTHER = 6.0
"""How far apart places must be to be tried both, metres: along a road they look much the same."""
BATCH = 50
"""Keyframes of a loaded map that are described at a time."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A place that a cloud may be of.

    Attributes:
        row: of the keyframe there.
        T_place_lidar: (4, 4) first guess.
        distance: of the two descriptions; NaN where only the path speaks for it.
    """

    row: int
    T_place_lidar: Array
    distance: float


class CloudSearch:
    """Keeps how the places of a map look, and searches among them.

    Args:
        config: how they are described, and how alike they must be.
    """

    def __init__(self, config: CloudClosingConfig) -> None:
        self._config = config
        self._contexts = Contexts(Layout(config.rings, config.sectors, config.reach))
        steps = int(config.beside / SIDESTEP)
        self._besides = [SIDESTEP * n for n in range(-steps, steps + 1)]

    def remember(self, keyframe_id: int, looks: list[Context]) -> None:
        """Remember how a keyframe looks, to find it later."""
        if keyframe_id not in self._contexts.ids:
            self._contexts.enter(keyframe_id, next(c for c in looks if c.beside == 0.0))

    def looks(self, points: Array, up: Array) -> list[Context]:
        """Describe a cloud (N, 3) in which `up` (3,) is up, from where it was and from beside."""
        level, layout = points @ leveled(up).T, self._contexts.layout
        return [describe(level, layout, beside) for beside in self._besides]

    def catch_up(self, places: Places, most: int | None = BATCH) -> None:
        """Describe keyframes of the map that have not been yet, and forget those that went."""
        self._contexts.keep(places.ids)
        missing = np.setdiff1d(places.ids, self._contexts.ids)
        layout = self._contexts.layout
        for row in np.searchsorted(places.ids, missing[:most]).tolist():
            points = cloud_points(places.keyframes[row])
            level = points @ leveled(places.Ts_world_lidar[row, 2, :3]).T
            self._contexts.enter(int(places.ids[row]), describe(level, layout))

    def candidates(self, places: Places, keyframe_id: int, looks: list[Context]) -> list[Candidate]:
        """Return the places that a keyframe may have come back to, the most likely first."""
        row, config = places.row(keyframe_id), self._config
        apart = np.linalg.norm(
            places.Ts_world_lidar[:, :3, 3] - places.Ts_world_lidar[row, :3, 3], axis=1
        )
        way = places.way[row] - places.way
        is_here = places.piece == places.piece[row]
        is_older = (way >= config.least_way) & is_here
        sigma = SIGMAS * (places.sigma[row] + places.sigma)
        allowed = is_older & (apart <= config.least_reach + sigma + config.drift * way)
        chosen = self.alike(places, places.Ts_world_lidar[row], looks, allowed | ~is_here)
        near = np.flatnonzero(is_older & (apart <= config.near))
        if len(near):
            nearest = int(near[apart[near].argmin()])
            if all(_is_another(places, nearest, c.row) for c in chosen):
                T = se3_inverse(places.Ts_world_lidar[nearest]) @ places.Ts_world_lidar[row]
                chosen.append(Candidate(nearest, T, np.nan))
        return chosen

    def alike(
        self, places: Places, T_world_lidar: Array, looks: list[Context], allowed: Bool
    ) -> list[Candidate]:
        """Return the places that look like a cloud, the most alike first.

        Args:
            places: of the map.
            T_world_lidar: (4, 4) of which the third row says which way is up in the cloud.
            looks: of the cloud.
            allowed: (K,) keyframes that count.
        """
        chosen: list[Candidate] = []
        for alike in self._contexts.search(looks, places.ids[allowed]):
            if alike.distance > self._config.alike or len(chosen) == self._config.most:
                break
            row = places.row(alike.id)
            if all(_is_another(places, row, c.row) for c in chosen):
                T = _guess(alike, places.Ts_world_lidar[row], T_world_lidar)
                chosen.append(Candidate(row, T, alike.distance))
        return chosen


def _is_another(places: Places, row: int, other: int) -> bool:
    """Say whether two rows are so far apart that they are two places."""
    Ts = places.Ts_world_lidar
    is_far = np.linalg.norm(Ts[row, :3, 3] - Ts[other, :3, 3]) > ANOTHER
    return bool(is_far or places.piece[row] != places.piece[other])


def _guess(alike: Alike, T_world_place: Array, T_world_lidar: Array) -> Array:
    """Return (4, 4) where a LiDAR seems to be in the frame of another, both as tilted as known."""
    T = np.eye(4)
    there, here = leveled(T_world_place[2, :3]), leveled(T_world_lidar[2, :3])
    level = alike.T_place_sensor
    T[:3, :3] = there.T @ level[:3, :3] @ here
    T[:3, 3] = there.T @ level[:3, 3]
    return T
