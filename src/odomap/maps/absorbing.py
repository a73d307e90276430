"""Absorbing: all of one map taken into another, under new names.

Two maps name their keyframes and landmarks from 0 on. The second's keyframe k becomes

    k' = n + k,     n the next id of the first,

in every table, culled ones and ids never used included, so that stubs, parents, anchors, edges and
observations go on naming what they named; landmarks get the next ids, in the order of those they
had. What is relative to a keyframe needs no change at all. The root of the second's tree hangs from
the first's newest keyframe, by a step that was not measured: a gap (`atlas`). The order of all
lists is kept, so that what is computed from a part of the map is what it was in its own.

Cost: O(size of what is taken in).

Reference: Campos, Elvira, Rodríguez, Montiel, Tardós, "ORB-SLAM3: an accurate open-source library
for visual, visual-inertial and multi-map SLAM", T-RO 2021, section VI.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.edges import Edges
from odomap.maps.landmarks import Landmarks
from odomap.maps.observations import Observations
from odomap.maps.states import States
from odomap.maps.tables import MapTables
from odomap.maps.tree import Tree

__all__ = ["Absorbed", "absorb_tables"]

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Absorbed:
    """What a map that was taken in is called now.

    Attributes:
        offset: its keyframe k is offset + k.
        root_id: its first keyframe, which begins a piece; −1 if it had none.
        keyframe_ids: (K,) its living keyframes, ascending.
        landmark_ids: (M,) its landmarks, in the order of the ids that they had.
    """

    offset: int
    root_id: int
    keyframe_ids: Index
    landmark_ids: Index


def absorb_tables(
    tables: MapTables,
    offset: int,
    holder: int,
    version: int,
    states: States,
    tree: Tree,
    landmarks: Landmarks,
    observations: Observations,
    edges: Edges,
) -> Absorbed:
    """Take the tables of a map into those of another, whose lock the caller holds.

    Args:
        tables: of the map to be taken in.
        offset: its keyframe k is called offset + k.
        holder: the keyframe that its root hangs from, −1 if there is none.
        version: of the map that takes it in.
        states, tree, landmarks, observations, edges: of the same.
    """
    states.graft(tables.of("states"), offset)
    root = tree.graft(tables.of("tree"), offset, holder, version)
    of_landmarks, seen = tables.of("landmarks"), tables.of("observations")
    slots = landmarks.graft(of_landmarks, offset)
    here = np.full(int(of_landmarks["slot"].max(initial=-1)) + 1, -1, np.int64)
    here[of_landmarks["slot"]] = slots
    observations.graft(seen, offset, here[seen["landmark"]])
    e = tables.edges
    for n, kind in enumerate(e.kind):
        ends = offset + int(e.i[n]), offset + int(e.j[n])
        edges.add(*ends, e.Ts_i_j[n], e.information[n], kind, float(e.scales_i_j[n]))
    alive = np.array([keyframe.id for keyframe in tables.keyframes], np.int64)
    return Absorbed(offset, root, offset + alive, np.sort(landmarks.ids[slots]))
