"""The graph of a path with a 3D LiDAR: which loops are false, and what is left of the others."""

import numpy as np
import pytest

from cloudworlds import STEP, Drive, Street
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.maps.edges import LOOP
from odomap.system.cloudclosing import CloudCloser
from odomap.system.cloudconfig import CloudClosingConfig
from odomap.system.cloudgraph import Tie, graph_of
from odomap.system.cloudplaces import read_places

CONFIG = CloudClosingConfig()
SURE = np.diag([100.0] * 3 + [1000.0] * 3) ** 2


@pytest.fixture(scope="module")
def way():
    return Street.drive(Street(1), 0, 230, seed=5)


def driven(way, seed):
    """A path without clouds, which drifted."""
    drive = Drive(_Blind(), way, drift=4.0, seed=seed)
    return drive.go()


class _Blind:
    def cloud(self, T, seed):
        return np.zeros((0, 4), np.float32)


def true_tie(drive, k, m, rng):
    T = se3_inverse(drive.true[m]) @ drive.true[k] @ se3_exp(rng.normal(0, 0.003, 6))
    return Tie(k, m, T, SURE / 10, 500)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_false_loops_are_left_out_whether_old_or_new(way, seed):
    drive, rng = driven(way, seed), np.random.default_rng(seed)
    good = [true_tie(drive, 81 + n, 1 + n, rng) for n in range(0, 10, 2)]
    false = Tie(60, 20, se3_exp(np.array([1.0, 0.5, 0, 0, 0, 0.1])), SURE, 900)
    wrong = Tie(88, 2, se3_exp(np.array([-4.0, 2.0, 0, 0, 0, 0.0])), SURE, 900)
    drive.map.add_edge(20, 60, false.T_matched_keyframe, false.information, LOOP)
    places = read_places(drive.map, np.eye(4))
    path = graph_of(places, [*good, wrong], frozenset()).solve(CONFIG, True)
    assert path.false == {false.ends, wrong.ends}
    errors = np.linalg.norm(path.Ts_world_body[:, :3, 3] - drive.true[:, :3, 3], axis=1)
    assert errors.max() < 0.7 * drive.errors.max()
    assert errors[80:90].max() < 0.25 * drive.errors[80:90].max()
    for T in path.Ts_world_body:
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_what_is_known_to_be_false_does_not_count(way):
    drive, rng = driven(way, 7), np.random.default_rng(7)
    tie = true_tie(drive, 85, 5, rng)
    drive.map.add_edge(5, 85, tie.T_matched_keyframe, tie.information, LOOP)
    places = read_places(drive.map, np.eye(4))
    without = graph_of(places, [], {tie.ends}).solve(CONFIG, False)
    assert np.allclose(without.Ts_world_body, places.Ts_world_body, atol=1e-6)
    assert without.false == {tie.ends}
    assert np.trace(without.covariances[85]) == pytest.approx(
        np.trace(drive.map.covariance(85)), rel=0.05
    )
    held = graph_of(places, [], frozenset()).solve(CONFIG, False)
    assert np.trace(held.covariances[85]) < 0.2 * np.trace(without.covariances[85])


def test_an_earlier_loop_that_others_contradict_is_named_by_the_one_that_told(way):
    """A false loop that was believed while it was alone is doubted when true ones come."""
    street = Street(1)
    drive = Drive(street, way, drift=2.0)
    stage = CloudCloser(drive.map, np.eye(4), CONFIG)
    T = se3_inverse(drive.true[10]) @ drive.true[70] @ se3_exp(np.array([4.0, 2.0, 0, 0, 0, 0.1]))

    def lie(drive):
        if len(drive.ids) == 75:
            drive.map.add_edge(10, 70, T, SURE, LOOP)
            stage.expect()

    drive.go(stage, done=lie)
    doubted = [ends for loop in drive.loops for ends in loop.doubts]
    told = [(loop.keyframe_id, loop.matched_id) for loop in drive.loops if not loop.is_accepted]
    assert (70, 10) in [*doubted, *told]
    assert (70, 10) in stage.false
    assert drive.errors[80:].max() < 0.1


def test_steps_are_as_sure_as_odometry_said():
    drive = driven(np.array([np.eye(4), se3_exp(np.array([2.0, 0, 0, 0, 0, 0]))]), 0)
    path = graph_of(read_places(drive.map, np.eye(4)), [], frozenset()).solve(CONFIG, True)
    assert np.allclose(np.sqrt(np.diag(path.covariances[1])), 4.0 * STEP, rtol=1e-6)
    assert not path.covariances[0].any()
