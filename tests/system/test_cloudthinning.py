"""Thinning maps of clouds: many rounds of one block are no larger than few, and as good."""

import numpy as np
import pytest

from cloudworlds import Drive, Street
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.lidar.covering import covered_share
from odomap.maps.edges import FOLDED, LOOP, ODOMETRY, EdgeTable
from odomap.system.cloudclosing import CloudCloser
from odomap.system.cloudconfig import CloudClosingConfig, CloudThinningConfig
from odomap.system.cloudplaces import read_places
from odomap.system.cloudthinning import CloudThinner
from odomap.system.edgefolding import folded_ties

ROUND, EACH = 200.0, 80


def closer(drive, thins=True):
    stage = CloudCloser(drive.map, drive.T_body_lidar, CloudClosingConfig())
    return CloudThinner(stage, CloudThinningConfig()) if thins else stage


@pytest.fixture(scope="module")
def street():
    return Street(4)


@pytest.fixture(scope="module")
def way(street):
    """Twice round, back on the other side, and once round again."""
    back = street.drive(2 * ROUND - 5, ROUND, left=1.75, seed=3)
    return np.concatenate([street.drive(0, 2 * ROUND), back, street.drive(0, ROUND, seed=6)])


@pytest.fixture(scope="module")
def thin(street, way):
    drive = Drive(street, way, drift=1.5)
    counts = []
    drive.go(closer(drive), done=lambda drive: counts.append(drive.map.num_keyframes))
    return drive, counts


@pytest.fixture(scope="module")
def whole(street, way):
    drive = Drive(street, way, drift=1.5)
    return drive.go(closer(drive, thins=False))


def test_a_map_grows_with_the_space_and_not_with_time(thin, way):
    drive, counts = thin
    assert len(way) > 3.8 * EACH
    assert counts[-1] < 1.5 * EACH
    assert counts[-1] < counts[2 * EACH] + 10
    edges = drive.map.edges()
    assert len(edges.kind) < 3 * counts[-1]
    assert np.isin(np.r_[edges.i, edges.j], drive.map.keyframe_ids).all()
    assert len(np.unique(read_places(drive.map, np.eye(4)).piece)) == 1


def test_the_path_is_as_right_as_with_all_of_it(thin, whole):
    """What later rounds measured of the first is not kept: four rounds are as sure as one."""
    drive = thin[0]
    assert drive.errors.max() < 0.6
    assert drive.errors.mean() < 3.0 * whole.errors.mean() + 0.05


def test_the_map_that_is_left_still_shows_all_that_was_seen(thin, way):
    drive = thin[0]
    places = read_places(drive.map, np.eye(4))
    known = np.concatenate([
        kf.cloud[:, :3] @ T[:3, :3].T + T[:3, 3]
        for kf, T in zip(places.keyframes, places.Ts_world_body, strict=True)
    ])  # fmt: skip
    for k in range(EACH, len(way), 20):
        cloud = drive.clouds[k][:, :3].astype(float)
        T = drive.map.T_world_body(drive.ids[k])
        cloud = cloud[np.linalg.norm(cloud, axis=1) < 30.0]
        assert covered_share(cloud @ T[:3, :3].T + T[:3, 3], known, 0.8) > 0.95


def test_what_was_not_tied_to_what_is_known_stays(street):
    """Without a loop nobody knows that it is the same place, however near it seems."""
    drive = Drive(street, np.concatenate([street.drive(0, 80), street.drive(0, 80, left=-1.5)]))
    drive.go()
    stage = closer(drive)
    places = read_places(drive.map, np.eye(4))
    assert stage.plan(places, len(places.ids)) is None


def test_what_is_new_stays(street):
    """A second passage finds a wall that was not there."""
    way = np.concatenate([street.drive(0, ROUND), street.drive(0, 120, left=-1.5, seed=2)])
    drive = Drive(street, way)
    wall = np.array([[x, y, z] for x in (9.0,) for y in np.arange(-6, 6, 0.3)
                     for z in np.arange(0, 7, 0.3)])  # fmt: skip
    changed = range(EACH + 4, EACH + 12)
    for k in changed:
        T = se3_inverse(way[k]) @ way[EACH + 8]
        moved = wall @ T[:3, :3].T + T[:3, 3]
        more = np.column_stack([moved, np.zeros(len(moved))]).astype(np.float32)
        drive.clouds[k] = np.concatenate([drive.clouds[k], more])
    drive.go(closer(drive))
    living = set(drive.map.keyframe_ids.tolist())
    assert set(range(EACH)) <= living
    assert len(living & set(changed)) >= 6
    assert not living & set(range(EACH + 14, EACH + 24))


def test_the_path_does_not_fall_apart_and_folds_what_it_knows():
    """Of a chain 0 - 1 - 2 - 3 the middle goes: one edge is left, as unsure as three."""
    steps = [se3_exp(np.array([2.0, 0.1, 0.0, 0.01, 0.0, 0.3]))] * 3
    Ts = np.array([np.eye(4), steps[0], steps[0] @ steps[1], steps[0] @ steps[1] @ steps[2]])
    information = np.tile(np.diag([400.0] * 3 + [4e4] * 3), (3, 1, 1))
    edges = EdgeTable(
        np.arange(3), np.arange(1, 4), np.array(steps), np.ones(3), information, (ODOMETRY,) * 3
    )
    tied = folded_ties(edges, np.arange(4), Ts, np.array([1, 2]), "SE3")
    assert (tied.i.tolist(), tied.j.tolist(), tied.kind) == ([0], [3], (FOLDED,))
    np.testing.assert_allclose(tied.Ts_i_j[0], Ts[3], atol=1e-6)
    covariance = np.linalg.inv(tied.information[0])
    assert covariance[2, 2] > 3 / 400 - 1e-9
    assert covariance[5, 5] == pytest.approx(3 / 4e4)
    more = EdgeTable(
        np.append(edges.i, 0), np.append(edges.j, 3), np.concatenate([edges.Ts_i_j, Ts[3:]]),
        np.ones(4), np.concatenate([information, information[:1]]), (ODOMETRY,) * 3 + (LOOP,),
    )  # fmt: skip
    assert folded_ties(more, np.arange(4), Ts, np.array([1, 2]), "SE3").kind == ()


def test_a_round_stays_closed_when_what_closed_it_goes():
    """Twelve keyframes on a circle, and a thirteenth that ties the last to the first."""
    ring = [se3_exp(np.array([0.0, 0, 0, 0, 0, a])) for a in np.linspace(0, 2 * np.pi, 13)]
    Ts = np.array([T @ se3_exp(np.array([30.0, 0, 0, 0, 0, 0])) for T in ring])
    i, j = np.append(np.arange(12), 0), np.append(np.arange(1, 13), 12)
    edges = EdgeTable(
        i, j, se3_inverse(Ts[i]) @ Ts[j], np.ones(13), np.tile(100 * np.eye(6), (13, 1, 1)),
        (ODOMETRY,) * 12 + (LOOP,),
    )  # fmt: skip
    gone = np.array([12])
    assert folded_ties(edges, np.arange(13), Ts, gone, "SE3").kind == ()
    tied = folded_ties(edges, np.arange(13), Ts, gone, "SE3", far=60.0)
    assert {int(tied.i[0]), int(tied.j[0])} == {0, 11}
    assert tied.kind == (FOLDED,)
