"""The map against a model of dictionaries, under random interleavings.

The model is the law of DESIGN §3 written as plainly as possible: one 4x4 similarity per keyframe,
dictionaries of landmarks and observations, stubs that are never flattened, loops instead of arrays.
A state machine mutates both alike, with snapshots taken and applied at any moment between.
"""

import copy
from dataclasses import dataclass, field

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Update

SEEDS = st.integers(0, 2**32 - 1)


def random_pose(rng, spread=2.0):
    T = np.eye(4)
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T[:3, :3] = Q * np.sign(np.linalg.det(Q))
    T[:3, 3] = rng.normal(size=3) * spread
    return T


def similarity(T, s):
    S = T.copy()
    S[:3, :3] *= s
    return S


def times(S, p):
    return S[:3, :3] @ p + S[:3, 3]


def scale_of(S):
    return np.cbrt(np.linalg.det(S[:3, :3]))


def rigid(S):
    T = S.copy()
    T[:3, :3] /= scale_of(S)
    return T


@dataclass
class Model:
    S: dict = field(default_factory=dict)  # living keyframes
    parent: dict = field(default_factory=dict)  # as given, never rewritten
    order: list = field(default_factory=list)  # in order of creation
    holder: dict = field(default_factory=dict)  # culled -> (holder at that time, S_holder_self)
    points: dict = field(default_factory=dict)  # landmark -> (anchor, p_anchor)
    obs: dict = field(default_factory=dict)  # (keyframe, landmark) -> keypoint
    heir: dict = field(default_factory=dict)  # fused landmark -> survivor
    seen: dict = field(default_factory=dict)
    expected: dict = field(default_factory=dict)
    descriptor: dict = field(default_factory=dict)

    def place(self, k):
        if k in self.S:
            return self.S[k]
        holder, S_holder_self = self.holder[k]
        return self.place(holder) @ S_holder_self

    def living_parent(self, k):
        p = self.parent[k]
        while p in self.holder:
            p = self.holder[p][0]
        return -1 if p == k else p

    def resolve(self, landmark):
        while landmark in self.heir:
            landmark = self.heir[landmark]
        return landmark if landmark in self.points else -1

    def world(self, landmark):
        anchor, p = self.points[landmark]
        return times(self.S[anchor], p)

    def observers(self, landmark):
        return sorted(k for k, x in self.obs if x == landmark)

    def cull(self, k):
        parent = self.living_parent(k)
        if parent < 0:
            parent = next(c for c in self.order if c in self.S and self.living_parent(c) == k)
        world = {x: self.world(x) for x, (anchor, _) in self.points.items() if anchor == k}
        self.obs = {pair: n for pair, n in self.obs.items() if pair[0] != k}
        self.holder[k] = parent, np.linalg.inv(self.S[parent]) @ self.S.pop(k)
        for x, point in world.items():
            heir = (self.observers(x) or [parent])[0]
            self.points[x] = heir, times(np.linalg.inv(self.S[heir]), point)

    def retire(self, ids):
        left = {x for k, x in self.obs if k in ids}
        left |= {x for x, (anchor, _) in self.points.items() if anchor in ids}
        self.obs = {pair: n for pair, n in self.obs.items() if pair[0] not in ids}
        for x in left:
            if not self.observers(x):
                del self.points[x]

    def remove(self, landmark):
        del self.points[landmark]
        self.obs = {pair: n for pair, n in self.obs.items() if pair[1] != landmark}

    def fuse(self, pairs):
        groups = {}
        for winner, loser in pairs:
            winner, loser = self.resolve(winner), self.resolve(loser)
            while winner in groups:
                winner = groups[winner]
            while loser in groups:
                loser = groups[loser]
            if winner >= 0 and loser >= 0 and winner != loser:
                groups[loser] = winner
        for loser in sorted(groups):
            winner = groups[loser]
            while winner in groups:
                winner = groups[winner]
            for k in self.observers(loser):
                n = self.obs.pop((k, loser))
                self.obs.setdefault((k, winner), n)
            del self.points[loser]
            self.heir[loser] = winner
            self.seen[winner] += self.seen[loser]
            self.expected[winner] += self.expected[loser]

    def apply(self, update, born):
        """`born`: keyframes that were there when the snapshot was taken."""
        S_solved = similarity(update.T_world_anchor, update.scale_anchor)
        C = self.place(update.anchor_id) @ np.linalg.inv(S_solved)
        old = dict(self.S)
        moved = set()
        for k, T, s in zip(update.keyframe_ids, update.Ts_world_body, update.scales):
            if k in self.S:
                self.S[k] = C @ similarity(T, s)
                moved.add(k)
        for k in self.order:
            parent = self.living_parent(k) if k in self.S else -1
            if k in self.S and k not in born and k not in moved and parent in moved:
                self.S[k] = self.S[parent] @ np.linalg.inv(old[parent]) @ old[k]
                moved.add(k)
        written = {}
        for x, p in zip(update.landmark_ids.tolist(), update.points_world):
            survivor = self.resolve(x)
            if survivor >= 0 and (x == survivor or survivor not in written):
                written[survivor] = p
        for x, p in written.items():
            anchor = self.points[x][0]
            self.points[x] = anchor, times(np.linalg.inv(self.S[anchor]) @ C, p)
        for k, x, n in zip(
            update.dropped_keyframes, update.dropped_landmarks, update.dropped_keypoints
        ):
            pair = int(k), self.resolve(int(x))
            if self.obs.get(pair) == n:
                del self.obs[pair]


class MapMachine(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.map, self.model = Map(), Model()
        self.pending = []
        self.landmarks_ever = 0
        self.version = self.epoch = self.step = 0

    def rng(self, seed):
        self.step += 1  # hypothesis likes small seeds: without this, steps would repeat each other
        return np.random.default_rng([seed, self.step])

    def changed(self, epoch=False):
        assert self.map.version > self.version
        assert (self.map.epoch > self.epoch) == epoch
        self.version, self.epoch = self.map.version, self.map.epoch

    def some(self, rng, values, number):
        values = list(values)
        return [values[n] for n in rng.integers(0, len(values), number)] if values else []

    @initialize(seed=SEEDS)
    def begin(self, seed):
        for _ in range(4):
            self.add_keyframe(seed)
            self.add_landmarks(seed)
            self.add_landmarks(seed)
            self.observe(seed)
            self.observe(seed)

    @rule(seed=SEEDS)
    def add_keyframe(self, seed):
        rng = self.rng(seed)
        known = [*self.model.S, *self.model.holder]
        parent = self.some(rng, known, 1)[0] if known and rng.random() < 0.7 else -1
        T, k = random_pose(rng), self.map.new_keyframe_id()
        scale = float(np.exp(rng.normal())) if rng.random() < 0.3 else 1.0
        newest = [j for j in self.model.order if j in self.model.S][-1:] or [-1]
        self.map.add_keyframe(Keyframe(k, 10 * k), T, parent=parent, scale=scale)
        if parent < 0 and known:
            parent = self.map.parent(k)
            assert parent in self.model.S
            if not self.model.holder:
                assert parent == newest[0]
        self.model.parent[k] = parent
        self.model.order.append(k)
        self.model.S[k] = similarity(T, scale)
        self.changed()

    @rule(seed=SEEDS)
    def add_landmarks(self, seed):
        rng = self.rng(seed)
        number = int(rng.integers(1, 6))
        anchors = self.some(rng, [*self.model.S, *self.model.holder], number)
        p = rng.normal(size=(number, 3))
        look = rng.integers(0, 256, (number, 32), np.uint8)
        ids = self.map.add_landmarks(np.array(anchors), p, look)
        assert ids.tolist() == list(range(self.landmarks_ever, self.landmarks_ever + number))
        self.landmarks_ever += number
        for x, anchor, point in zip(ids.tolist(), anchors, p):
            if anchor in self.model.holder:
                world = times(self.model.place(anchor), point)
                while anchor in self.model.holder:
                    anchor = self.model.holder[anchor][0]
                point = times(np.linalg.inv(self.model.S[anchor]), world)
            self.model.points[x] = anchor, point
            self.model.seen[x] = self.model.expected[x] = 0
        self.model.descriptor |= dict(zip(ids.tolist(), look))
        self.changed()

    @rule(seed=SEEDS)
    def observe(self, seed):
        rng = self.rng(seed)
        k = self.some(rng, self.model.S, 1)[0]
        landmarks = rng.integers(-1, self.landmarks_ever, 8)
        keypoints = rng.integers(0, 1000, 8)
        added = self.map.add_observations(k, landmarks, keypoints)
        before = len(self.model.obs)
        for x, n in zip(landmarks.tolist(), keypoints.tolist()):
            if (x := self.model.resolve(x)) >= 0:
                self.model.obs[k, x] = n
        assert added == len(self.model.obs) - before
        self.map.count_seen(landmarks)
        for x in landmarks.tolist():
            if (x := self.model.resolve(x)) >= 0:
                self.model.seen[x] += 1
        self.changed()

    @rule(seed=SEEDS)
    def expect_and_describe(self, seed):
        rng = self.rng(seed)
        landmarks = rng.integers(-1, self.landmarks_ever, 8)
        self.map.count_expected(landmarks)
        for x in landmarks.tolist():
            if (x := self.model.resolve(x)) >= 0:
                self.model.expected[x] += 1
        self.changed()
        look = rng.integers(0, 256, (8, 32), np.uint8)
        self.map.set_descriptors(landmarks, look)
        for x, row in zip(landmarks.tolist(), look):
            if x in self.model.points:
                self.model.descriptor[x] = row
        self.changed()

    @precondition(lambda self: self.model.holder)
    @rule(seed=SEEDS)
    def observe_from_culled(self, seed):
        k = self.some(self.rng(seed), self.model.holder, 1)[0]
        assert (
            self.map.add_observations(
                k, np.arange(self.landmarks_ever), np.arange(1000)[: self.landmarks_ever]
            )
            == 0
        )

    @rule(seed=SEEDS)
    def remove_observations(self, seed):
        rng = self.rng(seed)
        pairs = self.some(rng, self.model.obs, 3)
        pairs += [(k, x + 1) for k, x in pairs]
        self.map.remove_observations([k for k, _ in pairs], [x for _, x in pairs])
        for k, x in pairs:
            self.model.obs.pop((k, self.model.resolve(x)), None)
        self.changed()

    @rule(seed=SEEDS)
    def remove_landmarks(self, seed):
        ids = self.rng(seed).integers(0, self.landmarks_ever, 2)
        self.map.remove_landmarks(ids)
        for x in ids.tolist():
            if (x := self.model.resolve(x)) >= 0:
                self.model.remove(x)
        self.changed()

    @rule(seed=SEEDS)
    def fuse(self, seed):
        pairs = self.rng(seed).integers(0, self.landmarks_ever, (3, 2))
        self.map.fuse_landmarks(pairs[:, 0], pairs[:, 1])
        self.model.fuse(pairs.tolist())
        self.changed()

    @precondition(lambda self: len(self.model.S) > 2)
    @rule(seed=SEEDS)
    def cull(self, seed):
        ids = self.some(self.rng(seed), self.model.S, 2)
        frames = {k: self.map.place(k, random_pose(np.random.default_rng(k))) for k in ids}
        self.map.cull_keyframes(ids)
        for k in dict.fromkeys(ids):
            self.model.cull(k)
        for k, T in frames.items():  # frames that hang from it stay placed
            np.testing.assert_allclose(
                self.map.place(k, random_pose(np.random.default_rng(k))), T, atol=1e-9
            )
        self.changed()

    @rule(seed=SEEDS)
    def retire(self, seed):
        ids = self.some(self.rng(seed), self.model.S, 1)
        self.map.retire_keyframes(ids)
        self.model.retire(set(ids))
        self.changed()

    @rule(seed=SEEDS)
    def snapshot(self, seed):
        rng = self.rng(seed)
        known = [*self.model.S, *self.model.holder]
        free, fixed = self.some(rng, known, 4), self.some(rng, known, int(rng.integers(0, 3)))
        if not (set(free) | set(fixed)) & set(self.model.S):
            return
        snapshot = self.map.snapshot(free, fixed)
        kept = [k for k in dict.fromkeys(free) if k not in fixed] + list(dict.fromkeys(fixed))
        kept = [k for k in kept if k in self.model.S]
        assert snapshot.keyframe_ids.tolist() == kept
        assert snapshot.is_fixed.tolist() == [k in fixed for k in kept]
        assert [k.id for k in snapshot.keyframes] == kept
        wanted = {x for k, x in self.model.obs if k in kept and k not in fixed}
        assert set(snapshot.landmark_ids.tolist()) == wanted
        rows = zip(
            snapshot.keyframe_ids[snapshot.obs_keyframe].tolist(),
            snapshot.landmark_ids[snapshot.obs_landmark].tolist(),
            snapshot.obs_keypoint.tolist(),
        )
        expected = {p: n for p, n in self.model.obs.items() if p[0] in kept and p[1] in wanted}
        assert {(k, x): n for k, x, n in rows} == expected
        assert len(snapshot.obs_keypoint) == len(expected)
        self.pending.append((snapshot, copy.deepcopy(snapshot), set(self.model.order)))

    @precondition(lambda self: self.pending)
    @rule(seed=SEEDS)
    def apply(self, seed):
        rng = self.rng(seed)
        snapshot, taken, born = self.pending.pop(int(rng.integers(len(self.pending))))
        for name, value in vars(taken).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(getattr(snapshot, name), value)
        Ts = np.array([T @ random_pose(rng, 0.3) for T in snapshot.Ts_world_body])
        points = snapshot.points_world + rng.normal(size=snapshot.points_world.shape)
        scales = snapshot.scales * np.exp(0.3 * rng.normal(size=len(Ts)))
        wrong = np.flatnonzero(rng.random(len(snapshot.obs_keypoint)) < 0.3)
        solved = scales if rng.random() < 0.5 else None
        update: Update = snapshot.solved(Ts, points, scales=solved, dropped=wrong)
        anchor = self.map.T_world_body(snapshot.anchor_id), self.map.scale(snapshot.anchor_id)
        self.map.apply(update)
        self.model.apply(update, born)
        if snapshot.anchor_id in self.model.S:
            after = self.map.T_world_body(snapshot.anchor_id), self.map.scale(snapshot.anchor_id)
            np.testing.assert_allclose(after[0], anchor[0], atol=1e-7)
            np.testing.assert_allclose(after[1], anchor[1], rtol=1e-9)
        self.changed(epoch=True)

    @invariant()
    def agrees_with_the_model(self):
        if not self.model.order:
            return
        model, m = self.model, self.map
        assert m.keyframe_ids.tolist() == sorted(model.S)
        assert m.landmark_ids.tolist() == sorted(model.points)
        everyone = np.array(model.order)
        placed = [model.place(k) for k in model.order]
        np.testing.assert_allclose(m.Ts_world_body(everyone), [rigid(S) for S in placed], atol=1e-7)
        scales = [m.scale(k) for k in model.order]
        np.testing.assert_allclose(scales, [scale_of(S) for S in placed], rtol=1e-7)
        assert [m.parent(k) for k in model.S] == [model.living_parent(k) for k in model.S]
        assert sum(m.parent(k) < 0 for k in model.S) == 1
        ids = np.arange(self.landmarks_ever)
        resolved = [model.resolve(x) for x in ids.tolist()]
        assert m.resolve(ids).tolist() == resolved
        assert m.is_alive(ids).tolist() == [x >= 0 for x in resolved]
        world = [np.full(3, np.nan) if x < 0 else model.world(x) for x in resolved]
        np.testing.assert_allclose(m.points_world(ids), np.array(world), rtol=1e-6, atol=1e-6)
        alive = np.array(sorted(model.points), np.int64)
        assert set(m.anchors(alive).tolist()) <= set(model.S)
        assert m.anchors(alive).tolist() == [model.points[x][0] for x in alive.tolist()]
        assert m.seen(alive).tolist() == [model.seen[x] for x in alive.tolist()]
        assert m.expected(alive).tolist() == [model.expected[x] for x in alive.tolist()]
        look = [model.descriptor[x] for x in alive.tolist()]
        np.testing.assert_array_equal(m.descriptors(alive), np.reshape(look, (-1, 32)))

    @invariant()
    def both_views_tell_the_same(self):
        model, m = self.model, self.map
        assert m.num_observations == len(model.obs)
        shared = {k: {x for j, x in model.obs if j == k} for k in model.S}
        by_keyframe = {}
        for k in model.S:
            landmarks, keypoints = m.observations_of(k)
            by_keyframe |= {(k, x): n for x, n in zip(landmarks.tolist(), keypoints.tolist())}
            ids, counts = m.covisible(k)
            truth = {j: len(shared[k] & s) for j, s in shared.items() if j != k and shared[k] & s}
            assert dict(zip(ids.tolist(), counts.tolist())) == truth
            assert counts.tolist() == sorted(counts.tolist(), reverse=True)
        alive = np.array(sorted(model.points), np.int64)
        indptr, keyframes, keypoints = m.observers_of(alive)
        landmarks = np.repeat(alive, np.diff(indptr)).tolist()
        by_landmark = dict(zip(zip(keyframes.tolist(), landmarks), keypoints.tolist()))
        assert by_keyframe == by_landmark == model.obs
        assert m.count_observers(alive).tolist() == [
            len(model.observers(x)) for x in alive.tolist()
        ]

    @invariant()
    def what_lies_around_is_found(self):
        if not self.model.order or self.step % 3:
            return
        model, m, rng = self.model, self.map, np.random.default_rng(self.step)
        asked = rng.integers(-1, self.landmarks_ever, 6)
        known = {model.resolve(x) for x in asked.tolist()} - {-1}
        counts = {k: sum((k, x) in model.obs for x in known) for k in model.S}
        ranked = sorted((-n, k) for k, n in counts.items() if n)
        ids, numbers = m.observing(asked)
        assert list(zip((-numbers).tolist(), ids.tolist())) == ranked
        keyframes = self.some(rng, [*model.S, *model.holder], 3)
        seen = {x for k, x in model.obs if k in keyframes}
        assert m.landmarks_of(keyframes).tolist() == sorted(seen)
        mount = random_pose(rng)
        views = m.views_of(asked, mount)
        assert views.ids.tolist() == sorted(known)
        for n, x in enumerate(views.ids.tolist()):
            at, anchor = model.world(x), model.points[x][0]
            watchers = model.observers(x) or [anchor]
            rays = {k: at - times(model.S[k], mount[:3, 3]) for k in watchers}
            total = sum(ray / np.linalg.norm(ray) for ray in rays.values())
            reference = rays[anchor if anchor in rays else min(rays)]
            np.testing.assert_allclose(views.points_world[n], at, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(views.distance[n], np.linalg.norm(reference), rtol=1e-5)
            if np.linalg.norm(total) > 1e-3:
                np.testing.assert_allclose(
                    views.normals[n], total / np.linalg.norm(total), atol=1e-3
                )
            np.testing.assert_array_equal(views.descriptors[n], model.descriptor[x])
            assert views.level[n] == 0
        here, radius, angle = random_pose(rng), 4.0, 1.5
        distance = {k: np.linalg.norm(S[:3, 3] - here[:3, 3]) for k, S in model.S.items()}
        turn = {
            k: np.arccos(np.clip(0.5 * (np.trace(rigid(S)[:3, :3].T @ here[:3, :3]) - 1), -1, 1))
            for k, S in model.S.items()
        }
        close = [k for k in model.S if distance[k] <= radius and turn[k] <= angle]
        assert m.near(here, radius, angle).tolist() == sorted(close, key=lambda k: distance[k])


TestMapMachine = MapMachine.TestCase
TestMapMachine.settings = settings(
    max_examples=40, stateful_step_count=40, deadline=None, derandomize=True, database=None
)
