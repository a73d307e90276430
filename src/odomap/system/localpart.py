"""The part of a map around a new keyframe that local mapping works on, and what holds it.

    free    the new keyframe, and those that share most landmarks with it
    held    further keyframes that see the same landmarks: they stay where they are
    near    keyframes that look at the same place from nearby, sharing none yet: held, too

Where a camera comes back, landmarks tie the new keyframe to a part of the map that is far from it
along all that was measured (`chains`). Between the two lies the drift of the way round, and the
window must not split it: the older part, on which all that came later stands, would be bent. So it
is held, until a loop says where the two parts lie to each other.

The new keyframe's uncertainty is counted from one held keyframe, the anchor: of its own part if
there is one, since how the other lies to that was not measured here.

Cost: O(observations of the part), and O(K) over an integer per keyframe.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VI-D.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot
from odomap.system.chains import Chains, older_part
from odomap.system.localmap import LocalMapConfig, median_distance, nearby
from odomap.system.localwindow import by_id
from odomap.system.visualconfig import MappingConfig

__all__ = ["LocalPart", "MappingConfig", "choose_part"]

UNSURE_PX = 20.0
"""Where landmarks may lie further off than this, what is found nearby would be something else."""


@dataclass(frozen=True, eq=False)
class LocalPart:
    """A part of the map that is worked on.

    Attributes:
        snapshot: of it, with landmarks in order of their ids.
        anchor_id: the held keyframe that the new one's uncertainty is counted from.
    """

    snapshot: Snapshot
    anchor_id: int


def choose_part(
    map: Map, keyframe_id: int, camera: Camera, config: MappingConfig, local: LocalMapConfig
) -> LocalPart | None:
    """Copy the keyframes around a new one, what they see, and those that hold them.

    Args:
        map: the map.
        keyframe_id: the new keyframe.
        camera: the pinhole.
        config: how many keyframes.
        local: what is near.

    Returns:
        The part; None where the keyframe is alone.
    """
    shared, counts = map.covisible(keyframe_id)
    neighbours = shared[counts >= config.min_shared].tolist()
    ours = Chains(map).near(keyframe_id, neighbours)
    older = older_part(ours, neighbours)
    neighbours = [k for k in neighbours or shared[:1].tolist() if k not in older]
    free = [keyframe_id, *neighbours[: config.size - 1]]
    seen = map.landmarks_of(free)
    around = [k for k in map.observing(seen)[0].tolist() if k not in free]
    held = _held(around, older, config.fixed)
    near = _near(map, keyframe_id, {*free, *held}, camera, local)
    if len(free) + len(near) < 2:
        return None
    if not held:  # nothing else is known: the oldest one ties it all
        held = [min(free)] if len(free) > 1 else near[:1]
        free = [k for k in free if k not in held]
    # All as if they were free: a snapshot tells the landmarks of those alone.
    snapshot = map.snapshot([*free, *near, *held])
    is_fixed = ~np.isin(snapshot.keyframe_ids, free)
    anchor_id = _anchor(shared.tolist(), snapshot.keyframe_ids[is_fixed].tolist(), ours)
    last = int(snapshot.keyframe_ids[is_fixed][-1])
    return LocalPart(replace(by_id(snapshot), is_fixed=is_fixed, anchor_id=last), anchor_id)


def _held(around: list[int], older: set[int], count: int) -> list[int]:
    """Choose who holds a window: half of them of the older part, if there are two."""
    first = [k for k in around if k in older]
    others = [k for k in around if k not in older]
    return [*first[: max(count // 2, count - len(others))], *others][:count]


def _near(
    map: Map, keyframe_id: int, known: set[int], camera: Camera, config: LocalMapConfig
) -> list[int]:
    """Return keyframes that look at what a new one sees without sharing a landmark with it."""
    T_world_body = map.T_world_body(keyframe_id)
    seen, _ = map.observations_of(keyframe_id)
    distance = median_distance(map.points_world(seen), T_world_body[:3, 3])
    if not _unsure_px(map.covariance(keyframe_id), distance, camera) < UNSURE_PX:
        return []
    near = nearby(map, T_world_body, distance, config)
    return [k for k in near.tolist() if k not in known][: config.near]


def _unsure_px(covariance: NDArray[np.float64], distance: float, camera: Camera) -> float:
    """Return by how many pixels landmarks so far away may lie elsewhere than a pose says."""
    sigma = np.sqrt(np.diag(covariance))
    across = sigma[:3].max() / distance + sigma[3:].max()
    return float(camera.fx * across)


def _anchor(shared: list[int], fixed: list[int], ours: set[int]) -> int:
    """Return which of the fixed keyframes tells most about where the new one is."""
    tied = [k for k in shared if k in fixed]
    return next((k for k in [*tied, *fixed] if k in ours), [*tied, *fixed][0])
