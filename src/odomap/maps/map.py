"""The map: keyframes, where they are, the landmarks they see, and one lock around it all.

The law is that everything hangs from keyframes: frames, landmarks and stubs are stored relative to
one, in its units, so that correcting a path is one write of `states`. These units are the world's
when a keyframe is made, and others once a loop has corrected the scale. What is asked and solved is
in the world's units, also every covariance; what hangs is not: frames come and go by `relative` and
`place`, landmarks by `add_landmarks` and `points_world`.

Several threads share a map; each method takes the lock for as long as it copies or writes arrays,
never while something is solved. `version` grows with every change, `epoch` with every solution
written (poses a caller remembers from an earlier epoch are stale: place them from their keyframe).

    snapshot(ids) → solve without the lock → apply(update)

Methods are vectorised; they cost O(rows touched), not O(size of the map).

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015.
"""

import time
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.maps import writing
from odomap.maps.absorbing import Absorbed, absorb_tables
from odomap.maps.columns import distinct, distinct_in_order, members
from odomap.maps.copying import Copying
from odomap.maps.cutting import Cut, snapshot_from
from odomap.maps.snapshot import Snapshot, Update
from odomap.maps.states import act, act_inverse
from odomap.maps.surroundings import Surroundings
from odomap.maps.tables import MapTables
from odomap.maps.tree import ALIVE

__all__ = ["Map"]


PAUSE_S = 5e-5
"""Seconds for which the lock is left to others between two steps of a copy."""

LARGE = 50_000
"""Observations in a snapshot above which the map is copied first, in steps."""


class Map(Surroundings):
    """What is remembered of a part of the world, in one piece or several (`odomap.maps.atlas`).

    Keyframes and their poses come from `Skeleton`, landmarks and observations from `Sightings`,
    what lies around a place from `Surroundings`; here are the operations on all of them:
    forgetting, solving and laying open.
    """

    def dump(self) -> MapTables:
        """Return all that is remembered, as arrays: what `restored` makes a map of again.

        It is the map of one moment, though the lock is never held for as long as copying takes.
        """
        twin = self._twin()
        rows = len(twin.states)
        tables = {
            "states": twin.states.dump(),
            "tree": twin._tree.dump(rows),
            "landmarks": twin._landmarks.dump(),
            "observations": twin._observations.dump(rows),
        }
        return MapTables(
            columns={f"{t}/{c}": a for t, table in tables.items() for c, a in table.items()},
            keyframes=tuple(twin._keyframes[k] for k in sorted(twin._keyframes)),
            edges=twin._edges.table(),
            version=twin.version,
            epoch=twin.epoch,
            newest=twin._newest,
            next_keyframe=twin._next_keyframe,
            next_landmark=twin._landmarks.next_id,
        )

    def _twin(self) -> "Map":
        """Return the map as it is at one moment, to be read only; copied in small steps."""
        copying = Copying()
        try:
            with self.lock:
                copying.begin([*self._landmarks.columns(), *self._observations.columns()])
            while not self._is_nearly_copied(copying):
                # The lock is not fair: without a pause it would be taken again before a thread
                # that waits for it has woken.
                time.sleep(PAUSE_S)
            with self.lock:
                copies = copying.finished()
                twin = Map()
                twin.states, twin._tree = self.states.twin(), self._tree.twin()
                twin._landmarks = self._landmarks.twin(copies)
                twin._observations = self._observations.twin(copies)
                twin._keyframes, twin._edges = self._keyframes.copy(), self._edges.twin()
                twin._newest, twin._next_keyframe = self._newest, self._next_keyframe
                twin.version, twin.epoch = self.version, self.epoch
                return twin
        finally:
            with self.lock:
                copying.close()

    def _is_nearly_copied(self, copying: Copying) -> bool:
        with self.lock:
            if not copying.is_nearly_done:
                copying.step()
            return copying.is_nearly_done

    @classmethod
    def restored(cls, tables: MapTables) -> Self:
        """Return a map that goes on exactly as the one that was dumped would have.

        Args:
            tables: from `dump`; that they fit together is up to the caller (`files.mapfile`
                makes sure of it).
        """
        m = cls()
        m.states.restore(tables.of("states"))
        m._tree.restore(tables.of("tree"))
        m._landmarks.restore(tables.of("landmarks"), tables.next_landmark)
        m._observations.restore(tables.of("observations"))
        m._edges.restore(tables.edges)
        m._keyframes = {keyframe.id: keyframe for keyframe in tables.keyframes}
        m._newest, m._next_keyframe = tables.newest, tables.next_keyframe
        m.version, m.epoch = tables.version, tables.epoch
        return m

    def absorb(self, other: "Map") -> Absorbed:
        """Take in all of another map, as a piece of this one below a gap.

        Where the two lie to each other is not known: keyframes stay where they were in their own
        world, until a loop between the two says more. Nothing changes of what was there before,
        and the next keyframe hangs from where it would have.

        Args:
            other: stays as it is.

        Returns:
            What its keyframes and landmarks are called here.
        """
        tables = other.dump()
        with self.lock:
            offset, holder = self._next_keyframe, self._newest
            absorbed = absorb_tables(
                tables,
                offset,
                holder,
                self.version,
                self.states,
                self._tree,
                self._landmarks,
                self._observations,
                self._edges,
            )
            for keyframe in tables.keyframes:
                self._keyframes[offset + keyframe.id] = replace(keyframe, id=offset + keyframe.id)
            self._next_keyframe = offset + tables.next_keyframe
            self.version += tables.version + 1
            if holder < 0 <= tables.newest:
                self._newest = offset + tables.newest
            elif absorbed.root_id >= 0:
                self.begin_piece(absorbed.root_id)
        return absorbed

    def cull_keyframes(self, keyframe_ids: ArrayLike, holder_ids: ArrayLike | None = None) -> None:
        """Remove keyframes that add nothing, and keep placed what hangs from them.

        Each leaves a stub below its parent; its landmarks are stored relative to the oldest
        keyframe that still sees them, or else to the parent; its observations go. Those culled
        already are passed over, and so are both ends of a gap, which keep the pieces of the map
        apart. Several are culled one by one, with the lock free between.

        Args:
            keyframe_ids: (n,) keyframes; one at least must remain in the map.
            holder_ids: (n,) living keyframes, older than these, that are to hold their stubs, such
                as those nearest by; by default their parents.
        """
        with self.lock:
            ids = distinct_in_order(self._all_known(keyframe_ids))
            if len(ids) and np.isin(self._tree.alive(), ids).all():
                raise ValueError("culling would leave no keyframe in the map")
            holders = np.full(len(ids), -1) if holder_ids is None else self._all_known(holder_ids)
            if len(holders) != len(ids):
                raise ValueError(f"{len(ids)} keyframes to be culled have {len(holders)} holders")
        for n, (k, holder) in enumerate(zip(ids.tolist(), holders.tolist())):
            if n:
                time.sleep(PAUSE_S)
            with self.lock:
                if k in self._keyframes and k not in self._edges.ends_of_gaps():
                    self._cull(k, holder if holder < 0 else self._living(holder))

    def _cull(self, k: int, holder: int = -1) -> None:
        if len(self._keyframes) == 1:
            raise ValueError("culling would leave no keyframe in the map")
        keyframe = np.array([k])
        self._drop_observations_of(keyframe)
        slots = self._landmarks.anchored(keyframe)
        placement = self._tree.placements(self.states, keyframe)
        points = act(placement, self._landmarks.p_anchor[slots])
        holder = self._tree.cull(self.states, k, holder)
        heirs = self._observations.first_keyframe(slots)
        heirs[heirs < 0] = holder
        p_anchor = act_inverse(self.states.placements(heirs), points)
        self._landmarks.reanchor(slots, heirs, p_anchor)
        del self._keyframes[k]
        self._newest = holder if self._newest == k else self._newest
        self.version += 1

    def retire_keyframes(self, keyframe_ids: ArrayLike) -> None:
        """Forget what keyframes saw, and keep where they are: for odometry, which never returns.

        Payload and observations go, and landmarks that no keyframe sees any more.

        Args:
            keyframe_ids: (n,) keyframes; culled ones are passed over.
        """
        with self.lock:
            ids = distinct(self._ids(keyframe_ids))
            ids = ids[self._tree.status[self._all_known(ids)] == ALIVE]
            passed = self._drop_observations_of(ids), self._landmarks.anchored(ids)
            left = distinct(np.concatenate(passed))
            self._landmarks.remove(left[self._observations.count(left) == 0])
            for k in ids.tolist():
                self._keyframes[k] = self._keyframes[k].without_payload()
            self.version += 1

    def snapshot(
        self, keyframe_ids: ArrayLike, fixed_ids: ArrayLike = (), *, landmarks: bool = True
    ) -> Snapshot:
        """Copy a part of the map for a solver.

        Args:
            keyframe_ids: keyframes to solve for; those culled meanwhile are left out.
            fixed_ids: keyframes that hold them in place; one in both lists is fixed.
            landmarks: whether landmarks and observations are wanted; a pose graph needs none.

        Returns:
            The keyframes in the order given, fixed ones last, with the landmarks that a free one
            sees and all their observations in these keyframes.
        """
        held = distinct_in_order(self._ids(fixed_ids))
        free = self._ids(keyframe_ids)
        free = distinct_in_order(free[~np.isin(free, held)])
        with self.lock:
            cut = self._cut(free, held, landmarks, LARGE)
        if cut is None:
            cut = self._twin()._cut(free, held, landmarks)
        assert cut is not None
        return snapshot_from(cut)

    def _cut(
        self,
        free: NDArray[np.int64],
        held: NDArray[np.int64],
        landmarks: bool,
        most: float = np.inf,
    ) -> Cut | None:
        """Copy the rows of a part, or return None where it has more observations than allowed."""
        ids = self._all_known(np.concatenate([free, held]))
        is_alive = self._tree.status[ids] == ALIVE
        ids, num_free = ids[is_alive], int(is_alive[: len(free)].sum())
        if not len(ids):
            raise ValueError("a snapshot needs a keyframe that is in the map")
        seeing = ids if landmarks else ids[:0]
        if self._observations.count_of(seeing).sum() > most:
            return None
        indptr, rows = self._observations.of_keyframes(seeing)
        obs_slot, obs_keypoint = self._observations.sights(rows)
        slots = members(obs_slot[: indptr[min(num_free, len(seeing))]])
        anchors = self._landmarks.anchor.take(slots).astype(np.int64)
        return Cut(
            keyframes=tuple(self._keyframes[k] for k in ids.tolist()),
            ids=ids,
            num_free=num_free,
            placements=self.states.placements(ids),
            slots=slots,
            landmark_ids=self._landmarks.ids[slots],
            anchor_ids=anchors,
            anchors=self.states.placements(anchors),
            p_anchor=self._landmarks.p_anchor.take(slots),
            indptr=indptr,
            obs_slot=obs_slot,
            obs_keypoint=obs_keypoint,
            version=self.version,
            epoch=self.epoch,
        )

    def apply(self, update: Update) -> None:
        """Write a solution into the map as it is now (rules: `odomap.maps.snapshot`).

        Args:
            update: what was solved, from `Snapshot.solved` or made by hand.
        """
        with self.lock:
            self._known(update.anchor_id)
            self._all_known(update.keyframe_ids)
            C = writing.correction(self._tree, self.states, update)
            writing.move_keyframes(self._tree, self.states, update, C)
            writing.move_landmarks(self._landmarks, self.states, update, C)
            writing.drop_observations(self._observations, self._landmarks, update)
            self.version += 1
            self.epoch += 1

    def settle(
        self,
        landmark_ids: ArrayLike,
        anchors: NDArray[np.int64],
        before: NDArray[np.float64],
        after: NDArray[np.float64],
    ) -> None:
        """Move landmarks within their anchors, but for those that were moved by others meanwhile.

        Args:
            landmark_ids: (n,) landmarks.
            anchors: (n,) keyframes they were stored relative to when they were read.
            before: (n, 3) their places in these then, as `Snapshot.points_anchor` tells.
            after: (n, 3) their places in these from now on.
        """
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            rows = np.flatnonzero(slots >= 0)
            slots = slots[rows]
            landmarks = self._landmarks
            as_read = (landmarks.p_anchor.take(slots) == before[rows]).all(axis=1)
            as_read &= landmarks.anchor.take(slots) == anchors[rows]
            landmarks.p_anchor[slots[as_read]] = after[rows[as_read]]
            self.version += 1
            self.epoch += 1

    def _drop_observations_of(self, keyframes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Remove all observations of keyframes, and return the slots of what they saw."""
        _, rows = self._observations.of_keyframes(keyframes)
        slots = self._observations.sights(rows)[0].astype(np.int64)
        self._observations.remove(rows)
        return slots
