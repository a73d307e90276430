"""Rejoining: a camera that finds the old map by itself is measured against it, as a loop."""

import numpy as np
import pytest

from odomap.files.vocabulary import Vocabulary
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.maps.map import Map
from odomap.system.closing import LoopCloser, SideVerifier
from odomap.system.covisibility import Covisibility, acquaint
from odomap.system.loopsearch import ClosingConfig, LoopSearch
from odomap.system.rejoining import Rejoining, Unbent
from odomap.vision.matching import MatchConfig
from system.circuits import CAMERA, PIXELS, SCALE, STEP, Circuit, Walls, around

CONFIG = ClosingConfig(enabled=True)
BENT = 9
"""Keyframes that local mapping bends towards what it found again."""


@pytest.fixture(scope="module")
def vocabulary():
    return Vocabulary.load()


class Returning(Circuit):
    """A circuit whose tracker finds the first landmarks again, to which its mapper bends the end.

    Args:
        back: keyframe from which on it does.
        shared: landmarks found again in each.
        turned: whether the first of them hangs from the old part.
    """

    def __init__(self, *args, back=73, shared=60, turned=False, **how):
        super().__init__(*args, **how)
        self.back, self.shared, self.turned, self.first = back, shared, turned, {}

    def add(self):
        m, n = self.map, self.count
        if n == self.back and self.turned:
            old, T = 1, self.map.T_world_body(1) @ se3_inverse(self.true[1]) @ self.true[n]
            how = {"parent": old, "covariance": m.covariance(old) + np.diag(STEP**2)}
            m.add_keyframe = lambda keyframe, *_, **__: Map.add_keyframe(m, keyframe, T, **how)
        keyframe = super().add()
        vars(m).pop("add_keyframe", None)
        for k in m.observations_of(n)[0].tolist():
            self.first.setdefault(self.points_of[k], k)
        if n >= self.back:
            self._find_again(n)
            if n == self.back and not self.turned:
                self._bend(n)
        return keyframe

    def _find_again(self, n):
        m = self.map
        seen = m.observations_of(n)[0].tolist()
        again = [(self.first[p], k) for k in seen if self.first[p := self.points_of[k]] != k]
        old, new = np.array(again[: self.shared], np.int64).reshape(-1, 2).T
        m.fuse_landmarks(old, new)

    def _bend(self, n):
        Ts = self.map.states.Ts_world_body
        right = Ts[1] @ se3_inverse(self.true[1]) @ self.true[n]
        xi = se3_log(right @ se3_inverse(Ts[n]))
        for back in range(BENT):
            Ts[n - back] = se3_exp(xi * (BENT - back) / BENT) @ Ts[n - back]


class Blind(LoopSearch):
    """A search to which no place looks like another."""

    def find(self, keyframe, recent):
        return []


def closer_of(circuit, vocabulary, with_scale=False):
    check = SideVerifier(CAMERA, np.eye(4), PIXELS, SCALE, with_scale, MatchConfig())
    return LoopCloser(circuit.map, Blind(vocabulary, CONFIG), check, with_scale, CONFIG)


def go(circuit, closer, count):
    """Add keyframes up to so many, and close what is to be closed; return what was decided."""
    loops = []
    while circuit.count < count:
        change = closer.add(circuit.add()).solve()
        change.write(circuit.map)
        loops += change.loops
    return loops


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def nees(circuit):
    """Return the normalised error squared of all keyframes but the first, per degree of freedom."""
    ids = np.arange(1, circuit.count)
    Ts, true = circuit.map.Ts_world_body(ids), circuit.true[ids]
    e = se3_log(se3_inverse(true) @ Ts)
    S = circuit.map.states.covariances[ids]
    return float(np.mean(np.einsum("ni,ni->n", e, np.linalg.solve(S, e[..., None])[..., 0]))) / 6.0


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_return_is_measured_once_and_the_way_round_is_corrected(vocabulary, seed, turned):
    circuit = Returning(around(90, laps=1.2), Walls.make(), seed=seed, turned=turned)
    closer = closer_of(circuit, vocabulary)
    assert not go(circuit, closer, 73)
    before = circuit.errors()[:70]
    loops = go(circuit, closer, 90)
    (loop,) = [loop for loop in loops if loop.is_accepted]
    assert loop.is_tied
    assert loop.keyframe_id == (72 if turned else 73)
    assert loop.matched_id < 73
    there, here = circuit.true[[loop.matched_id, loop.keyframe_id]]
    off = se3_log(se3_inverse(se3_inverse(there) @ here) @ loop.T_matched_keyframe)
    edges = circuit.map.edges()
    assert edges.kind == ("loop",)
    assert off @ edges.information[0] @ off < 30.0
    # Not only the end, which mapping has bent: all of it.
    after = circuit.errors()[:70]
    assert rms(after[30:]) < 0.6 * rms(before[30:])
    assert rms(after[-5:]) < 0.4 * rms(before[-5:])


def test_what_comes_of_it_is_as_sure_as_it_is_right(vocabulary):
    found = []
    for seed in range(1, 7):
        circuit = Returning(around(76), Walls.make(), seed=seed)
        loops = go(circuit, closer_of(circuit, vocabulary), 76)
        assert [loop.is_accepted for loop in loops] == [True]
        found.append(nees(circuit))
    assert 0.5 < np.mean(found) < 2.0


def test_steps_that_were_bent_would_report_the_drift_as_measured(vocabulary, monkeypatch):
    before, after = [], []
    for unbent in (True, False):
        if not unbent:
            monkeypatch.setattr(Unbent, "of", lambda self, parts: parts)
        circuit = Returning(around(76), Walls.make(), seed=1)
        closer = closer_of(circuit, vocabulary)
        go(circuit, closer, 73)
        before.append(rms(circuit.errors()[30:64]))
        go(circuit, closer, 76)
        after.append(rms(circuit.errors()[30:64]))
    assert before[0] == before[1]
    assert after[0] < 0.75 * before[0]
    assert after[1] > 0.9 * before[1]


@pytest.mark.parametrize("turned", [False, True])
def test_the_scale_of_a_single_camera_is_measured_too(vocabulary, turned):
    how = {"seed": 1, "scale": 0.03, "noise": 0.0}
    circuit = Returning(around(78), Walls.make(), turned=turned, **how)
    closer = closer_of(circuit, vocabulary, with_scale=True)
    go(circuit, closer, 73)
    drift, before = circuit.units[1:70] - 1.0, rms(circuit.errors())
    (loop,) = [loop for loop in go(circuit, closer, 74) if loop.is_accepted]
    assert loop.is_tied
    left = circuit.map.states.scales[1:70] * circuit.units[1:70] - 1.0
    assert rms(left) < 0.25 * rms(drift)
    assert rms(circuit.errors()) < 0.25 * before


def test_on_new_ground_and_in_view_of_what_was_seen_all_along_nothing_is_tied():
    circuit = Circuit(around(60, laps=0.3), Walls.make(), seed=1)  # slow: all see the same
    known = Covisibility(15, 100)
    rejoining = Rejoining(known)
    for _ in range(60):
        keyframe = circuit.add()
        known.add(acquaint(circuit.map, keyframe.id))
        assert rejoining.follow(circuit.map, keyframe.id) is None


def test_the_same_bytes_come_out_every_time(vocabulary):
    left = []
    for _ in range(2):
        circuit = Returning(around(78), Walls.make(), seed=2)
        go(circuit, closer_of(circuit, vocabulary), 78)
        tables = circuit.map.dump()
        left.append(b"".join(tables.columns[name].tobytes() for name in sorted(tables.columns)))
    assert left[0] == left[1]
