"""A loop closed: what is read off the map for it, and what is written into it.

Reading takes a few numbers of every keyframe (`Essentials`), and leaves out the steps of the tree
across gaps, which measured nothing. A keyframe that was culled is a stub
below its parent; where a loop was measured to one, the edge goes to the parent,

    S_p_q = (S_p⁻¹ S_i) Z_ij (S_j⁻¹ S_q),

and says the same. Writing moves each keyframe by its correction, S ← S_corrected S_read⁻¹ S_now.
Keyframes that came since follow their parents (`maps/writing`), and are as much surer as these are:
Σ = Ad Σ_parent Adᵀ + Q, their growth Q staying what odometry said it was. At last landmarks of both
sides that are one point are fused, and what either side shows of the other's is observed. Loops
that were found together, as between two maps, are written together.

Cost: O(K) over some numbers per keyframe, and O(landmarks fused).

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII-C (loop fusion).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.components import connected_components
from odomap.geometry.lie import se3_adjoint, se3_inverse, se3_log
from odomap.maps.atlas import beginnings
from odomap.maps.edges import LOOP
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot, Update
from odomap.maps.states import compose, inverse, stretched
from odomap.system.correction import correction
from odomap.system.covisibility import Acquaintance, Carried, Covisibility, acquaint
from odomap.system.essentialgraph import Corrected, Essentials, LoopEdges
from odomap.system.path import ASTRAY
from odomap.system.verifying import Verified

__all__ = [
    "Closure",
    "Reading",
    "Tie",
    "carry_covariance",
    "edges_of",
    "pieces_of",
    "read_essentials",
    "strayed",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Reading:
    """What is copied of the map and of what was written down, to be put together later.

    Attributes:
        snapshot: of all keyframes.
        covariances: (K, 6, 6).
        growth: (K, 6, 6) by what each is less sure than its parent.
        loops: closed before, by keyframe ids.
        parent: (R,) of all keyframes there ever were, −1 for none.
        pairs: of `Covisibility`.
        begins: (n,) keyframes that begin a piece of the map.
    """

    snapshot: Snapshot
    covariances: Array
    growth: Array
    loops: LoopEdges
    parent: Index
    pairs: Index
    begins: Index

    def essentials(self) -> Essentials:
        """Return what an essential graph is made of."""
        ids = self.snapshot.keyframe_ids
        row = np.full(len(self.parent) + 1, -1)
        row[ids] = np.arange(len(ids))
        pairs, parent = row[self.pairs], self.parent.copy()
        parent[self.begins] = -1
        return Essentials(
            ids,
            self.snapshot.Ts_world_body,
            self.snapshot.scales,
            self.covariances,
            row[parent[ids]],
            self.growth,
            pairs[(pairs >= 0).all(axis=1)],
            self.loops._replace(i=row[self.loops.i], j=row[self.loops.j]),
            self.snapshot.version,
        )


def read_essentials(map: Map, known: Covisibility) -> Reading:
    """Read what a path is corrected with: copies only.

    Args:
        map: the map.
        known: what was written down of its living keyframes; those it lacks are left out.
    """
    with map.lock:
        ids = map.keyframe_ids
        snapshot = map.snapshot(ids[np.isin(ids, known.keyframe_ids)], landmarks=False)
        ids = snapshot.keyframe_ids
        sure, growth = map.states.covariances[ids], map.states.growths[ids]
        parts = _read_loops(map), map.tree().parent, known.pairs(), beginnings(map)
    return Reading(snapshot, sure, growth, *parts)


def _read_loops(map: Map) -> LoopEdges:
    """Return the loops closed before, between living keyframes, by ids of these."""
    edges = map.edges()
    chosen = np.flatnonzero(np.array(edges.kind, str) == LOOP)
    ends = edges.i[chosen], edges.j[chosen]
    (p, T_p_i), (q, T_q_j) = (_held(map, end) for end in ends)
    D, scales_i_j = inverse(T_q_j), edges.scales_i_j[chosen]
    Ts, scales = compose(compose(T_p_i, (edges.Ts_i_j[chosen], scales_i_j)), D)
    lever = D[0].copy()
    lever[:, :3, 3] *= scales_i_j[:, None]  # in the units of i, as the information is
    Ad = se3_adjoint(lever)
    information = np.swapaxes(Ad, 1, 2) @ edges.information[chosen] @ Ad
    information = stretched(information, 1.0 / T_p_i[1])  # now in those of p
    is_one = p == q  # both ends have come to hang from one keyframe: nothing is left to say
    told = p, q, Ts, scales, information, np.stack(ends[::-1], axis=1)
    return LoopEdges(*(x[~is_one] for x in told))


def _held(map: Map, ids: Index) -> tuple[Index, tuple[Array, Array]]:
    """Return the living keyframes (n,) that hold keyframes or stubs, and these in them."""
    holders = [k if map.is_keyframe_alive(k) else map.parent(k) for k in ids.tolist()]
    (Ts, scales), (Ts_held, held) = (
        (map.Ts_world_body(each), np.array([map.scale(k) for k in each]))
        for each in (holders, ids.tolist())
    )
    return np.array(holders, np.int64), compose(inverse((Ts, scales)), (Ts_held, held))


class Tie(NamedTuple):
    """Two keyframes that show one place.

    Attributes:
        keyframe_id: the keyframe that came back.
        matched_id: the keyframe it came back to.
        measured: what geometry says of the two.
    """

    keyframe_id: int
    matched_id: int
    measured: Verified


def edges_of(essentials: Essentials, ties: Sequence[Tie]) -> LoopEdges:
    """Return loops as edges between rows of keyframes."""
    ids, measured = essentials.keyframe_ids, [tie.measured for tie in ties]
    return LoopEdges(
        np.searchsorted(ids, [tie.matched_id for tie in ties]),
        np.searchsorted(ids, [tie.keyframe_id for tie in ties]),
        np.array([found.T_matched_keyframe for found in measured]),
        np.array([found.scale for found in measured]),
        np.array([found.information for found in measured]),
        np.array([(tie.keyframe_id, tie.matched_id) for tie in ties], np.int64).reshape(-1, 2),
    )


def pieces_of(essentials: Essentials, ties: Sequence[Tie]) -> list[frozenset[int]]:
    """Return of each loop which parts it joins of what tree and earlier loops tie."""
    ids, loops, child = essentials.keyframe_ids, essentials.loops, essentials.parent >= 0
    first = np.concatenate([essentials.parent[child], loops.i])
    second = np.concatenate([np.flatnonzero(child), loops.j])
    label, new = connected_components(len(ids), first, second), edges_of(essentials, ties)
    return [frozenset(ends) for ends in zip(label[new.i].tolist(), label[new.j].tolist())]


def strayed(
    keyframe_id: int, matched_id: int, before: Essentials, after: Corrected, with_scale: bool
) -> str:
    """Say if a merge moves a piece further than its covariance allows, which grew in the gap.

    A single camera's pieces differ in scale, so that only how it turned is held against it. Where
    nothing is known of the covariance, as of a map that was taken in, nothing is.
    """
    rows = np.searchsorted(before.keyframe_ids, (keyframe_id, matched_id))
    Ts, Ts_new = before.Ts_world_body[rows], after.Ts_world_body[rows]
    moved = se3_log(se3_inverse(Ts) @ Ts_new)
    k = int(np.argmax(np.linalg.norm(moved, axis=1)))  # the end in the piece that is moved
    used = slice(3, 6) if with_scale else slice(0, 6)
    xi, covariance = moved[k, used], before.covariances[rows[k]][used, used]
    if not np.isfinite(covariance).all():
        return ""
    if xi @ np.linalg.pinv(covariance, hermitian=True) @ xi <= ASTRAY**2:
        return ""
    metres, degrees = np.linalg.norm(moved[k, :3]), np.degrees(np.linalg.norm(moved[k, 3:]))
    where = (
        f"{degrees:.0f}° turned" if with_scale else f"{metres:.2g} away and {degrees:.0f}° turned"
    )
    return f"joins two pieces of the map, but {where}: further than the camera can have come unseen"


@dataclass(frozen=True, eq=False)
class Closure:
    """Loops that are believed, and what the path becomes by them.

    Attributes:
        ties: the loops, one at least.
        before: the path that was read.
        after: the path corrected.
        fused: others that say the same: of these only landmarks are fused.
    """

    ties: tuple[Tie, ...]
    before: Essentials
    after: Corrected
    fused: tuple[Tie, ...] = ()

    def write(self, map: Map, known: Covisibility) -> dict[int, Carried]:
        """Move the keyframes, fuse what is one, and keep the measurement.

        Args:
            map: the map as it is now.
            known: keyframes that are not in it have come since.

        Returns:
            Of those how sure their parents were before, in units as of now, and what both are now:
            what a mapper that began before still says of them is relative to the former.
        """
        ids = map.keyframe_ids
        came = [acquaint(map, k) for k in ids[~np.isin(ids, known.keyframe_ids)].tolist()]
        parents = {k.keyframe_id: k.parent for k in came if k.parent >= 0}
        were = {k: (map.covariance(p), map.scale(p)) for k, p in parents.items()}
        map.apply(self._update(map))
        for keyframe in came:
            carry_covariance(map, keyframe)
        for tie in (*self.ties, *self.fused):
            _fuse(map, *tie)
        for newer, matched, found in self.ties:
            T, scale = found.T_matched_keyframe, found.scale
            map.add_edge(matched, newer, T, found.information, LOOP, scale_i_j=scale)
        return {
            k: Carried(stretched(sure, map.scale(p) / of), map.covariance(p), map.covariance(k))
            for (k, p), (sure, of) in zip(parents.items(), were.values())
        }

    def _update(self, map: Map) -> Update:
        """Return the correction, applied to where keyframes are now."""
        before, after = self.before, self.after
        read, solved = ((side.Ts_world_body, side.scales) for side in (before, after))
        root = int(before.keyframe_ids[before.root])
        ids, version = before.keyframe_ids, before.version
        return correction(map, ids, read, solved, root, version, after.covariances)


def _fuse(map: Map, newer: int, matched: int, found: Verified) -> None:
    """Join landmarks of both sides that are one point, and observe what either side shows."""
    map.fuse_landmarks(found.pairs[:, 1], found.pairs[:, 0])
    for k, seen in ((newer, found.seen_by_newer), (matched, found.seen_by_matched)):
        ids, taken = map.observations_of(k)
        is_free = ~np.isin(seen[:, 0], taken) & ~np.isin(map.resolve(seen[:, 1]), ids)
        map.add_observations(k, seen[is_free, 1], seen[is_free, 0])


def carry_covariance(map: Map, keyframe: Acquaintance) -> None:
    """Make a keyframe as sure as its parent is now, but for what odometry added since."""
    if keyframe.parent < 0:
        return
    growth, covariance = keyframe.growth, map.covariance(keyframe.parent)
    if not (np.isfinite(growth).all() and np.isfinite(covariance).all()):
        return
    values, axes = np.linalg.eigh(0.5 * (growth + growth.T))
    added = (axes * np.maximum(values, 0.0)) @ axes.T
    added = stretched(added, map.scale(keyframe.keyframe_id))
    T_parent_keyframe = keyframe.T_parent_keyframe.copy()
    T_parent_keyframe[:3, 3] *= map.scale(keyframe.parent)
    Ad = se3_adjoint(se3_inverse(T_parent_keyframe))
    map.set_covariance([keyframe.keyframe_id], Ad @ covariance @ Ad.T + added)
