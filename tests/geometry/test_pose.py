import copy
import pickle

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.pose import SE2, SE3, SO3, Sim3

ALL = [(SO3, 3), (SE2, 3), (SE3, 6), (Sim3, 7)]
POSE = SE3.exp([1.0, -2.0, 0.5, 0.3, -0.2, 0.9])


@pytest.mark.parametrize(("cls", "n"), ALL)
def test_values_are_read_only_equal_by_value_and_hashable(cls, n):
    rng = np.random.default_rng(1)
    a, b = cls.exp(rng.normal(size=n)), cls.exp(rng.normal(size=n))
    assert a == cls(a.matrix)
    assert hash(a) == hash(cls(a.matrix))
    assert a != b
    assert a != "pose"
    assert len({a, b, cls(a.matrix)}) == 2
    with pytest.raises(ValueError, match="read-only"):
        a.matrix[0, 0] = 2.0
    with pytest.raises(AttributeError):
        a.matrix = b.matrix
    assert pickle.loads(pickle.dumps(a)) == a
    assert copy.deepcopy(a) == a
    assert not pickle.loads(pickle.dumps(a)).matrix.flags.writeable


def test_the_given_array_is_copied():
    matrix = np.eye(4)
    pose = SE3(matrix)
    matrix[0, 3] = 5.0
    assert pose == SE3.identity()


def test_parts():
    pose = SE3.from_quaternion([0.0, 0.0, 0.0, 2.0], [1, 2, 3])
    np.testing.assert_allclose(pose.R, np.diag([-1.0, -1.0, 1.0]), atol=1e-15)
    np.testing.assert_array_equal(pose.t, [1, 2, 3])
    np.testing.assert_allclose(pose.quaternion, [0, 0, 0, 1], atol=1e-15)
    assert SE3.from_parts(pose.R, pose.t) == pose
    plane = SE2.from_parts(0.5, [1.0, 2.0])
    assert plane.theta == pytest.approx(0.5)
    np.testing.assert_allclose(plane @ [1.0, 0.0], [1 + np.cos(0.5), 2 + np.sin(0.5)])


def test_similarity_has_scale_and_a_pure_rotation():
    S = Sim3.from_parts(2.0, POSE.R, POSE.t)
    assert S.scale == pytest.approx(2.0)
    np.testing.assert_allclose(S.R, POSE.R, atol=1e-15)
    np.testing.assert_allclose(S @ [1.0, 0.0, 0.0], 2 * POSE.R[:, 0] + POSE.t)
    assert (S @ S).scale == pytest.approx(4.0)


def test_letters_cancel():
    points = np.random.default_rng(2).normal(size=(7, 3))
    np.testing.assert_allclose(POSE @ points, points @ POSE.R.T + POSE.t)
    assert (POSE @ points[0]).shape == (3,)
    assert (POSE @ np.empty((0, 3))).shape == (0, 3)
    np.testing.assert_allclose(SO3(POSE.R) @ points, points @ POSE.R.T)


def test_long_products_do_not_drift():
    pose, step = SE3.identity(), SE3.exp([0.01, 0, 0, 0.01, 0.02, 0.03])
    for _ in range(3000):
        pose = pose @ step
    assert np.abs(pose.R.T @ pose.R - np.eye(3)).max() < 1e-15 * 4
    np.testing.assert_allclose(
        pose.matrix, SE3.exp([30.0, 0, 0, 30.0, 60.0, 90.0]).matrix, atol=1e-9
    )


def test_a_rounded_rotation_is_mended_and_a_wrong_one_refused():
    rounded = np.round(POSE.matrix, 7)
    mended = SE3(rounded)
    assert np.abs(mended.R.T @ mended.R - np.eye(3)).max() < 1e-15 * 4
    assert np.abs(mended.matrix - rounded).max() < 1e-7
    with pytest.raises(InputError, match="not a rotation"):
        SE3(np.round(POSE.matrix, 4))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SE3(np.eye(3)), r"SE3: matrix has shape \(3, 3\), give \(4, 4\)"),
        (lambda: SE3(np.full((4, 4), np.nan)), "NaN"),
        (lambda: SE3("pose"), "not a matrix of numbers"),
        (lambda: SE3(np.diag([1.0, 1.0, -1.0, 1.0])), "reflection"),
        (lambda: SE3(1.001 * np.eye(4)), "last row"),
        (lambda: SE3(np.diag([2.0, 2.0, 2.0, 1.0])), "not a rotation"),
        (lambda: SO3(np.diag([1.0, -1.0, 1.0])), "reflection"),
        (lambda: SE2(np.eye(4)), "SE2"),
        (lambda: Sim3(np.diag([-2.0, -2.0, -2.0, 1.0])), "not a rotation"),
        (lambda: Sim3(np.diag([0.0, 0.0, 0.0, 1.0])), "scale is 0"),
        (lambda: Sim3(np.diag([2.0, 2.0, 1.0, 1.0])), "not a rotation"),
        (lambda: Sim3.from_parts(-1.0, np.eye(3), [0, 0, 0]), "scale"),
        (lambda: SE3.exp([1, 2, 3]), "6 finite numbers"),
        (lambda: SE3.exp([0, 0, 0, 0, 0, np.inf]), "6 finite numbers"),
        (lambda: SE3.from_parts(np.eye(3), [1, 2]), "3 finite numbers"),
        (lambda: SO3.from_quaternion([0, 0, 0, 0]), "length 0"),
        (lambda: POSE @ np.zeros((4, 2)), r"give \(N, 3\)"),
        (lambda: POSE @ SO3.identity(), "one class"),
    ],
)
def test_wrong_input_is_named(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_repr_reads():
    assert repr(SE3.identity()) == "SE3(t=[0, 0, 0], quaternion=[1, 0, 0, 0])"
    assert repr(SE2.from_parts(0.5, [1, 2])) == "SE2(t=[1, 2], theta=0.5)"
    assert "scale=2" in repr(Sim3.from_parts(2.0, np.eye(3), [0, 0, 0]))
    assert repr(SO3.identity()) == "SO3(quaternion=[1, 0, 0, 0])"
