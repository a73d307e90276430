"""Maps made apart that become one, on circuits without images; and those that must not."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.evaluation.metrics import ate
from odomap.files.vocabulary import Vocabulary
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.maps.atlas import Atlas
from odomap.maps.estimate import Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.simulation.world import World
from odomap.system.closing import LoopCloser, SideVerifier
from odomap.system.closure import Tie, edges_of, read_essentials, strayed
from odomap.system.config import preset
from odomap.system.essentialgraph import Corrected, Essentials, LoopEdges, correct
from odomap.system.loopsearch import ClosingConfig, LoopSearch
from odomap.system.merging import MergeConfig, Merger
from odomap.system.slam import Slam
from odomap.system.verifying import Verified
from odomap.vision.matching import MatchConfig
from system.circuits import CAMERA, PIXELS, SCALE, Circuit, Walls, around

from .conftest import Recording

HALF = 50
ENABLED = ClosingConfig(enabled=True)


@pytest.fixture(scope="module")
def vocabulary():
    return Vocabulary.load()


def verifier(with_scale=False):
    return SideVerifier(CAMERA, np.eye(4), PIXELS, SCALE, with_scale, MatchConfig())


def grown(circuit, unit=1.0):
    """Add all keyframes of a circuit, in units of their own."""
    circuit.units = unit * circuit.units
    circuit.step_sigma = circuit.step_sigma * np.repeat([unit, 1.0], 3)
    while circuit.count < len(circuit.true):
        circuit.add()
    return circuit


def halves(seed, unit=1.0, walls=None):
    """Return two circuits, the second of which is mapped in a world of its own."""
    walls = Walls.make() if walls is None else walls
    first = grown(Circuit(around(HALF, laps=0.6), walls, seed=seed))
    second = Circuit(around(HALF, laps=0.6, start=np.pi), walls, seed=seed + 10)
    there = second.true[0]
    away = se3_inverse(there @ se3_exp(np.array([5.0, -3.0, 1.0, 0.5, 1.0, -0.7])))
    second.true = away @ second.true
    second.walls = replace(walls, points=walls.points @ away[:3, :3].T + away[:3, 3])
    return first, grown(second, unit), se3_inverse(away)


def errors(m, first, second, T_first_second):
    """Return how far the keyframes of a merged map are from where they were, (K,)."""
    true = np.concatenate([first.true, T_first_second @ second.true])
    return np.linalg.norm(m.Ts_world_body(m.keyframe_ids)[:, :3, 3] - true[:, :3, 3], axis=1)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def bytes_of(m):
    tables = m.dump()
    return b"".join(tables.columns[name].tobytes() for name in sorted(tables.columns))


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("unit", [1.0, 0.4])
def test_two_halves_of_a_circuit_become_one_map(vocabulary, seed, unit):
    first, second, T = halves(seed, unit)
    before = bytes_of(first.map), bytes_of(second.map)
    merging = Merger(vocabulary, verifier(unit != 1.0), unit != 1.0).merge(first.map, second.map)
    m = merging.map
    assert merging.reason == ""
    assert (bytes_of(first.map), bytes_of(second.map)) == before
    assert rms(errors(m, first, second, T)) < 0.004 * 1.2 * 2 * np.pi * 8.0
    assert merging.scale == pytest.approx(1.0 / unit, rel=0.02)
    np.testing.assert_allclose(m.states.scales[HALF:], 1.0 / unit, rtol=0.02)
    np.testing.assert_allclose(m.states.scales[:HALF], 1.0, rtol=0.02)
    np.testing.assert_allclose(merging.T_first_second[:3, :3], T[:3, :3], atol=0.02)
    # The parts in common are known by the same landmarks, and it is one piece.
    assert merging.num_fused > 500
    assert m.num_landmarks == first.map.num_landmarks + second.map.num_landmarks - merging.num_fused
    assert len(Atlas(m).pieces) == 1
    believed = [loop for loop in merging.loops if loop.is_accepted]
    assert merging.num_places == len(believed) >= 10
    kinds = m.edges().kind
    assert kinds.count("gap") == 1
    # Both ends overlap; neighbours say the same, and few of them become edges.
    assert 2 <= kinds.count("loop") <= len(believed) / 4
    for loop in believed[::5]:
        assert loop.merges
        assert loop.matched_id in m.covisible(loop.keyframe_id)[0]
    # How sure the second half is comes from the places in common.
    spread = np.trace(m.states.covariances[HALF:, :3, :3], axis1=1, axis2=2)
    relative = errors(m, first, second, T)[HALF:] / np.sqrt(spread)
    assert 0.1 < rms(relative) < 2.0


def test_a_merged_map_is_the_same_on_every_run(vocabulary):
    first, second, _ = halves(4)
    maps = [Merger(vocabulary, verifier(), False).merge(first.map, second.map) for _ in range(2)]
    assert bytes_of(maps[0].map) == bytes_of(maps[1].map)


def test_maps_of_different_places_have_nothing_in_common(vocabulary):
    first, _, _ = halves(1)
    _, second, _ = halves(1, walls=Walls.make(seed=5))
    told = []
    merger = Merger(vocabulary, verifier(), False)
    merging = merger.merge(first.map, second.map, lambda *step: told.append(step))
    assert merging.num_places == 0
    assert "place in common" in merging.reason
    assert len(Atlas(merging.map).pieces) == 2
    assert [step[:2] for step in told] == [(n, HALF) for n in range(HALF)]
    for loop in merging.loops:
        assert loop.reason


class Contradictory(SideVerifier):
    """A verifier that measures something else every time."""

    def verify(self, newer, matched, seed):
        found = super().verify(newer, matched, seed)
        T = se3_exp(np.random.default_rng(seed).normal(size=6) * [9, 9, 9, 1, 1, 1])
        return replace(found, T_matched_keyframe=T)


def test_places_that_do_not_agree_are_none(vocabulary):
    first, second, _ = halves(2)
    check = Contradictory(CAMERA, np.eye(4), PIXELS, SCALE, False, MatchConfig())
    merging = Merger(vocabulary, check, False, config=MergeConfig(agreeing=3)).merge(
        first.map, second.map
    )
    assert "agree" in merging.reason
    assert "3 needed" in merging.reason
    assert len(merging.loops) > 10
    assert not any(loop.is_accepted for loop in merging.loops)


def test_an_empty_map_has_nothing_in_common_with_another(vocabulary):
    first, _, _ = halves(1)
    for pair in ((first.map, Map()), (Map(), first.map)):
        merging = Merger(vocabulary, verifier(), False).merge(*pair)
        assert merging.reason


class Told(Merger):
    """A merger that is told what was compared, by keyframes of both maps."""

    def _compared(self, merged, absorbed, search, tell):
        search.follow(merged)
        ends = (2, 2), (15, 15), (25, 7)
        none = np.empty((0, 2), np.int64)
        found = Verified(np.eye(4), 1.0, 1e4 * np.eye(6), 50, none, "")
        return [Tie(absorbed.offset + i, j, found) for i, j in ends], []


def test_a_piece_of_the_second_map_needs_two_places_of_its_own(vocabulary):
    maps = []
    for begin in (0, 20):  # the second was lost once, and begins a piece there
        m = Map()
        for n in range(30):
            T = np.eye(4)
            T[0, 3] = n
            keyframe = Keyframe(m.new_keyframe_id(), n)
            m.add_keyframe(keyframe, T, covariance=1e-6 * (n + 1) * np.eye(6))
            if n == begin:
                m.begin_piece(n)
        maps.append(m)
    merging = Told(vocabulary, verifier(), False).merge(*maps)
    assert [loop.is_accepted for loop in merging.loops] == [True, True, False]
    assert [piece.first_id for piece in Atlas(merging.map).pieces] == [0, 50]


# ---- within a run ----


LOST = 50
"""The keyframe of a round at which a new piece begins."""


def lost_and_back(vocabulary, check, unit=1.0):
    """Go round, lost at more than half of it, and on from there somewhere, in other units."""
    circuit, with_scale = Circuit(around(90, laps=1.25), Walls.make(), seed=1), unit != 1.0
    search, loops = LoopSearch(vocabulary, ENABLED), []
    closer = LoopCloser(circuit.map, search, check, with_scale, ENABLED)
    while circuit.count < len(circuit.true):
        if circuit.count == LOST:
            circuit.known.clear()
            circuit.units[LOST:] *= unit
            circuit.step_sigma = circuit.step_sigma * np.repeat([unit, 1.0], 3)
        keyframe = circuit.add()
        if keyframe.id == LOST:
            _leave(circuit, LOST)
        change = closer.add(keyframe).solve()
        change.write(circuit.map)
        loops += change.loops
    return circuit, loops


@pytest.mark.parametrize("unit", [1.0, 0.4])
def test_a_piece_begun_after_a_loss_is_merged_where_the_camera_comes_back(vocabulary, unit):
    circuit, loops = lost_and_back(vocabulary, verifier(unit != 1.0), unit)
    # The first place in common waits for another one that agrees.
    waiting, merge = [loop for loop in loops if loop.merges or "joins two pieces" in loop.reason]
    assert (waiting.is_accepted, merge.is_accepted) == (False, True)
    assert waiting.keyframe_id < merge.keyframe_id
    assert "a second place must say the same" in waiting.reason
    (piece,) = Atlas(circuit.map).pieces
    assert piece.merged == (LOST,)
    assert rms(circuit.errors()) < 0.004 * 1.25 * 2 * np.pi * 8.0
    np.testing.assert_allclose(circuit.map.states.scales[LOST:], 1.0 / unit, rtol=0.02)


def test_places_that_contradict_each_other_join_no_pieces(vocabulary):
    check = Contradictory(CAMERA, np.eye(4), PIXELS, SCALE, False, MatchConfig())
    circuit, loops = lost_and_back(vocabulary, check)
    assert [loop for loop in loops if "but not as the place before it" in loop.reason]
    assert not any(loop.merges for loop in loops)
    assert len(Atlas(circuit.map).pieces) == 2


def test_a_place_that_joins_two_pieces_says_nothing_about_a_third(vocabulary):
    m = Map()
    for n in range(15):
        T = np.eye(4)
        T[0, 3] = n
        keyframe = Keyframe(m.new_keyframe_id(), n)
        m.add_keyframe(keyframe, T, covariance=(1e-6 * n + 9.0 * (n // 5)) * np.eye(6))
        if n % 5 == 0:
            m.begin_piece(n)
    closer = LoopCloser(m, LoopSearch(vocabulary, ENABLED), verifier(), False, ENABLED)
    path = read_essentials(m, closer.search.known).essentials()

    def confirming(newer, matched):
        found = Verified(np.eye(4), 1.0, 1e4 * np.eye(6), 50, np.empty((0, 2), np.int64), "")
        tie = Tie(newer, matched, found)
        return closer._confirming(path, tie, correct(path, edges_of(path, (tie,)), False))

    assert confirming(7, 2) == ((), "joins two pieces of the map: a second place must say the same")
    others, reason = confirming(12, 3)
    assert not others
    assert "the place before it two others" in reason
    (before,), reason = confirming(13, 4)
    assert (before.keyframe_id, reason) == (12, "")


def _leave(circuit, lost):
    """Put the newest keyframe where it is not, as a start anew after a loss does."""
    m = circuit.map
    m.states.Ts_world_body[lost] = m.T_world_body(lost - 1) @ se3_exp(
        np.array([2.0, 1.0, -3.0, 0.3, 0.8, -0.2])
    )
    m.states.covariances[lost] = np.diag([9.0, 9.0, 9.0, 4.0, 4.0, 4.0])
    m.begin_piece(lost)


DARK = range(50, 100)
"""Frames for which the lens is covered while the camera goes on."""
ANEW = DARK[-1] + 12
"""By this frame a new start is made, by a single camera, too."""


@pytest.fixture(scope="module")
def journey():
    """Return a round through a room at ten frames a second, unseen for five seconds of it."""
    world = World.make(
        kind="room",
        seed=2,
        frames=188,
        rate_hz=10.0,
        resolution=(360, 225),
        speed=1.0,
        sensors=("stereo",),
    )
    frames = [None if n in DARK else world.frame(n) for n in range(len(world))]
    for n in DARK:
        black = tuple(np.zeros_like(image) for image in frames[0].images)
        frames[n] = replace(frames[0], id=n, stamp_ns=int(world.truth.stamps_ns[n]), images=black)
    return Recording(world.rig, world.truth, frames)


@pytest.mark.parametrize("sensors", ["stereo", "mono"])
def test_lost_for_long_a_new_piece_begins_and_is_merged_when_the_camera_is_back(
    journey, vocabulary, sensors
):
    config = replace(preset(sensors), closing=ENABLED)
    slam, reasons = Slam(journey.rig, config, vocabulary=vocabulary), []
    for frame in journey:
        estimate = slam.track(frame)
        if frame.id in DARK or frame.id > ANEW:
            assert (estimate.status is Status.LOST) == (frame.id in DARK)
        reasons.append(estimate.reason)
        if frame.id == ANEW:
            assert len(Atlas(slam.map).pieces) == 2
    assert any("started anew where it was last" in reason for reason in reasons[DARK[-1] :])
    # From then on the keyframes of both pieces are where they were, in the units of the first.
    result = slam.finish()
    (merge,) = [loop for loop in result.loops if loop.merges]
    assert merge.is_accepted
    (piece,) = Atlas(slam.map).pieces
    assert len(piece.merged) == 1
    truth = result.truth(journey.truth)
    path = np.linalg.norm(np.diff(truth.Ts_world_body[:, :3, 3], axis=0), axis=1).sum()
    error = ate(result.trajectory, truth, align="sim3" if sensors == "mono" else "se3")
    assert error.rmse < 0.004 * path


@pytest.mark.parametrize(
    ("with_scale", "metres", "radians", "said"),
    [
        (False, 1.0, 0.5, ""),
        (False, 9.0, 0.0, "9 away and 0° turned"),
        (False, 0.0, 3.0, "0 away and 172° turned"),
        (True, 9.0, 0.5, ""),
        (True, 0.0, 3.0, "172° turned"),
    ],
)
def test_no_piece_is_moved_further_than_its_camera_can_have_come(with_scale, metres, radians, said):
    """The newer piece is unsure by a metre and half a radian: it was lost for a second."""
    Ts = np.stack([np.eye(4)] * 2)
    none = LoopEdges(*(np.zeros((0, *shape)) for shape in ((), (), (4, 4), (), (6, 6), (2,))))
    sure = np.stack([1e-6 * np.eye(6), np.diag([1.0] * 3 + [0.25] * 3)])
    before = Essentials(
        np.arange(2), Ts, np.ones(2), sure, np.full(2, -1), sure, np.zeros((0, 2), int), none, 0
    )
    moved = Ts.copy()
    moved[1] = se3_exp(np.array([metres, 0, 0, 0, radians, 0]))
    moved[1, :3, 3] = metres, 0, 0
    after = Corrected(moved, np.ones(2), None, True, is_merging=np.ones(1, bool))
    reason = strayed(1, 0, before, after, with_scale)
    assert said in reason
    assert bool(reason) == bool(said)
    unknown = replace(before, covariances=np.full((2, 6, 6), np.nan))  # a map that was taken in
    assert not strayed(1, 0, unknown, after, with_scale)
