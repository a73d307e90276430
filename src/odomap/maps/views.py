"""How landmarks look: from where they were seen, how far away, and on which level of the pyramid.

Before a landmark is searched in an image one asks whether it can be found there: is it seen from
about the side it was seen from before, and at what size? With the centres c_k of the cameras that
observe it, a reference observation at distance d_ref and pyramid level l_ref, and a scale factor f
per level, a landmark at p is expected from a camera at c within

    n = Σ_k (p - c_k) / |p - c_k|  normalised,    viewing angle  cos α = n · (p - c) / |p - c|,
    level  l = l_ref + log_f (d_ref / |p - c|):   nearer, it is larger and found on a higher level.

The rows are copied under the map's lock (`ViewRows`), all else is computed without it, O(rows).

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (map points; local map tracking).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import offsets
from odomap.maps.keyframes import Keyframe
from odomap.maps.states import Placement, act

__all__ = ["LandmarkViews", "ViewRows", "views_from"]

_NONE = np.zeros(0, np.uint8)


@dataclass(frozen=True, eq=False)
class LandmarkViews:
    """What guided search needs of landmarks; arrays are copies.

    Attributes:
        ids: (N,) int64, ascending, distinct.
        points_world: (N, 3) places.
        normals: (N, 3) unit vectors: the mean direction from the observing cameras to the point.
        descriptors: (N, 32) uint8.
        distance: (N,) from the camera of the reference observation, world units.
        level: (N,) uint8 pyramid level of the reference observation, 0 where it has no features.
    """

    ids: NDArray[np.int64]
    points_world: NDArray[np.float64]
    normals: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    distance: NDArray[np.float64]
    level: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class ViewRows:
    """The rows of a map that views are computed from, as they were at one moment.

    Attributes:
        ids: (N,) landmarks, ascending.
        anchor: (N,) index of their anchor among the keyframes.
        p_anchor: (N, 3) places in the anchors' frames.
        descriptors: (N, 32).
        indptr: (N + 1,) observations of each landmark.
        observer: (R,) index of the observing keyframe.
        keypoint: (R,) which of its features, -1 for none.
        keyframes: the K keyframes, by ascending id.
        placements: (K, 4, 4) poses and (K,) scales of them.
    """

    ids: NDArray[np.int64]
    anchor: NDArray[np.int64]
    p_anchor: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    indptr: NDArray[np.int64]
    observer: NDArray[np.int64]
    keypoint: NDArray[np.int32]
    keyframes: Sequence[Keyframe]
    placements: Placement


def views_from(rows: ViewRows, T_body_camera: NDArray[np.float64]) -> LandmarkViews:
    """Compute how landmarks look from the cameras that see them.

    Args:
        rows: of the map.
        T_body_camera: (4, 4) mount of the camera.
    """
    Ts, scales = rows.placements
    centers = act(rows.placements, np.broadcast_to(T_body_camera[:3, 3], (len(Ts), 3)))
    points = act((Ts.take(rows.anchor, axis=0), scales.take(rows.anchor)), rows.p_anchor)
    rows = _watched(rows)
    landmark = np.repeat(np.arange(len(rows.ids)), np.diff(rows.indptr))
    rays = points.take(landmark, axis=0)
    rays -= centers.take(rows.observer, axis=0)
    lengths = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    rays /= np.maximum(lengths, np.finfo(np.float64).tiny)[:, None]
    normals = _sums(rays, rows.indptr)
    size = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    normals /= np.maximum(size, np.finfo(np.float64).tiny)[:, None]
    reference = _references(rows, landmark)
    return LandmarkViews(
        ids=rows.ids,
        points_world=points,
        normals=normals,
        descriptors=rows.descriptors,
        distance=lengths[reference],
        level=_levels(rows.keyframes, rows.observer[reference], rows.keypoint[reference]),
    )


def _watched(rows: ViewRows) -> ViewRows:
    """Return rows in which the anchor stands in for the observers of a landmark without any."""
    counts = np.diff(rows.indptr)
    lonely = np.flatnonzero(counts == 0)
    if not len(lonely):
        return rows
    where = rows.indptr[lonely]
    counts[lonely] = 1
    return ViewRows(
        ids=rows.ids,
        anchor=rows.anchor,
        p_anchor=rows.p_anchor,
        descriptors=rows.descriptors,
        indptr=offsets(counts),
        observer=np.insert(rows.observer, where, rows.anchor[lonely]),
        keypoint=np.insert(rows.keypoint, where, -1),
        keyframes=rows.keyframes,
        placements=rows.placements,
    )


def _sums(values: NDArray[np.float64], indptr: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the (N, 3) sums of N non-empty groups of rows."""
    if len(indptr) == 1:
        return np.zeros((0, 3))
    return np.add.reduceat(values, indptr[:-1], axis=0)


def _references(rows: ViewRows, landmark: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the observation of each landmark by its anchor, else by its oldest keyframe."""
    if not len(rows.ids):
        return np.zeros(0, np.int64)
    # the order of the keyframes is that of their ids, and the anchor comes before all
    rank = np.where(rows.observer == rows.anchor[landmark], -1, rows.observer)
    first = np.minimum.reduceat(rank, rows.indptr[:-1])
    found = np.flatnonzero(rank == first[landmark])
    reference = np.zeros(len(rows.ids), np.int64)
    reference[landmark[found]] = found
    return reference


def _levels(
    keyframes: Sequence[Keyframe], observer: NDArray[np.int64], keypoint: NDArray[np.int32]
) -> NDArray[np.uint8]:
    """Return the pyramid levels of N keypoints, 0 where there is none."""
    levels = [_NONE if k.features is None else k.features.level for k in keyframes]
    counts = np.array([len(column) for column in levels], np.int64)
    known = np.flatnonzero((keypoint >= 0) & (keypoint < counts[observer]))
    level = np.zeros(len(observer), np.uint8)
    if len(known):
        rows = offsets(counts)[observer[known]] + keypoint[known]
        level[known] = np.concatenate(levels)[rows]
    return level
