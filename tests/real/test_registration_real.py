"""A real pair of clouds with a known motion: error, and from how far off it is found."""

import dataclasses

import numpy as np
import pytest

import odomap
from odomap.geometry.lie import orthonormalize, se3_exp, so3_log
from odomap.lidar.target import Target


@pytest.fixture(scope="module")
def pair(data_folder):
    folder = data_folder / "registration"
    truth = np.loadtxt(folder / "T_target_source.txt")
    truth[:3, :3] = orthonormalize(truth[:3, :3])
    return *(odomap.read_ply(folder / f"{n}.ply") for n in ("source", "target")), truth


def off(found, truth):
    E = np.linalg.inv(truth) @ found.T_target_source
    turned = so3_log(orthonormalize(E[:3, :3]))
    return np.linalg.norm(E[:3, 3]), np.degrees(np.linalg.norm(turned))


@pytest.mark.parametrize(
    ("method", "metres", "degrees"),
    [("gicp", 0.02, 0.2), ("plane", 0.02, 0.2), ("ndt", 0.02, 0.4), ("icp", 0.04, 0.5)],
)
def test_the_motion_is_found_without_settings(pair, method, metres, degrees):
    source, target, truth = pair
    found = odomap.register(source, target, method)
    assert found.converged
    assert not found.is_degenerate
    error = off(found, truth)
    assert error[0] < metres
    assert error[1] < degrees


@pytest.mark.parametrize("voxel", [0.2, 0.22, 0.24, 0.264, 0.3])
def test_the_voxel_hardly_matters(pair, voxel):
    source, target, truth = pair
    metres, degrees = off(odomap.register(source, target, voxel=voxel), truth)
    assert metres < 0.02
    assert degrees < 0.3


def test_it_is_found_from_a_metre_and_twenty_degrees(pair):
    source, target, truth = pair
    ready = Target.of(target, 0.25)
    rng = np.random.default_rng(1)
    for _ in range(12):
        v, w = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
        start = truth @ se3_exp(np.r_[v * rng.uniform(), w * np.radians(20) * rng.uniform()])
        metres, degrees = off(odomap.register(source, ready, initial=start), truth)
        assert metres < 0.05
        assert degrees < 0.5


def test_it_is_found_without_a_first_guess(pair):
    source, target, truth = pair
    T = se3_exp(np.array([30.0, -20.0, 5.0, 1.0, -2.0, 1.5]))
    points = source.points @ T[:3, :3].T + T[:3, 3]
    found = odomap.register(points, target, initial="global")
    found = dataclasses.replace(found, T_target_source=found.T_target_source @ T)
    metres, degrees = off(found, truth)
    assert metres < 0.03
    assert degrees < 0.3


def test_both_ways_agree(pair):
    source, target, _ = pair
    there = odomap.register(source, target).T_target_source
    back = odomap.register(target, source).T_target_source
    metres, degrees = off(odomap.register(source, target), np.linalg.inv(back))
    assert np.abs(there[:3, 3]).max() > 0.3
    assert metres < 0.03
    assert degrees < 0.3
