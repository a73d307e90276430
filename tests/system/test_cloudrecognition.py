"""A sweep is found in a map of which nothing else is known, or it is said why not."""

import numpy as np
import pytest

from cloudworlds import Drive, Street
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.maps.map import Map
from odomap.system.cloudconfig import CloudClosingConfig, CloudRecognitionConfig
from odomap.system.cloudrecognition import CloudFinder, FoundCloud


def finder(drive):
    config = CloudRecognitionConfig(), CloudClosingConfig()
    return CloudFinder(drive.map, drive.T_body_lidar, *config)


@pytest.fixture(scope="module")
def street():
    return Street(2)


@pytest.fixture(scope="module")
def known(street):
    """A map of three sides of the block."""
    return Drive(street, street.drive(0, 150)).go()


def wrong_by(drive, found, T):
    true = se3_inverse(drive.true[drive.ids.index(found.keyframe_id)]) @ T
    return se3_log(se3_inverse(true) @ found.T_keyframe_body)


@pytest.mark.parametrize("left", [-1.75, 1.75])
def test_sweeps_are_found_in_both_directions_to_the_centimetre(street, known, left):
    ends = (140, 10) if left > 0 else (10, 140)
    Ts = street.drive(*ends, left=left, seed=8)[::8]
    find = finder(known)
    found = {n: find.find(street.cloud(T, 500 + n)) for n, T in enumerate(Ts)}
    found = {n: where for n, where in found.items() if isinstance(where, FoundCloud)}
    assert len(found) >= 0.8 * len(Ts)
    squares = []
    for n, where in found.items():
        off = wrong_by(known, where, Ts[n])
        assert np.linalg.norm(off[:3]) < 0.1
        squares.append(off @ where.information @ off / 6.0)
    assert 0.05 < np.mean(squares) < 2.5


def test_a_place_that_is_not_in_the_map_is_not_found(street, known):
    find = finder(known)
    reasons = []
    for n, T in enumerate(street.drive(165, 190, seed=9)[::2]):
        found = find.find(street.cloud(T, 700 + n))
        assert isinstance(found, str), wrong_by(known, found, T)
        reasons.append(found)
    assert all(
        reason.startswith(("it is not of the place", "it looks like no")) for reason in reasons
    )


def test_sweeps_of_another_town_are_not_found(known):
    town, find = Street(77), finder(known)
    for n, T in enumerate(town.drive(0, 100)[::8]):
        assert isinstance(find.find(town.cloud(T, n)), str)


def test_a_mount_that_is_tilted_is_taken_into_account(street):
    T_body_lidar = se3_exp(np.array([0.5, 0.1, 0.4, 0.9, -0.4, 2.0]))
    drive = Drive(street, street.drive(0, 60), T_body_lidar=T_body_lidar).go()
    find = finder(drive)
    for n, T in enumerate(street.drive(10, 50, left=-1.4, seed=5)[::5]):
        found = find.find(street.cloud(T @ T_body_lidar, 800 + n), None if n % 2 else T)
        assert isinstance(found, FoundCloud), found
        assert np.linalg.norm(wrong_by(drive, found, T)[:3]) < 0.15


def test_of_two_streets_that_are_the_same_none_is_taken(street):
    """A map in which the same street comes twice: to which one it belongs nobody can tell."""
    way = street.drive(0, 40)
    twice = Drive(street, np.concatenate([way, way]))
    twice.true[len(way) :, 0, 3] += 500.0
    find = finder(twice.go())
    reason = find.find(street.cloud(street.pose(20, -1.5), 3))
    assert isinstance(reason, str)
    assert "places that lie apart" in reason


def test_along_a_tunnel_no_place_is_fixed():
    rng = np.random.default_rng(0)

    def tunnel(n):
        x, a = rng.uniform(-30, 30, 4000), rng.uniform(0, 2 * np.pi, 4000)
        walls = np.column_stack(
            [x, 3 * np.clip(1.4 * np.cos(a), -1, 1), 2 * np.clip(1.4 * np.sin(a), -1, 1)]
        )
        return (walls + rng.normal(0, 0.01, walls.shape)).astype(np.float32)

    way = np.tile(np.eye(4), (8, 1, 1))
    way[:, 0, 3] = 2.5 * np.arange(8)
    drive = Drive(None, way[:0])
    drive.true, drive.clouds = way, [tunnel(n) for n in range(8)]
    reason = finder(drive.go()).find(tunnel(9))
    assert isinstance(reason, str)


def test_empty_sweeps_and_empty_maps_are_told_of(street, known):
    assert "0 points" in finder(known).find(np.zeros((0, 4), np.float32))
    drive = Drive(street, street.drive(0, 10))
    drive.map = Map()
    cloud = street.cloud(street.pose(0, -1.75), 0)
    assert "no keyframe" in finder(drive).find(cloud)
    drive.clouds = [None] * len(drive.clouds)
    assert isinstance(finder(drive.go()).find(cloud), str)
