import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.align import umeyama, yaw_only
from odomap.geometry.lie import so3_exp
from odomap.geometry.pose import SE3, Sim3


def error(T, source, target):
    return float(np.sum((T @ source - target) ** 2))


@pytest.mark.parametrize("with_scale", [False, True])
def test_no_small_change_of_the_answer_is_better(with_scale):
    rng = np.random.default_rng(1)
    source = rng.normal(size=(40, 3))
    target = 1.7 * source @ so3_exp([0.4, -1.0, 0.3]).T + [3.0, -2.0, 1.0]
    target += 0.1 * rng.normal(size=target.shape)
    best = umeyama(source, target, with_scale)
    assert best.scale == pytest.approx(1.7 if with_scale else 1.0, rel=0.02)
    free = np.eye(7) if with_scale else np.eye(7)[:6]
    for xi in 1e-3 * np.concatenate([free, -free]):
        assert error(best @ Sim3.exp(xi), source, target) > error(best, source, target)


def test_a_mirrored_cloud_still_gives_a_rotation():
    source = np.random.default_rng(2).normal(size=(30, 3))
    found = umeyama(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.R) == pytest.approx(1.0)


def test_flat_and_few_points():
    T = SE3.exp([1.0, 2.0, 3.0, 0.5, -0.4, 2.0])
    flat = np.random.default_rng(3).normal(size=(10, 3)) * [1.0, 1.0, 0.0]
    np.testing.assert_allclose(umeyama(flat, T @ flat).matrix, T.matrix, atol=1e-12)
    np.testing.assert_allclose(umeyama(flat[:3], T @ flat[:3]).matrix, T.matrix, atol=1e-12)


def test_yaw_only_finds_the_heading_and_leaves_tilt_alone():
    rng = np.random.default_rng(4)
    source = rng.normal(size=(50, 3))
    T = SE3.exp([1.0, 2.0, 3.0, 0.0, 0.0, 2.5])
    T = SE3.from_parts(T.R, [1.0, 2.0, 3.0])
    found = yaw_only(source, T @ source)
    np.testing.assert_allclose(found.matrix, T.matrix, atol=1e-12)
    tilted = yaw_only(source, SE3.exp([0, 0, 0, 0.2, 0, 0]) @ source)
    np.testing.assert_allclose(tilted.R[2], [0, 0, 1], atol=1e-15)


@pytest.mark.parametrize("align", [umeyama, yaw_only])
@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "at least 3"),
        (np.zeros((4, 3)), np.zeros((5, 3)), "shapes"),
        (np.zeros((4, 2)), np.zeros((4, 2)), "source: has shape"),
        (np.full((4, 3), np.nan), np.zeros((4, 3)), "NaN"),
    ],
)
def test_wrong_input_is_named(align, source, target, words):
    with pytest.raises(InputError, match=words):
        align(source, target)


def test_coinciding_points_have_no_scale():
    with pytest.raises(InputError, match="scale is undefined"):
        umeyama(np.ones((4, 3)), np.ones((4, 3)), with_scale=True)
