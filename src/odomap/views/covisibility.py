"""What a map holds, as arrays to draw: keyframes, landmarks, and who sees the same.

Two keyframes are covisible by the number of landmarks that both see,

    w(i, j) = #{l : (i, l) and (j, l) are observations},

counted off the map, one keyframe after the other. Weak pairs say little and would blacken the
picture, so only strong ones are kept, and of a large map the strongest few thousand. O(observations
of the observations).

Reference: H. Strasdat et al., Double window optimisation for constant time visual SLAM, ICCV 2011.
"""

from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from odomap.maps.map import Map
from odomap.views.loopview import gap_ends, loop_ends

__all__ = ["MapView"]

STRONG = 15
"""Landmarks that two keyframes have to share to be drawn as joined."""

PAIRS = 3000
"""Pairs that are kept to be drawn."""


@dataclass(frozen=True, eq=False)
class MapView:
    """A map ready to be drawn.

    Attributes:
        keyframes: (K, 3) places of the living keyframes in the world, oldest first.
        landmarks: (M, 3) landmarks in the world.
        pairs: (P, 2) rows of keyframes that share landmarks, weakest first.
        shared: (P,) how many they share, at least `least`.
        num_pairs: how many such pairs there are in all.
        least: landmarks that a pair shares at least.
        loops: (L, 2, 3) ends of the loops that were closed, in the world.
        gaps: (G, 2, 3) keyframes between which nothing is known of how they lie to each other.
    """

    keyframes: NDArray[np.float64]
    landmarks: NDArray[np.float64]
    pairs: NDArray[np.int64]
    shared: NDArray[np.int64]
    num_pairs: int
    least: int = STRONG
    loops: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2, 3)))
    gaps: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2, 3)))

    @classmethod
    def of(cls, map: Map, scale: float = 1.0, least: int = STRONG, most: int = PAIRS) -> Self:
        """Read a map.

        Args:
            map: read under its lock.
            scale: what its lengths are multiplied with.
            least: landmarks that two keyframes share at least to be a pair.
            most: pairs to keep, the strongest.
        """
        with map.lock:
            ids = map.keyframe_ids
            keyframes = np.ascontiguousarray(map.Ts_world_body(ids)[:, :3, 3])
            landmarks = map.points_world(map.landmark_ids)
            rows = [_later(ids, row, *map.covisible(k)) for row, k in enumerate(ids.tolist())]
        table = np.concatenate([np.zeros((0, 3), np.int64), *rows])
        table = table[table[:, 2] >= least]
        kept = table[np.argsort(table[:, 2], kind="stable")][max(len(table) - most, 0) :]
        return cls(
            scale * keyframes,
            scale * landmarks,
            kept[:, :2],
            kept[:, 2],
            len(table),
            least,
            scale * loop_ends(map),
            scale * gap_ends(map),
        )


def _later(
    ids: NDArray[np.int64], row: int, others: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return (n, 3) row, row of the other and count, of what is covisible and newer."""
    place = np.searchsorted(ids, others)
    newer = place > row
    return np.stack([np.full(int(newer.sum()), row), place[newer], counts[newer]], axis=1)
