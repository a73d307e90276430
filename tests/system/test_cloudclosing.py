"""Closing loops with a 3D LiDAR: a path that drifted is straightened by places seen before."""

from dataclasses import replace

import numpy as np
import pytest

from cloudworlds import Drive, Street
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.maps.edges import LOOP, ODOMETRY
from odomap.maps.keyframes import Keyframe
from odomap.system.cloudclosing import CloudCloser
from odomap.system.cloudconfig import CloudClosingConfig

CONFIG = CloudClosingConfig()
ROUND, ROUND_END = 200.0, 80


def closer(drive, config=CONFIG):
    return CloudCloser(drive.map, drive.T_body_lidar, config)


@pytest.fixture(scope="module")
def street():
    return Street(1)


@pytest.fixture(scope="module")
def way(street):
    """Once round and a bit, and some of it back on the other side of the road."""
    back = street.drive(ROUND + 25, ROUND - 50, left=1.75, seed=2)
    return np.concatenate([street.drive(0, ROUND + 40), back])


@pytest.fixture(scope="module")
def closed(street, way):
    drive = Drive(street, way, drift=3.0)
    return drive.go(closer(drive))


def test_a_path_that_comes_back_either_way_is_straightened(street, way, closed):
    drifted = Drive(street, way, drift=3.0).go()
    assert closed.errors[81:].mean() < 0.2 * drifted.errors[81:].mean()
    assert closed.errors.max() < 0.4
    kinds = np.array(closed.map.edges().kind)
    assert (kinds == LOOP).sum() == len(closed.accepted) >= 6
    assert any(loop.keyframe_id > 100 for loop in closed.accepted)  # on the way back
    assert max(loop.moved for loop in closed.accepted) > 0.3


def loop_errors(drive):
    edges = drive.map.edges()
    for row in np.flatnonzero(np.array(edges.kind) == LOOP):
        true = se3_inverse(drive.true[edges.i[row]]) @ drive.true[edges.j[row]]
        error = se3_log(se3_inverse(true) @ edges.Ts_i_j[row])
        yield error, error @ edges.information[row] @ error / 6.0


def test_no_loop_is_false_and_each_is_as_sure_as_it_says(closed):
    found = list(loop_errors(closed))
    assert max(np.linalg.norm(error[:3]) for error, _ in found) < 0.1
    assert 0.1 < np.mean([square for _, square in found]) < 2.5


def test_the_covariance_says_how_far_keyframes_may_be_off(closed):
    squares = []
    for k in closed.ids[1:]:
        off = se3_log(se3_inverse(closed.true[k]) @ closed.map.T_world_body(k))
        squares.append(off @ np.linalg.solve(closed.map.covariance(k), off) / 6.0)
    assert 0.2 < np.mean(squares) < 3.0


def test_the_same_bytes_on_every_run(street, way, closed):
    again = Drive(street, way, drift=3.0)
    again.go(closer(again))
    Ts = closed.map.Ts_world_body(closed.ids), again.map.Ts_world_body(again.ids)
    assert Ts[0].tobytes() == Ts[1].tobytes()
    edges = closed.map.edges(), again.map.edges()
    assert edges[0].information.tobytes() == edges[1].information.tobytes()


def test_a_lidar_that_is_mounted_askew_closes_the_same_loops(street):
    T_body_lidar = se3_exp(np.array([0.4, -0.2, 0.3, 0.4, 0.3, 1.2]))
    way = street.drive(0, ROUND + 20)
    drive = Drive(street, way, drift=3.0, T_body_lidar=T_body_lidar)
    drive.go(closer(drive))
    assert len(drive.accepted) >= 2
    assert drive.errors[ROUND_END:].max() < 0.2
    assert max(np.linalg.norm(error[:3]) for error, _ in loop_errors(drive)) < 0.1


def test_of_what_is_no_loop_it_is_said_why(street):
    """Odometry is so unsure that any place may be the one, and none is."""
    config = replace(CONFIG, alike=1.0, least_reach=1000.0)
    drive = Drive(street, street.drive(0, 100), drift=1.0)
    drive.go(closer(drive, config))
    refused = [loop for loop in drive.loops if not loop.is_accepted]
    assert not drive.accepted
    assert LOOP not in drive.map.edges().kind
    assert len(refused) > 10
    reasons = (
        "meet what is known there",
        "looked through",
        "off the surface",
        "was seen by both",
        "still moving",
    )
    assert all(any(words in loop.reason for words in reasons) for loop in refused)


def test_keyframes_without_clouds_and_with_empty_ones_are_passed_over(street):
    way = np.concatenate([street.drive(0, 30), street.drive(0, 10, left=-1.6)])
    drive = Drive(street, way)
    drive.clouds[3] = drive.clouds[13] = np.zeros((0, 4), np.float32)
    drive.clouds[4] = drive.clouds[14] = None
    drive.clouds[5] = drive.clouds[15] = np.ones((2, 4), np.float32)
    config = replace(CONFIG, least_way=20.0, apart=0.1)
    drive.go(closer(drive, config))
    tied = {loop.keyframe_id for loop in drive.accepted}
    assert tied
    assert not tied & {3, 4, 5, 13, 14, 15}


def test_a_map_that_was_loaded_is_searched_too(street):
    """A closer that begins with a map of old keyframes finds those that come back to them."""
    way = street.drive(0, ROUND + 30)
    drive = Drive(street, way, drift=3.0)
    drive.go(last=78)
    drive.go(closer(drive))
    assert {loop.matched_id for loop in drive.accepted} <= set(range(20))
    assert len(drive.accepted) >= 2


def test_two_pieces_become_one_when_two_loops_agree(street):
    """The second drive begins who knows where, turned; one loop alone is not believed."""
    way = np.concatenate([street.drive(0, 60), street.drive(5, 40, left=-1.2, seed=4)])
    drive = Drive(street, way)
    stage = closer(drive, replace(CONFIG, apart=2.0))
    begins = 24
    where = se3_exp(np.array([300.0, -50.0, 2.0, 0.0, 0.0, 2.5]))
    drive.go(stage, last=begins)
    lost = Drive(street, way[begins:])
    lost.true = where @ lost.true
    join(drive, lost, stage)
    accepted = drive.accepted
    assert [loop.merges for loop in accepted[:2]] == [True, True]
    refused = [loop.reason for loop in drive.loops if "another must agree" in loop.reason]
    assert len(refused) >= 1
    assert drive.errors.max() < 0.1


def join(drive, lost, stage):
    """Go on with the keyframes of a drive that does not know where it is."""
    for n, T in enumerate(lost.true):
        keyframe = Keyframe(drive.map.new_keyframe_id(), 10**12 + n, cloud=lost.clouds[n])
        before = drive.ids[-1]
        drive.ids.append(keyframe.id)
        step = se3_inverse(lost.true[n - 1]) @ T if n else np.eye(4)
        pose = drive.map.place(before, step) if n else T
        drive.map.add_keyframe(keyframe, pose, covariance=0.01 * np.eye(6))
        if n:
            information = np.diag(lost.sigma**-2)
            drive.map.add_edge(before, keyframe.id, step, information, ODOMETRY)
        else:
            drive.map.begin_piece(keyframe.id)
        change = stage.add(keyframe).solve()
        drive.loops += change.loops
        change.write(drive.map)
