"""Loops: found, measured and closed on circuits without images; refused ones say why."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.files.mapfile import load_map, save_map
from odomap.files.vocabulary import Vocabulary
from odomap.geometry.lie import se3_adjoint, se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.states import stretched
from odomap.system.closing import LoopCloser, SideVerifier
from odomap.system.closure import read_essentials
from odomap.system.config import preset
from odomap.system.loopsearch import ClosingConfig, LoopSearch
from odomap.system.slam import Slam
from odomap.vision.matching import MatchConfig
from system.circuits import CAMERA, PIXELS, SCALE, STEP, Circuit, Walls, around

ENABLED = ClosingConfig(enabled=True)


@pytest.fixture(scope="module")
def vocabulary():
    return Vocabulary.load()


def verifier(with_scale=False):
    return SideVerifier(CAMERA, np.eye(4), PIXELS, SCALE, with_scale, MatchConfig())


def closer_of(circuit, vocabulary, with_scale=False, check=None, config=ENABLED, **how):
    check = verifier(with_scale) if check is None else check
    search = LoopSearch(vocabulary, config)
    return LoopCloser(circuit.map, search, check, with_scale, config, **how)


def go(circuit, closer, keyframes=None):
    """Add keyframes and close loops, each at once; return all changes."""
    changes = []
    for _ in range(len(circuit.true) - circuit.count if keyframes is None else keyframes):
        change = closer.add(circuit.add()).solve()
        change.write(circuit.map)
        changes.append(change)
    return changes


def go_until_closed(circuit, closer):
    """Add keyframes until a loop is to be closed; return the change, not written yet."""
    while circuit.count < len(circuit.true):
        change = closer.add(circuit.add()).solve()
        if change.closure is not None:
            return change
        change.write(circuit.map)
    pytest.fail("no loop was found")


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def test_a_circuit_is_closed_where_it_comes_back(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    closer = closer_of(circuit, vocabulary)
    change = go_until_closed(circuit, closer)
    (loop,) = change.loops
    assert loop.is_accepted
    assert loop.reason == ""
    assert loop.num_inliers > 50
    there, here = circuit.true[[loop.matched_id, loop.keyframe_id]]
    assert np.linalg.norm(there[:3, 3] - here[:3, 3]) < 5.0
    true = se3_inverse(there) @ here
    assert np.linalg.norm((loop.T_matched_keyframe - true)[:3, 3]) < 0.05

    before, landmarks_before = circuit.errors(), circuit.landmark_errors()
    sure_before = np.trace(circuit.map.covariance(circuit.count - 1)[:3, :3])
    epoch, landmarks = circuit.map.epoch, circuit.map.num_landmarks
    change.write(circuit.map)
    assert circuit.map.epoch == epoch + 1
    assert circuit.errors()[-1] < 0.5 * before[-1]
    assert rms(circuit.errors()) < 0.6 * rms(before)
    assert rms(circuit.landmark_errors()) < 0.7 * rms(landmarks_before)
    assert circuit.map.num_landmarks < landmarks - 20
    assert np.trace(circuit.map.covariance(circuit.count - 1)[:3, :3]) < 0.5 * sure_before
    edges = circuit.map.edges()
    assert edges.kind == ("loop",)
    assert (edges.i[0], edges.j[0]) == (loop.matched_id, loop.keyframe_id)
    np.testing.assert_array_equal(edges.Ts_i_j[0], loop.T_matched_keyframe)
    # Both sides see the same landmarks now.
    assert loop.matched_id in circuit.map.covisible(loop.keyframe_id)[0]


def test_after_a_loop_there_is_none_for_some_keyframes_and_none_where_landmarks_tie(vocabulary):
    circuit = Circuit(around(90, laps=1.25), Walls.make(), seed=1)
    changes = go(circuit, closer_of(circuit, vocabulary))
    closed = [n for n, change in enumerate(changes) if change.closure is not None]
    assert len(closed) >= 1
    assert (np.diff(closed) > ENABLED.rest).all()
    assert circuit.errors()[-1] < 0.06
    assert not any(change.loops for change in changes[: closed[0] - 2])


@pytest.mark.parametrize("seed", [1, 2])
def test_a_single_camera_s_drift_of_scale_goes(vocabulary, seed):
    circuit = Circuit(around(80), Walls.make(), seed=seed, scale=0.03, noise=0.0)
    change = go_until_closed(circuit, closer_of(circuit, vocabulary, with_scale=True))
    count = circuit.count
    before, landmarks_before = circuit.errors(), circuit.landmark_errors()
    drift = circuit.units[:count] - 1.0
    change.write(circuit.map)
    left = circuit.map.states.scales * circuit.units[:count] - 1.0
    assert rms(left) < 0.1 * rms(drift)
    assert rms(circuit.errors()) < 0.1 * rms(before)
    assert rms(circuit.landmark_errors()) < 0.1 * rms(landmarks_before)


def test_what_was_mapped_while_a_loop_was_solved_is_kept(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    change = go_until_closed(circuit, closer_of(circuit, vocabulary))
    m, last = circuit.map, circuit.count - 1
    circuit.add()
    circuit.add()
    pushed = m.T_world_body(30)
    pushed[:3, 3] += 0.01
    m.states.Ts_world_body[30] = pushed  # what a mapper found meanwhile
    m.cull_keyframes([17])
    T = se3_inverse(m.T_world_body(last)) @ m.Ts_world_body([last + 1, last + 2])
    moved = se3_inverse(m.T_world_body(31)) @ m.T_world_body(30)
    wide = np.trace(m.covariance(last + 2)[:3, :3])
    change.write(m)
    after = se3_inverse(m.T_world_body(last)) @ m.Ts_world_body([last + 1, last + 2])
    np.testing.assert_allclose(after, T, atol=1e-9)
    kept = se3_inverse(m.T_world_body(31)) @ m.T_world_body(30)
    np.testing.assert_allclose(kept, moved, atol=2e-3)
    assert np.trace(m.covariance(last + 2)[:3, :3]) < 0.5 * wide
    assert circuit.errors()[-1] < 0.05


@pytest.mark.parametrize("drift", [0.0, 0.03])
def test_a_mapper_that_began_before_does_not_undo_what_a_loop_says_of_certainty(vocabulary, drift):
    circuit, told = Circuit(around(80), Walls.make(), seed=1, scale=drift), []
    how = {"with_scale": drift > 0.0, "on_closed": lambda: told.append(circuit.count)}
    closer = closer_of(circuit, vocabulary, **how)
    change = go_until_closed(circuit, closer)
    keyframe = circuit.add()
    unaware = circuit.map.covariance(keyframe.id)
    change.write(circuit.map)
    assert told == [circuit.count]
    carried = circuit.map.covariance(keyframe.id)
    scale = circuit.map.scale(keyframe.id)  # the mapper tells it in units of the world as it is now
    assert (scale == 1.0) == (drift == 0.0)
    circuit.map.set_covariance([keyframe.id], stretched(unaware, scale))
    closer.add(keyframe).solve().write(circuit.map)
    np.testing.assert_allclose(circuit.map.covariance(keyframe.id), carried, atol=1e-12)
    assert len(told) == 2
    assert np.trace(carried) < 0.5 * np.trace(unaware)


def test_a_keyframe_that_was_mapped_before_a_loop_is_written_keeps_what_odometry_said(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    closer = closer_of(circuit, vocabulary)
    change = go_until_closed(circuit, closer)
    keyframe = circuit.add()  # and nobody says anything of it any more
    change.write(circuit.map)
    carried = circuit.map.covariance(keyframe.id)
    closer.add(keyframe).solve().write(circuit.map)
    np.testing.assert_array_equal(circuit.map.covariance(keyframe.id), carried)
    growth = circuit.map.growth(keyframe.id)
    np.testing.assert_allclose(growth, np.diag(np.maximum(STEP, 1e-4) ** 2), atol=1e-9)


def test_a_keyframe_that_came_while_the_one_before_was_mapped_waits_for_its_turn(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    closer = closer_of(circuit, vocabulary)
    go(circuit, closer, 3)
    known = closer.search.known
    early, late = circuit.add(), circuit.add()  # the tracker runs ahead
    closer.add(early).solve().write(circuit.map)
    assert known.keyframe_ids.tolist() == [0, 1, 2, early.id]
    wide = 4.0 * circuit.map.covariance(late.id)
    circuit.map.set_covariance([late.id], wide)  # the mapper is done with it
    closer.add(late).solve().write(circuit.map)
    assert known.keyframe_ids.tolist() == [0, 1, 2, early.id, late.id]
    step = se3_inverse(circuit.map.T_world_body(early.id)) @ circuit.map.T_world_body(late.id)
    Ad = se3_adjoint(se3_inverse(step))
    grown = wide - Ad @ circuit.map.covariance(early.id) @ Ad.T
    np.testing.assert_allclose(circuit.map.growth(late.id), grown, atol=1e-12)


def test_a_tracker_that_runs_ahead_closes_the_same_loop_over_the_same_path(vocabulary):
    found = []
    for ahead in (0, 3):
        circuit = Circuit(around(80), Walls.make(), seed=1)
        closer = closer_of(circuit, vocabulary)
        for n in range(len(circuit.true) - ahead):
            while circuit.count <= n + ahead:
                circuit.add()
            if ahead and n == 65:
                circuit.map.begin_piece(n + ahead)  # of which the closer does not know yet
            change = closer.add(circuit.map.keyframe(n)).solve()
            if change.closure is not None:
                break
            change.write(circuit.map)
        before = change.closure.before
        found.append((n, change.loops[0].matched_id, before))
        drifted = circuit.errors()[n]
        change.write(circuit.map)
        assert circuit.errors()[n] < 0.5 * drifted
    assert found[0][:2] == found[1][:2]
    assert found[0][2].keyframe_ids.tolist() == found[1][2].keyframe_ids.tolist()
    np.testing.assert_array_equal(found[0][2].growth, found[1][2].growth)


class Mistaken(SideVerifier):
    """A verifier that believes everything, and measures half a circle."""

    def verify(self, newer, matched, seed):
        found = super().verify(newer, matched, seed)
        T = np.eye(4)
        T[:3, 3] = 9.0, 0.0, 9.0
        return replace(found, T_matched_keyframe=T, information=1e4 * np.eye(6), reason="")


def test_a_loop_verified_by_mistake_is_contradicted_by_the_path(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    check = Mistaken(CAMERA, np.eye(4), PIXELS, SCALE, False, MatchConfig())
    changes = go(circuit, closer_of(circuit, vocabulary, check=check))
    loops = [loop for change in changes for loop in change.loops]
    assert loops
    assert not any(loop.is_accepted for loop in loops)
    assert all("contradicts the path" in loop.reason for loop in loops)
    assert not len(circuit.map.edges().i)
    assert circuit.map.epoch == 0


def test_a_candidate_that_geometry_refuses_says_why(vocabulary, caplog):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    strict = verifier()
    strict = replace(strict, config=replace(strict.config, min_inliers=5000))
    with caplog.at_level("INFO"):
        changes = go(circuit, closer_of(circuit, vocabulary, check=strict))
    loops = [loop for change in changes for loop in change.loops]
    assert loops
    for loop in loops:
        assert not loop.is_accepted
        assert f"{loop.num_inliers} inliers of 5000 needed" in loop.reason
        assert str(loop.keyframe_id) in loop.reason
    assert "is not back at" in caplog.text
    assert circuit.map.epoch == 0


def test_a_place_that_is_another_one_is_no_loop(vocabulary):
    # Once round, and never back: what is seen is always new.
    circuit = Circuit(around(60, laps=0.8), Walls.make(), seed=1)
    changes = go(circuit, closer_of(circuit, vocabulary))
    assert not any(change.loops for change in changes)


def test_what_the_last_keyframe_points_at_is_decided_without_one_more(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    closer = closer_of(circuit, vocabulary)
    assert closer.last() is None
    while not closer._asked:
        closer.add(circuit.add()).solve().write(circuit.map)
    before = circuit.errors()[-1]
    change = closer.last().solve()
    (loop,) = change.loops
    assert loop.is_accepted, loop.reason
    assert loop.keyframe_id == circuit.count - 1
    change.write(circuit.map)
    assert circuit.errors()[-1] < 0.5 * before
    assert closer.last() is None


def test_a_map_that_was_there_before_is_recognised(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    for _ in range(55):
        circuit.add()
    change = go_until_closed(circuit, closer_of(circuit, vocabulary))
    assert change.loops[0].is_accepted


def test_keyframes_that_go_are_forgotten_and_their_loops_stay(vocabulary):
    circuit = Circuit(around(110, laps=1.5), Walls.make(), seed=1)
    closer, m = closer_of(circuit, vocabulary), circuit.map
    change = go_until_closed(circuit, closer)
    change.write(m)
    (loop,) = change.loops
    m.cull_keyframes([loop.matched_id, loop.matched_id + 1])
    changes = go(circuit, closer)
    assert any(change.closure is not None for change in changes)
    ends = [loop.matched_id, loop.keyframe_id]
    essentials = next(c.closure.before for c in changes if c.closure is not None)
    loops, ids = essentials.loops, essentials.keyframe_ids
    assert loop.matched_id not in ids
    assert ids[loops.j[0]] == loop.keyframe_id
    holder = m.parent(loop.matched_id)
    assert ids[loops.i[0]] == holder
    direct = m.T_world_body(ends[0]) @ loop.T_matched_keyframe
    np.testing.assert_allclose(m.T_world_body(holder) @ loops.Ts_i_j[0], direct, atol=1e-9)
    assert circuit.errors()[-1] < 0.06


def test_a_loop_says_which_earlier_ones_it_contradicts_and_when_its_keyframes_were(vocabulary):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    closer, m = closer_of(circuit, vocabulary), circuit.map
    for _ in range(45):
        closer.add(circuit.add()).solve().write(m)
    T = se3_inverse(circuit.true[5]) @ circuit.true[40]
    T[:3, 3] += 3.0
    m.add_edge(5, 40, T, 1e4 * np.eye(6), "loop")  # what nobody should have believed
    m.cull_keyframes([40])
    (loop,) = go_until_closed(circuit, closer).loops
    assert loop.doubts == ((40, 5),)
    ends = loop.keyframe_id, loop.matched_id
    assert loop.stamps_ns == tuple(m.keyframe(k).stamp_ns for k in ends)


def test_a_map_that_is_opened_again_knows_how_unsure_its_steps_were(vocabulary, tmp_path):
    circuit = Circuit(around(90), Walls.make(), seed=1)
    go(circuit, closer_of(circuit, vocabulary))
    m = circuit.map
    assert "loop" in m.edges().kind
    save_map(tmp_path / "m.odomap", m)
    circuit.map = again = load_map(tmp_path / "m.odomap")
    closer = closer_of(circuit, vocabulary)
    read = [read_essentials(map, closer.search.known).growth for map in (m, again)]
    np.testing.assert_array_equal(*read)
    assert np.isfinite(read[0][1:]).all()
    # Of one that never was told nothing is made of what loops told.
    again.set_growth(40, np.full((6, 6), np.nan))
    closer_of(circuit, vocabulary)
    assert np.isnan(again.growth(40)).all()


def run(vocabulary, seed):
    circuit = Circuit(around(75), Walls.make(), seed=seed)
    changes = go(circuit, closer_of(circuit, vocabulary))
    tables = circuit.map.dump()
    return changes, b"".join(tables.columns[name].tobytes() for name in sorted(tables.columns))


def test_the_same_bytes_come_out_every_time(vocabulary):
    changes, first = run(vocabulary, 3)
    assert any(change.closure is not None for change in changes)
    assert run(vocabulary, 3)[1] == first


def test_an_empty_map_and_keyframes_without_features_do_no_harm(vocabulary):
    m = Map()
    closer = LoopCloser(m, LoopSearch(vocabulary, ENABLED), verifier(), False, ENABLED)
    for n in range(3):
        m.add_keyframe(Keyframe(n, n), np.eye(4))
        change = closer.add(m.keyframe(n)).solve()
        assert change.loops == ()
        change.write(m)


@pytest.mark.parametrize("rhythm", ["inline", "lockstep", "live"])
def test_slam_looks_for_loops_where_it_is_asked_to(room, vocabulary, rhythm):
    config = replace(preset("stereo"), closing=ENABLED)
    paths = []
    for _ in range(1 if rhythm == "live" else 2):
        slam, loops = Slam(room.rig, config, rhythm, vocabulary=vocabulary), []
        slam.worker.on_loop.append(loops.append)
        for frame in room.part(0, 24):
            slam.track(frame)
        paths.append(slam.finish().trajectory)
        assert isinstance(slam.worker.stages.closer, LoopCloser)
        assert len(slam.worker.stages.closer.search.known.keyframe_ids) > 1
        assert not any(loop.is_accepted for loop in loops)
    assert len({path.Ts_world_body.tobytes() for path in paths}) == 1
    assert Slam(room.rig, preset("stereo")).worker.stages.closer is not None
    unasked = replace(preset("stereo"), closing=ClosingConfig(enabled=False))
    for config in (unasked, preset("stereo-flow")):
        assert Slam(room.rig, config).worker.stages.closer is None
