"""What must hold between the tables of a map file, checked before a map is made of them.

Sizes and types are right by then (`mapschema`); here are the numbers: ids name what is there,
places are finite, and the spanning tree is one,

    root:  parent = -1, exactly one;     else  created(parent) < created(child) <= version,

which leaves no room for cycles. The same checks are made before a map is saved, so that what is
saved can be loaded. All are vectorised, O(rows log rows).

Reference: J. H. Saltzer, M. D. Schroeder, "The protection of information in computer systems",
Proceedings of the IEEE 63(9), 1975 (complete mediation).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.maps.tree import ABSENT, ALIVE, STUB

__all__ = ["Numbers", "check_tables", "slots_of"]

ROTATION = 1e-4
"""How far RᵀR may be from I."""
RESERVED = 1 << 16
"""Keyframe ids that may be reserved and not used yet."""
HIGHEST = 1 << 62

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Numbers:
    """Single numbers of a map; see `MapTables`."""

    version: int
    epoch: int
    newest: int
    next_keyframe: int
    next_landmark: int


def check_tables(c: Columns, numbers: Numbers, edge_kinds: int, budget: int) -> None:
    """Make sure that the tables of a map fit together.

    Args:
        c: arrays by name as in `mapschema.ARRAYS`.
        numbers: of the map.
        edge_kinds: how many kinds of edges are named.
        budget: bytes that the table of landmark ids may take.

    Raises:
        ValueError: names the array and what is wrong with it.
    """
    for name, value in vars(numbers).items():
        _need(-1 <= value < HIGHEST, f"{name}: {value} cannot be")
    _keyframes(c, numbers)
    _tree(c, numbers)
    _landmarks(c, numbers.next_landmark, budget)
    _observations(c)
    _edges(c, edge_kinds)


def _need(holds: bool | np.bool_, problem: str) -> None:
    if not holds:
        raise ValueError(problem)


def _keyframes(c: Columns, numbers: Numbers) -> None:
    status = c["tree/status"]
    rows = len(status)
    _need((status <= STUB).all(), "tree/status: an entry is neither 0, 1 nor 2")
    present, alive = status != ABSENT, status == ALIVE
    _need(rows <= numbers.next_keyframe <= rows + RESERVED, "next_keyframe: does not fit the rows")
    _placements("states", c["states/Ts_world_body"], c["states/scales"], present)
    stub = status == STUB
    _placements("tree", c["tree/Ts_parent_self"], c["tree/scales_parent_self"], stub)
    for name in ("v_world_body", "biases", "covariances", "growths"):
        _need(not c[f"states/{name}"][~present].any(), f"states/{name}: of an id not in use")
    for name in ("v_world_body", "biases"):
        _need(not np.isinf(c[f"states/{name}"]).any(), f"states/{name}: an entry is infinite")
    _need(not c["keyframes/stamp_ns"][~alive].any(), "keyframes/stamp_ns: of no keyframe")


def _placements(table: str, Ts: NDArray[Any], scales: NDArray[Any], used: NDArray[Any]) -> None:
    """Check poses and scales, and that there are zeros where none are used."""
    _rigid(f"{table}: the pose", Ts[used], np.flatnonzero(used))
    _positive(f"{table}: the scale", scales[used], np.flatnonzero(used))
    _need(not Ts[~used].any() and not scales[~used].any(), f"{table}: a pose of an id not in use")


def _rigid(what: str, Ts: NDArray[Any], names: NDArray[Any]) -> None:
    with np.errstate(all="ignore"):
        R = Ts[:, :3, :3]
        error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
        good = np.isfinite(Ts).all(axis=(1, 2)) & (error < ROTATION) & (np.linalg.det(R) > 0)
        good &= (np.abs(Ts[:, 3] - (0.0, 0.0, 0.0, 1.0)) < 1e-9).all(axis=1)
    if not good.all():
        raise ValueError(f"{what} {names[np.argmin(good)]} is not finite or not rigid")


def _positive(what: str, scales: NDArray[Any], names: NDArray[Any]) -> None:
    good = np.isfinite(scales) & (scales > 0)
    if not good.all():
        raise ValueError(f"{what} {names[np.argmin(good)]} is not finite and positive")


def _tree(c: Columns, numbers: Numbers) -> None:
    status, parent, created = c["tree/status"], c["tree/parent"], c["tree/created"]
    absent, alive = status == ABSENT, status == ALIVE
    _need((parent[absent] == -1).all(), "tree/parent: of an id not in use")
    _need((created[absent] == 0).all(), "tree/created: of an id not in use")
    since = created[~absent]
    _need(((since >= 1) & (since <= numbers.version)).all(), "tree/created: no version of the map")
    roots = np.flatnonzero(alive & (parent == -1))
    _need(len(roots) == int(not absent.all()), f"tree/parent: there are {len(roots)} roots")
    child = np.flatnonzero(~absent)
    child = child[~np.isin(child, roots)]
    holder = parent[child]
    inside = (holder >= 0) & (holder < len(status))
    _need(inside.all() and alive[holder[inside]].all(), "tree/parent: is not in the map")
    living = alive[child]
    older = created[holder[living]] < created[child[living]]
    _need(older.all(), "tree/parent: a keyframe is older than its parent: a cycle?")
    if alive.any():
        inside_map = 0 <= numbers.newest < len(status) and bool(alive[numbers.newest])
        _need(inside_map, f"newest: keyframe {numbers.newest} is not in the map")
    else:
        _need(numbers.newest == -1, f"newest: keyframe {numbers.newest} is not in the map")


def _landmarks(c: Columns, next_id: int, budget: int) -> None:
    slot, ids, free = c["landmarks/slot"], c["landmarks/id"], c["landmarks/free"]
    _need((np.diff(slot) > 0).all(), "landmarks/slot: is not ascending")
    every = np.sort(np.concatenate([slot, free]))
    _need(np.array_equal(every, np.arange(len(every))), "landmarks/free: slots are not each once")
    ordered = np.sort(ids)
    _ids_below("landmarks/id", ordered, next_id)
    fused, heirs = c["landmarks/fused"], c["landmarks/survivor"]
    _ids_below("landmarks/fused", fused, next_id)
    _need(not _within(fused, ordered).any(), "landmarks/fused: a landmark is fused and there")
    _need(_within(heirs, ordered).all(), "landmarks/survivor: is not in the map")
    oldest = min(int(ordered.min(initial=next_id)), int(fused.min(initial=next_id)))
    _need(8 * (next_id - oldest) <= budget, f"next_landmark: {next_id} cannot be")
    anchors = c["landmarks/anchor"]
    _need(_alive(c, anchors).all(), "landmarks/anchor: is not in the map")
    bad = np.flatnonzero(~np.isfinite(c["landmarks/p_anchor"]).all(axis=1))
    if len(bad):
        raise ValueError(f"landmarks/p_anchor: the place of landmark {ids[bad[0]]} is not finite")
    for name in ("seen", "expected"):
        _need((c[f"landmarks/{name}"] >= 0).all(), f"landmarks/{name}: is below 0")


def _observations(c: Columns) -> None:
    keyframe, landmark = c["observations/keyframe"], c["observations/landmark"]
    _need((np.diff(keyframe) >= 0).all(), "observations/keyframe: is not ascending")
    _need(_alive(c, keyframe).all(), "observations/keyframe: is not in the map")
    slots = slots_of(c, landmark)
    _need((slots >= 0).all(), "observations/landmark: is not in the map")
    pairs = np.sort(keyframe.astype(np.int64) << 32 | slots)
    _need((np.diff(pairs) > 0).all(), "observations: a keyframe sees a landmark twice")
    _need((c["observations/keypoint"] >= -1).all(), "observations/keypoint: is below -1")
    rows = c["observations/by_landmark"]
    once = np.array_equal(np.sort(rows), np.arange(len(rows)))
    _need(once and (np.diff(slots[rows]) >= 0).all(), "observations/by_landmark: is no such order")


def slots_of(c: Columns, landmarks: NDArray[Any]) -> NDArray[np.int64]:
    """Return the slots of (N,) landmark ids, -1 where there is no such landmark.

    By a table of all ids since the oldest, whose size `check_tables` has bounded: a search among
    sorted ids takes ten times as long.
    """
    ids = c["landmarks/id"]
    if not len(ids):
        return np.full(len(landmarks), -1, np.int64)
    oldest, newest = int(ids.min()), int(ids.max())
    table = np.full(newest - oldest + 1, -1, np.int64)
    table[ids - oldest] = c["landmarks/slot"]
    known = (landmarks >= oldest) & (landmarks <= newest)
    slots: NDArray[np.int64] = np.where(known, table[np.where(known, landmarks - oldest, 0)], -1)
    return slots


def _edges(c: Columns, kinds: int) -> None:
    status, rows = c["tree/status"], np.arange(len(c["edges/i"]))
    for name in ("i", "j"):
        ends = c[f"edges/{name}"]
        inside = (ends >= 0) & (ends < len(status))
        known = inside.all() and (status[ends] != ABSENT).all()
        _need(known, f"edges/{name}: names a keyframe that never was in the map")
    _rigid("edges: the pose of edge", c["edges/Ts_i_j"], rows)
    _positive("edges: the scale of edge", c["edges/scales_i_j"], rows)
    _need(np.isfinite(c["edges/information"]).all(), "edges/information: an entry is not finite")
    kind = c["edges/kind"]
    _need(((kind >= 0) & (kind < kinds)).all(), "edges/kind: is none of those named")


def _ids_below(name: str, ordered: NDArray[Any], next_id: int) -> None:
    _need((np.diff(ordered) > 0).all(), f"{name}: ids are not distinct, or not in order")
    if len(ordered):
        inside = ordered[0] >= 0 and ordered[-1] < next_id
        _need(inside, f"{name}: an id is not from 0 to {next_id - 1}")


def _within(values: NDArray[Any], ordered: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which values are in an ascending array."""
    if not len(ordered):
        return np.zeros(len(values), np.bool_)
    place = np.searchsorted(ordered, values).clip(max=len(ordered) - 1)
    return np.asarray(ordered[place] == values)


def _alive(c: Columns, ids: NDArray[Any]) -> NDArray[np.bool_]:
    status = c["tree/status"]
    inside = (ids >= 0) & (ids < len(status))
    alive = np.zeros(len(ids), np.bool_)
    alive[inside] = status[ids[inside]] == ALIVE
    return alive
