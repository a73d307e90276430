"""A homography stands for four motions, and the one that made it is among them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.errors import InputError
from odomap.geometry.homography import motions_of_homography
from odomap.geometry.lie import so3_exp
from odomap.geometry.pose import SE3


def draw(seed, turn=0.4, length=0.5):
    """Return R, t, n, d of a plane n·x = d that both cameras look at, and its H."""
    rng = np.random.default_rng(seed)
    R = so3_exp(rng.normal(0, turn, 3))
    normal = np.append(rng.normal(0, 0.4, 2), 1.0)
    normal /= np.linalg.norm(normal)
    distance = rng.uniform(0.5, 6.0)
    # The second camera must stay on the plane's near side: n·c < d for its centre c = -Rᵀ t.
    t = length * distance * rng.uniform(-1, 1, 3)
    if normal @ (-R.T @ t) > 0.9 * distance:
        t = -t
    return R, t, normal, distance, R + np.outer(t, normal) / distance


def holds(motions, R, t):
    """Say whether a motion is among them."""
    return any(
        np.abs(T.R - R).max() < 1e-6 and np.abs(T.t - t).max() < 1e-6 * (1 + np.abs(t).max())
        for T in motions
    )


@given(
    st.integers(0, 10**6),
    st.floats(-3.0, 3.0).map(lambda e: 10.0**e),
    st.sampled_from([1.0, -1.0]),
)
@settings(max_examples=80, deadline=None, derandomize=True)
def test_the_true_motion_is_among_them_whatever_the_factor(seed, factor, sign):
    R, t, _, distance, H = draw(seed)
    motions = motions_of_homography(sign * factor * H)
    assert len(motions) == 4
    assert all(isinstance(T, SE3) for T in motions)
    assert holds(motions, R, t / distance)


@pytest.mark.parametrize("seed", range(20))
def test_each_of_them_explains_the_homography(seed):
    """H = R + t nᵀ for some unit n: the four are all solutions, not just neighbours of one."""
    *_, H = draw(seed)
    for T in motions_of_homography(H):
        rest = H - T.R
        normal = T.t @ rest / (T.t @ T.t)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)
        np.testing.assert_allclose(np.outer(T.t, normal), rest, atol=1e-7)


@pytest.mark.parametrize("seed", range(20))
def test_the_four_are_two_pairs_of_opposite_translation(seed):
    R, t, _, distance, H = draw(seed)
    a, b, c, d = motions_of_homography(H)
    for one, other in ((a, b), (c, d)):
        np.testing.assert_array_equal(one.R, other.R)
        np.testing.assert_allclose(one.t, -other.t, atol=1e-15)
    turned = (a.R @ c.R.T).trace()
    assert np.arccos(np.clip((turned - 1) / 2, -1, 1)) > np.radians(0.1)
    right = [T for T in (a, b, c, d) if holds([T], R, t / distance)]
    assert len(right) == 1


def test_motion_along_the_normal_has_one_meaning():
    """The plane faces the motion: both pairs coincide, and the true motion is still there."""
    normal = np.array([0.0, 0.0, 1.0])
    for along in (-0.3, 0.2):
        t = along * normal
        motions = motions_of_homography(np.eye(3) + np.outer(t, normal))
        assert holds(motions, np.eye(3), t)
        for T in motions:
            np.testing.assert_allclose(T.R, np.eye(3), atol=1e-7)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("factor", [1.0, -2.0, 1e-4, 1e5])
def test_a_camera_that_only_turned_says_nothing_of_the_plane(seed, factor):
    R = so3_exp(np.random.default_rng(seed).normal(0, 0.5, 3))
    assert motions_of_homography(factor * R) == []


def test_what_is_no_homography():
    assert motions_of_homography(np.zeros((3, 3))) == []
    rank_one = np.outer([1.0, 2.0, 3.0], [0.5, 0.1, 1.0])
    assert motions_of_homography(rank_one) == []
    with pytest.raises(InputError, match="H"):
        motions_of_homography(np.eye(4))
    with pytest.raises(InputError):
        motions_of_homography(np.zeros((2, 3, 3)))


def test_a_little_noise_moves_the_motion_a_little():
    rng = np.random.default_rng(4)
    for seed in range(20):
        R, t, _, distance, H = draw(seed)
        motions = motions_of_homography(H + rng.normal(0, 1e-5, (3, 3)))
        off = min(max(np.abs(T.R - R).max(), np.abs(T.t - t / distance).max()) for T in motions)
        assert off < 3e-3
