"""What is read of a map to correct its path: loops closed before go on from what ends hang from."""

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp, se3_log
from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.closure import read_essentials
from odomap.system.covisibility import Covisibility, acquaint

UNITS = np.array([1.0, 0.8, 1.5, 0.6, 2.5, 0.7])


def a_map():
    """Return a map of six keyframes in units of their own, one below the other."""
    rng, m = np.random.default_rng(1), Map()
    for k, unit in enumerate(UNITS):
        T = se3_exp(rng.normal(size=6))
        m.add_keyframe(Keyframe(k, k), T, parent=k - 1 if k else None, covariance=np.eye(6))
        snapshot = m.snapshot(np.array([k]), landmarks=False)
        m.apply(snapshot.solved(T[None], np.zeros((0, 3)), scales=np.array([unit])))
    return m


def read(m):
    known = Covisibility(15, 100)
    for k in m.keyframe_ids.tolist():
        known.add(acquaint(m, k))
    return read_essentials(m, known).loops


def with_loop(T, scale, information, gone):
    m = a_map()
    m.add_edge(1, 4, T, information, LOOP, scale_i_j=scale)
    m.cull_keyframes(gone)
    return m


@pytest.mark.parametrize(("gone", "ends"), [([], (1, 4)), ([4], (1, 3)), ([1, 4, 3], (0, 2))])
def test_a_loop_says_the_same_of_keyframes_that_culled_ends_hang_from(gone, ends):
    A = np.random.default_rng(2).normal(size=(6, 6))
    information, scale, T = A @ A.T, 3.0, se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.9]))
    read_back = read(with_loop(T, scale, information, gone))
    assert (read_back.i[0], read_back.j[0]) == ends
    J = np.zeros((6, 6))  # how what is measured between the ends changes with the edge's tangent
    for n, step in enumerate(1e-6 * np.eye(6)):
        moved = read(with_loop(T @ se3_exp(step), scale, information, gone))
        J[:, n] = se3_log(np.linalg.inv(read_back.Ts_i_j[0]) @ moved.Ts_i_j[0]) / 1e-6
    back = np.linalg.inv(J)
    np.testing.assert_allclose(
        read_back.information[0], back.T @ information @ back, rtol=1e-4, atol=1e-4
    )


def test_a_loop_of_which_both_ends_hang_from_one_keyframe_says_nothing():
    m = with_loop(np.eye(4), 1.0, np.eye(6), [4, 3, 2])
    assert len(read(m).i) == 0
