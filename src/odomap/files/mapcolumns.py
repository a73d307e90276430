"""The tables of a map as the arrays of its file, and back.

In the file, landmarks are named by id also where the map counts in slots, stamps are a column of
their own, and kinds of edges are numbers beside a list of names in order of first appearance.

Reference: D. Abadi, P. Boncz, S. Harizopoulos et al., "The design and implementation of modern
column-oriented database systems", Foundations and Trends in Databases 5(3), 2013.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.files.mapchecks import Numbers, slots_of
from odomap.maps.edges import EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.maps.tables import MapTables
from odomap.maps.tree import ALIVE, STUB

__all__ = ["COUNTED", "check_keypoints", "columns_of", "counts_of", "tables_of"]

COUNTED = ("keyframes", "stubs", "landmarks", "observations", "edges")

Columns = Mapping[str, NDArray[Any]]


def columns_of(tables: MapTables) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Return the arrays of a map by name as in `mapschema.ARRAYS`, and the kinds of its edges."""
    columns = dict(tables.columns)
    slot = columns["landmarks/slot"]
    ids = np.full(int(slot.max(initial=-1)) + 1, -1, np.int64)
    ids[slot] = columns["landmarks/id"]
    columns["observations/landmark"] = ids[columns["observations/landmark"]]
    stamps = np.zeros(len(columns["tree/status"]), np.int64)
    for keyframe in tables.keyframes:
        stamps[keyframe.id] = keyframe.stamp_ns
    edges = tables.edges
    kinds = list(dict.fromkeys(edges.kind))
    number = {kind: n for n, kind in enumerate(kinds)}
    columns["keyframes/stamp_ns"] = stamps
    columns["edges/i"], columns["edges/j"] = edges.i, edges.j
    columns["edges/Ts_i_j"], columns["edges/scales_i_j"] = edges.Ts_i_j, edges.scales_i_j
    columns["edges/information"] = edges.information
    columns["edges/kind"] = np.array([number[kind] for kind in edges.kind], np.int32)
    return columns, kinds


def tables_of(
    columns: Columns, numbers: Numbers, kinds: Sequence[str], keyframes: tuple[Keyframe, ...]
) -> MapTables:
    """Return the tables of a map; what `columns_of` gave, and what `check_tables` let pass."""
    c = dict(columns)
    c["observations/landmark"] = slots_of(c, c["observations/landmark"]).astype(np.int32)
    edges = EdgeTable(
        c["edges/i"],
        c["edges/j"],
        c["edges/Ts_i_j"],
        c["edges/scales_i_j"],
        c["edges/information"],
        tuple(kinds[n] for n in c["edges/kind"].tolist()),
    )
    return MapTables(columns=c, keyframes=keyframes, edges=edges, **vars(numbers))


def counts_of(columns: Columns) -> dict[str, int]:
    """Return how many there are of what people count."""
    status = columns["tree/status"]
    numbers = (
        int((status == ALIVE).sum()),
        int((status == STUB).sum()),
        len(columns["landmarks/id"]),
        len(columns["observations/keypoint"]),
        len(columns["edges/i"]),
    )
    return dict(zip(COUNTED, numbers))


def check_keypoints(columns: Columns, keyframes: Sequence[Keyframe]) -> None:
    """Make sure that observations name keypoints that their keyframes have.

    Raises:
        ValueError: one does not.
    """
    most = np.full(len(columns["tree/status"]), np.iinfo(np.int64).max)
    for keyframe in keyframes:
        if keyframe.features is not None:
            most[keyframe.id] = len(keyframe.features)
    seeing = columns["observations/keyframe"]
    beyond = np.flatnonzero(columns["observations/keypoint"] >= most[seeing])
    if len(beyond):
        k = int(seeing[beyond[0]])
        raise ValueError(f"observations/keypoint: keyframe {k} has {most[k]} features")
