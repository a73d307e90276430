"""Where in a map of clouds a sweep was taken, when nothing is known of it.

The first sweep in a map that was loaded, or one of a body that was carried off, may be of any
place. The places that look most like it (`cloudsearch`) are tried in turn; it is laid onto each as
a loop would be, but must show more (`cloudverifying`), as there is no path that speaks for it, and
no other loops that contradict it. It is not believed

    if another place, that lies elsewhere, fits as well as that,
    if what is seen does not fix the place: along a tunnel any is as good,

and the body has to go on until it sees something that is there once.

A body stands in the world as it mostly did while the map was made: that says which way is up in a
sweep before its place is known.

Cost: 0.5 ms for each keyframe of the map, once; then 5 ms and 40 ms for each place that is tried.

Reference: G. Kim, A. Kim, "Scan Context: egocentric spatial descriptor for place recognition within
3D point cloud map", IROS 2018.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse, so3_log
from odomap.maps.map import Map
from odomap.system.cloudconfig import CloudClosingConfig, CloudRecognitionConfig
from odomap.system.cloudplaces import Places, read_places
from odomap.system.cloudsearch import CloudSearch
from odomap.system.cloudverifying import CloudJudge, Laid

__all__ = ["CloudFinder", "FoundCloud"]

Array = NDArray[np.float64]

SAME, SAME_RAD = 1.0, 0.1
"""How far apart poses may be that are of one place, metres and radians."""
FEWEST = 50
"""Points that a sweep must have."""


@dataclass(frozen=True, eq=False)
class FoundCloud:
    """Where a sweep was taken.

    Attributes:
        keyframe_id: that it was laid onto.
        T_keyframe_body: (4, 4) where the body is in its frame.
        information: (6, 6) of that, right tangent.
        num_inliers: points that meet what is known there.
    """

    keyframe_id: int
    T_keyframe_body: Array
    information: Array
    num_inliers: int


class CloudFinder:
    """Finds sweeps in a map.

    Args:
        map: keyframes with clouds.
        T_body_lidar: (4, 4) where the LiDAR is on the body.
        config: what a sweep must show.
        closing: how places are described, and clouds laid onto each other.
    """

    def __init__(
        self,
        map: Map,
        T_body_lidar: Array,
        config: CloudRecognitionConfig,
        closing: CloudClosingConfig,
    ) -> None:
        shown = replace(
            closing,
            alike=config.alike,
            most=config.most,
            overlap=config.overlap,
            misfit=config.misfit,
            against=config.against,
        )
        self._map, self._T_body_lidar, self._config = map, np.array(T_body_lidar), config
        self._search, self._judge = CloudSearch(shown), CloudJudge(T_body_lidar, shown)
        self._places: Places | None = None
        self._version = -1

    def find(
        self, points: NDArray[np.floating], T_world_body: Array | None = None
    ) -> FoundCloud | str:
        """Find where a sweep was taken.

        Args:
            points: (N, 3) as a keyframe keeps them: seen from the LiDAR, deskewed and thinned.
            T_world_body: (4, 4) last pose known, which says how the body is tilted; None if it is
                as it mostly was.

        Returns:
            Where; or why that cannot be told.
        """
        seen: Array = np.ascontiguousarray(points[:, :3], np.float64)
        if len(seen) < FEWEST:
            return f"{len(seen)} points of {FEWEST} needed to recognise a place"
        if not self._map.num_keyframes:
            return "there is no keyframe in the map"
        places = self._read()
        T = np.eye(4)
        T[2, :3] = self._up(places, T_world_body)
        looks = self._search.looks(seen, T[2, :3])
        candidates = self._search.alike(places, T, looks, np.ones(len(places.ids), bool))
        laid = [self._judge.lay(places, each, seen, T[2, :3]) for each in candidates]
        return self._decided(places, laid)

    def _read(self) -> Places:
        """Return the map as it is, with all places described."""
        if self._places is None or self._map.version != self._version:
            self._version = self._map.version
            self._places = read_places(self._map, self._T_body_lidar)
            self._search.catch_up(self._places, None)
        return self._places

    def _up(self, places: Places, T_world_body: Array | None) -> Array:
        """Return which way (3,) is up in the frame of the LiDAR."""
        ups = places.Ts_world_body[:, 2, :3] if T_world_body is None else T_world_body[2:3, :3]
        mean = ups.sum(axis=0)
        length = float(np.linalg.norm(mean))
        up = mean / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
        return np.asarray(self._T_body_lidar[:3, :3].T @ up)

    def _decided(self, places: Places, laid: list[Laid]) -> FoundCloud | str:
        """Say where a sweep is, after it was laid onto the likely places."""
        if not laid:
            return f"it looks like no place of {len(places.ids)}"
        fitting = [each for each in laid if not each.reason]
        if not fitting:
            return f"it is not of the place it looks most like: {laid[0].reason}"
        best = max(fitting, key=lambda each: each.overlap)
        if any(not _is_same(places, best, other) for other in fitting):
            return f"it fits {len(fitting)} places that lie apart"
        sigma = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(best.information)[:3, :3])[-1]))
        if sigma > self._config.sigma:
            return f"what it shows fixes the place to {sigma:.1f} m only"
        k = int(places.ids[best.row])
        return FoundCloud(k, best.T_place_body, best.information, best.num_inliers)


def _is_same(places: Places, one: Laid, other: Laid) -> bool:
    """Say whether a body is in one place, as laid onto two."""
    if places.piece[one.row] != places.piece[other.row]:
        return False
    Ts = [places.Ts_world_body[each.row] @ each.T_place_body for each in (one, other)]
    off = se3_inverse(Ts[0]) @ Ts[1]
    turned = float(np.linalg.norm(so3_log(off[:3, :3])))
    return bool(np.linalg.norm(off[:3, 3]) <= SAME and turned <= SAME_RAD)
