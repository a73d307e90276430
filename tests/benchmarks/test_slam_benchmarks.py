"""Benchmarks of SLAM: what they make, count and hold against a bar; nothing is timed here."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp
from odomap.geometry.trajectory import Trajectory
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.simulation.world import World
from odomap.vision.features import Features

# ---- rounds ----


@pytest.fixture
def rounds(load):
    return load("rounds")


def test_what_grows_from_the_second_round_on_is_told(rounds):
    def held(keyframes, lost=0):
        return rounds.Held(keyframes, 1000, 2.0, 30.0, lost, 10.0)

    assert rounds.below_bars("x", [held(10), held(100), held(130)]) == []
    (said,) = rounds.below_bars("x", [held(10), held(100), held(131)])
    assert said.startswith("x: keyframes after round 3: 1.31 times")
    assert rounds.below_bars("x", [held(10, 1), held(10, 2)]) == ["x: 3 frames lost"]


def test_rooms_are_gone_round_as_often_as_asked_for(rounds):
    options = SimpleNamespace(
        resolution="64x48", rate=10.0, speed=0.6, seed=1, rounds=3, periodic=False
    )
    world, each = rounds.room(options)
    assert len(world) == 3 * each
    places = world.truth.Ts_world_body[:, :3, 3]
    again = np.linalg.norm(places[each:] - places[:-each], axis=1)
    across = np.linalg.norm(places - places.mean(0), axis=1)
    assert np.median(again) < 0.3 < np.median(across)


def test_periodic_rounds_are_the_same_again(rounds):
    world = World.make(frames=2, resolution=(64, 48))
    path = rounds.periodic(world.path)
    times = np.linspace(0, 10, 7)
    here, later = path.at(times), path.at(times + 1 / path.rounds_per_s)
    np.testing.assert_allclose(later.Ts_world_body, here.Ts_world_body, atol=1e-9)
    swaying = world.path.at(times).Ts_world_body[:, :3, 3]
    assert np.linalg.norm(swaying - here.Ts_world_body[:, :3, 3], axis=1).max() < 0.5


def test_rendered_frames_are_those_of_the_world(rounds, tmp_path):
    world = World.make(frames=3, resolution=(64, 48), sensors=("stereo", "depth"))
    rendered = rounds.Rendered.of(world, tmp_path)
    assert len(rendered) == 3
    for index, frame in enumerate(rendered):
        expected = world.frame(index)
        assert (frame.id, frame.stamp_ns) == (expected.id, expected.stamp_ns)
        for image, other in zip(frame.images, expected.images, strict=True):
            np.testing.assert_array_equal(image, other)
        np.testing.assert_array_equal(frame.depth, expected.depth)


# ---- growth ----


def small_map(keyframes=4, landmarks=60, seed=0):
    """Return a map of a few keyframes along a way, each of which sees some landmarks."""
    rng = np.random.default_rng(seed)
    m = Map()
    looks = rng.integers(0, 256, (landmarks, 32), np.uint8)
    for k in range(keyframes):
        xyz = rng.normal(size=(landmarks, 3))
        features = Features(
            rng.uniform(0, 100, (landmarks, 2)).astype(np.float32),
            looks,
            xyz / np.linalg.norm(xyz, axis=1, keepdims=True),
            rng.uniform(1, 5, landmarks),
            np.zeros(landmarks, np.uint8),
        )
        T = se3_exp(np.array([2.0 * k, 0.1 * k, 0.0, 0.0, 0.1 * k, 0.0]))
        m.add_keyframe(Keyframe(m.new_keyframe_id(), k, features=features), T)
    anchors = rng.integers(0, keyframes, landmarks)
    ids = m.add_landmarks(anchors, rng.normal(size=(landmarks, 3)), looks)
    for k in range(keyframes):
        which = np.sort(rng.choice(landmarks, 20, replace=False))
        m.add_observations(k, ids[which], which)
    m.remove_landmarks(ids[::7])
    return m


def distances(a, b):
    return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(2)


def test_copies_of_a_stretch_are_shifted_and_strangers(load):
    growth = load("growth")
    original = small_map()
    m = small_map()
    growth.grow(m, growth.Stretch.of(original), 8)
    ids, old = m.keyframe_ids, original.landmark_ids
    new = np.setdiff1d(m.landmark_ids, old)
    assert (len(ids), len(new)) == (8, len(old))
    moved = m.points_world(new) - original.points_world(old)
    np.testing.assert_allclose(moved - moved[0], 0.0, atol=1e-9)
    way = np.linalg.norm(np.diff(m.Ts_world_body(ids)[[0, 3], :3, 3], axis=0))
    assert np.linalg.norm(moved[0]) == pytest.approx(way + growth.GAP_M)
    mine, theirs = original.descriptors(old), m.descriptors(new)
    np.testing.assert_array_equal(distances(theirs, theirs), distances(mine, mine))
    assert np.diag(distances(mine, theirs)).min() > 80
    for k in range(4):
        seen, at = original.observations_of(k)
        copied, there = m.observations_of(int(ids[4 + k]))
        np.testing.assert_array_equal(np.searchsorted(new, copied), np.searchsorted(old, seen))
        np.testing.assert_array_equal(there, at)
        features = m.keyframe(int(ids[4 + k])).features
        np.testing.assert_array_equal(features.descriptors[there], m.descriptors(copied))


def test_map_grows_to_the_size_asked_for(load):
    growth = load("growth")
    m, stretch = small_map(), growth.Stretch.of(small_map())
    growth.grow(m, stretch, 15)
    assert m.num_keyframes == 15
    for k in m.keyframe_ids.tolist():
        assert np.isfinite(m.points_world(m.observations_of(k)[0])).all()


def test_cost_is_compared_frame_by_frame(load):
    growth = load("growth")
    ms = np.array([[10.0, 11.0], [100.0, 90.0], [20.0, 24.0], [0.0, 5.0]])
    assert growth.ratio(ms) == pytest.approx(1.1)
    good = {"ratio": dict.fromkeys(growth.COSTS, 1.05) | {"map": 5.0}, "off_m": 0.0}
    assert growth.below_bars("x", good) == []
    slow = {"ratio": dict.fromkeys(growth.COSTS, 1.11), "off_m": 1e-9}
    assert len(growth.below_bars("x", slow)) == 3


# ---- localise ----


def test_errors_of_localised_frames_are_those_of_the_same_instants(load):
    localise = load("localise")
    steps = [se3_exp(np.array([0.1 * k, 0.02 * k * k, 0, 0, 0, 0.05 * k])) for k in range(20)]
    whole = Trajectory(np.arange(20) * 10, np.array(steps))
    off = se3_exp(np.array([0.01, 0, 0, 0, 0, 0])) @ se3_exp(np.array([0, 0, 0, 0.01, 0, 0]))
    placed = Trajectory(whole.stamps_ns[1::2], whole.Ts_world_body[1::2] @ off)
    errors = localise.errors(placed, whole)
    assert [errors["median_m"], errors["worst_m"]] == pytest.approx([0.01, 0.01])
    assert errors["worst_deg"] == pytest.approx(np.degrees(0.01))
    never = Trajectory(whole.stamps_ns + 1, whole.Ts_world_body)
    assert localise.errors(never, whole)["worst_m"] == np.inf


def test_bars_of_localising(load):
    localise = load("localise")
    good = {"load_s": 0.5, "worst_m": 0.01, "worst_deg": 0.4, "share": 1.0}
    good |= {"is_same_file": 1.0, "is_unchanged": 1.0}
    assert localise.below_bars("x", good) == []
    bad = {"load_s": 1.5, "worst_m": np.inf, "worst_deg": np.nan, "share": 0.9}
    bad |= {"is_same_file": 0.0, "is_unchanged": 0.0}
    assert len(localise.below_bars("x", bad)) == 6


def test_maps_are_compared_but_for_what_counts_sightings(load):
    localise = load("localise")
    a, b = small_map(), small_map()
    assert localise.same(a, b, set())
    b.count_expected(b.landmark_ids)
    assert not localise.same(a, b, set())
    assert localise.same(a, b, {"expected"})
    b.remove_landmarks(b.landmark_ids[:1])
    assert not localise.same(a, b, {"expected"})


# ---- stalls ----


def test_longest_hold_is_of_who_took_the_lock_first(load):
    lock = load("stalls").TracedLock()

    def busy():
        with lock, lock:
            sum(range(200_000))

    def idle():
        with lock:
            threading.Event().wait(0.02)

    busy()
    assert lock.holder.endswith("busy")
    assert lock.count == 1
    busy_ms = lock.own_ms
    idle()
    assert lock.wall_ms > 19.0
    assert lock.own_ms == busy_ms  # waiting is not work


def test_jobs_that_are_watched_do_what_they_did(load):
    stalls = load("stalls")
    done = []
    change = SimpleNamespace(write=done.append, loops=("a loop",))
    mapper = SimpleNamespace(add=lambda k: SimpleNamespace(solve=lambda: change) if k else None)
    parts = stalls.Parts()
    parts.watch(mapper)
    assert mapper.add(0) is None
    found = mapper.add(1).solve()
    found.write("the map")
    assert done == ["the map"]
    assert found.loops == ("a loop",)
    assert [len(laps) for laps in (parts.read, parts.solve, parts.write)] == [2, 1, 1]


def test_stalls_are_those_after_warm_up_and_of_the_best_run(load):
    stalls = load("stalls")
    first = np.full(stalls.SKIPPED, 900.0)
    waits = np.concatenate([first, np.zeros(99), [20.0]])
    placing = np.concatenate([first, np.full(50, 10.0), np.full(50, 13.0)])
    beside = np.concatenate([first > 0, np.arange(100) >= 50])
    lock = stalls.TracedLock()
    costs = stalls.summary(lock, waits, placing, beside, stalls.Parts())
    assert (costs.frames, costs.beside, costs.beside_ms, costs.stall_max) == (100, 50, 3.0, 20.0)
    assert costs.stall_p99 < 1.0
    assert stalls.below_bars("x", [costs]) == []
    slow = stalls.summary(lock, waits + 16.0, placing, beside, stalls.Parts())
    assert len(stalls.below_bars("x", [slow])) == 1
    assert stalls.below_bars("x", [slow, costs]) == []
    lock.own_ms, lock.holder = 2.5, "Map.apply"
    held = stalls.summary(lock, waits, placing, beside, stalls.Parts())
    assert "2.50 ms by Map.apply" in stalls.below_bars("x", [held])[0]


def test_run_is_watched_from_end_to_end(load):
    stalls = load("stalls")
    from odomap.sources.open import open as open_source
    from odomap.system.config import preset

    source = open_source("sim:room?seed=1&frames=8&resolution=160x100")
    costs = stalls.run(source, preset("stereo"), "lockstep", paced=False)
    assert costs.frames == 8 - stalls.SKIPPED
    assert costs.lock_ms > 0
    read, solve, write = (len(costs.parts[part]) for part in ("read", "solve", "write"))
    assert 1 <= solve == write <= read
