"""The skeleton of a map: keyframes, where they are, and how they hang together.

Frames are placed against keyframes, keyframes against each other: a spanning tree with the poses
beside it, and the measured edges between keyframes. Poses are read here for living keyframes and
for culled ones alike, so that a frame which hangs from a keyframe stays placed,

    T_world_frame = S_keyframe T_keyframe_frame,

whatever became of the keyframe. Every method takes the lock and costs O(ids asked for).

Reference: K. Konolige, J. Bowman, Towards lifelong visual maps, 2009 (views as a skeleton).
"""

import threading

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.geometry.lie import se3_inverse
from odomap.maps.edges import GAP, Edges, EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.maps.states import Placement, States, compose, inverse
from odomap.maps.tree import ABSENT, ALIVE, STUB, Tree

__all__ = ["Skeleton"]


class Skeleton:
    """Keyframes, states, spanning tree and edges under one lock; `Map` adds what they see.

    Attributes:
        lock: re-entrant; hold it to make several calls as one.
        states: poses, scales, velocities, biases and covariances by keyframe id. Touch it only
            while holding the lock.
        version: grows with every change.
        epoch: grows with every solution written.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.states = States()
        self.version = 0
        self.epoch = 0
        self._tree = Tree()
        self._keyframes: dict[int, Keyframe] = {}
        self._edges = Edges()
        self._next_keyframe = 0
        self._newest = -1

    @property
    def num_keyframes(self) -> int:
        """How many living keyframes there are."""
        return len(self._keyframes)

    def new_keyframe_id(self) -> int:
        """Reserve the id of a keyframe to be added."""
        with self.lock:
            self._next_keyframe += 1
            return self._next_keyframe - 1

    def add_keyframe(
        self,
        keyframe: Keyframe,
        T_world_body: NDArray[np.float64],
        *,
        parent: int = -1,
        covariance: NDArray[np.float64] | None = None,
        v_world_body: NDArray[np.float64] | None = None,
        scale: float = 1.0,
    ) -> None:
        """Add a keyframe.

        Args:
            keyframe: with an id from `new_keyframe_id`.
            T_world_body: (4, 4) where it is.
            parent: id of the keyframe it was placed against; by default the newest one.
            covariance: (6, 6) of T_world_body, right tangent; unknown (NaN) by default.
            v_world_body: (3,) velocity, m/s; unknown (NaN) by default.
            scale: world units per unit of the keyframe; what is new is in the world's.
        """
        with self.lock:
            k = keyframe.id
            if k < 0 or self._tree.status_of(k) != ABSENT:
                raise ValueError(f"keyframe {k}: the id is taken, use new_keyframe_id()")
            if np.shape(T_world_body) != (4, 4) or not np.isfinite(T_world_body).all():
                raise ValueError(f"keyframe {k}: T_world_body must be a finite (4, 4) array")
            holder = (
                self._living(self._newest if parent < 0 else parent) if len(self._keyframes) else -1
            )
            self.version += 1
            self._tree.add(k, holder, self.version)
            self.states.extend(k + 1)
            self.states.Ts_world_body[k] = T_world_body
            self.states.scales[k] = scale
            self.states.v_world_body[k] = np.nan if v_world_body is None else v_world_body
            self.states.covariances[k] = np.nan if covariance is None else covariance
            self.states.growths[k] = np.nan
            self._keyframes[k] = keyframe
            self._next_keyframe = max(self._next_keyframe, k + 1)
            self._newest = k

    def keyframe(self, keyframe_id: int) -> Keyframe:
        """Return a living keyframe; one that was retired has no payload any more."""
        with self.lock:
            if keyframe_id not in self._keyframes:
                raise KeyError(f"keyframe {keyframe_id} is not in the map (culled?)")
            return self._keyframes[keyframe_id]

    @property
    def keyframe_ids(self) -> NDArray[np.int64]:
        """(K,) ids of living keyframes in order."""
        with self.lock:
            return self._tree.alive()

    def is_keyframe_alive(self, keyframe_id: int) -> bool:
        """Return whether a keyframe is in the map and not culled."""
        with self.lock:
            return self._tree.status_of(keyframe_id) == ALIVE

    def parent(self, keyframe_id: int) -> int:
        """Return the living parent of a keyframe or stub in the spanning tree, -1 for the root."""
        with self.lock:
            return int(self._tree.parent[self._known(keyframe_id)])

    def tree(self) -> Tree:
        """Return the spanning tree, copied."""
        with self.lock:
            return self._tree.twin()

    def T_world_body(self, keyframe_id: int) -> NDArray[np.float64]:
        """Return the (4, 4) pose of a keyframe, also of a culled one."""
        return np.asarray(self.Ts_world_body(np.array([keyframe_id]))[0])

    def placements(self, keyframe_ids: ArrayLike) -> Placement:
        """Return the (n, 4, 4) poses and the (n,) scales of keyframes, also of culled ones."""
        with self.lock:
            return self._tree.placements(self.states, self._all_known(keyframe_ids))

    def Ts_world_body(self, keyframe_ids: ArrayLike) -> NDArray[np.float64]:
        """Return the (n, 4, 4) poses of keyframes, also of culled ones."""
        return self.placements(keyframe_ids)[0]

    def scale(self, keyframe_id: int) -> float:
        """Return the world units per unit of a keyframe, also of a culled one."""
        return float(self._placement(keyframe_id)[1])

    def place(self, keyframe_id: int, T_keyframe_body: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of a frame that hangs from a keyframe, also from a culled one.

        Args:
            keyframe_id: the keyframe.
            T_keyframe_body: (4, 4) or (n, 4, 4) relative pose, in the keyframe's units.

        Returns:
            T_world_body, of the same shape.
        """
        placement = self._placement(keyframe_id)
        return compose(placement, (np.asarray(T_keyframe_body), np.ones(())))[0]

    def relative(self, keyframe_id: int, T_world_body: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how a frame hangs from a keyframe, also from a culled one: the inverse of `place`.

        Args:
            keyframe_id: the keyframe.
            T_world_body: (4, 4) or (n, 4, 4) where the frame is.

        Returns:
            T_keyframe_body, of the same shape, in the keyframe's units.
        """
        T_world_keyframe, scale = self._placement(keyframe_id)
        T = np.asarray(se3_inverse(T_world_keyframe) @ T_world_body)
        T[..., :3, 3] /= scale
        return T

    def covariance(self, keyframe_id: int) -> NDArray[np.float64]:
        """Return the (6, 6) covariance of a keyframe's pose, right tangent; NaN where unknown."""
        with self.lock:
            return np.array(self.states.covariances[self._known(keyframe_id)])

    def covariances(self, keyframe_ids: ArrayLike) -> NDArray[np.float64]:
        """Return the (n, 6, 6) covariances of keyframes' poses; NaN where unknown."""
        with self.lock:
            return np.array(self.states.covariances[self._all_known(keyframe_ids)])

    def set_covariance(self, keyframe_ids: ArrayLike, covariances: NDArray[np.float64]) -> None:
        """Write the (n, 6, 6) covariances, or one (6, 6), of keyframes."""
        with self.lock:
            self.states.covariances[self._all_known(keyframe_ids)] = covariances
            self.version += 1

    def growth(self, keyframe_id: int) -> NDArray[np.float64]:
        """Return the (6, 6) by which a keyframe is less sure than its parent, NaN where unknown.

        As odometry said when it was mapped (`odomap.maps.growth`); loops have no part in it.
        """
        with self.lock:
            return np.array(self.states.growths[self._known(keyframe_id)])

    def set_growth(self, keyframe_id: int, growth: NDArray[np.float64]) -> None:
        """Write the (6, 6) by which a keyframe is less sure than its parent, in its own units."""
        with self.lock:
            self.states.growths[self._known(keyframe_id)] = growth
            self.version += 1

    def add_edge(
        self,
        i: int,
        j: int,
        T_i_j: NDArray[np.float64],
        information: NDArray[np.float64],
        kind: str,
        *,
        scale_i_j: float = 1.0,
    ) -> int:
        """Keep a measured relative pose of two keyframes.

        Args:
            i: keyframe measured from.
            j: keyframe measured.
            T_i_j: (4, 4) pose of j in i, in the units of i.
            information: (6, 6), tangent (translation, rotation), right update.
            kind: what measured it, such as "odometry" or "loop".
            scale_i_j: units of i per unit of j.

        Returns:
            The row of the edge.
        """
        with self.lock:
            ends = self._known(i), self._known(j)
            self.version += 1
            return self._edges.add(*ends, T_i_j, information, kind, scale_i_j)

    def replace_edges(self, rows: ArrayLike, others: EdgeTable) -> None:
        """Have other edges in place of some that were measured.

        Args:
            rows: (n,) of `edges`; those that follow move up.
            others: appended.

        Raises:
            ValueError: there is no such row.
        """
        with self.lock:
            gone = self._ids(rows)
            if len(gone) and not 0 <= gone.min() <= gone.max() < len(self._edges):
                raise ValueError(f"there is no edge {gone.max()}, only {len(self._edges)}")
            self._all_known(np.concatenate([others.i, others.j]))
            self._edges.replace(gone, others)
            self.version += 1

    def begin_piece(self, keyframe_id: int) -> None:
        """Say that where a keyframe is relative to its parent is not known: an edge of kind "gap".

        It begins a piece of the map (`odomap.maps.atlas`). The root of the tree needs no saying.

        Args:
            keyframe_id: a living keyframe without children yet.
        """
        with self.lock:
            parent = self.parent(keyframe_id)
            if parent < 0:
                return
            S_i, S_j = (self.states.placements(np.array([k])) for k in (parent, keyframe_id))
            T, scale = compose(inverse(S_i), S_j)
            none = np.zeros((6, 6))
            self.add_edge(parent, keyframe_id, T[0], none, GAP, scale_i_j=float(scale[0]))

    def edges(self) -> EdgeTable:
        """Return all edges, copied."""
        with self.lock:
            twin = self._edges.twin()
        return twin.table()

    def _placement(self, keyframe_id: int) -> Placement:
        """Return the (4, 4) pose and the scale of a keyframe, also of a culled one."""
        with self.lock:
            if self._tree.status_of(keyframe_id) == ALIVE:  # nearly all: asked for at every frame
                states = self.states
                return states.Ts_world_body[keyframe_id].copy(), states.scales[keyframe_id]
            Ts, scales = self._tree.placements(self.states, self._all_known([keyframe_id]))
        return Ts[0], scales[0]

    @staticmethod
    def _ids(ids: ArrayLike) -> NDArray[np.int64]:
        array = np.asarray(ids)
        if array.size and array.dtype.kind not in "iu":
            raise TypeError(f"ids must be integers, not {array.dtype}")
        return np.atleast_1d(array).astype(np.int64, copy=False)

    def _known(self, keyframe_id: int) -> int:
        if self._tree.status_of(keyframe_id) == ABSENT:
            raise KeyError(f"keyframe {keyframe_id} was never in the map")
        return keyframe_id

    def _all_known(self, keyframe_ids: ArrayLike) -> NDArray[np.int64]:
        ids = self._ids(keyframe_ids)
        inside = (ids >= 0) & (ids < len(self._tree.status))
        if not inside.all() or (self._tree.status[ids] == ABSENT).any():
            for k in ids.tolist():
                self._known(k)
        return ids

    def _living(self, keyframe_id: int) -> int:
        """Return a keyframe, or the one that holds its stub."""
        if self._tree.status_of(self._known(keyframe_id)) == STUB:
            return int(self._tree.parent[keyframe_id])
        return keyframe_id
