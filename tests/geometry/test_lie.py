import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry import lie
from reference import exponential, numeric_jacobian

GROUPS = {"so3": 3, "se2": 3, "se3": 6, "sim3": 7}
ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.3, 0.499, 0.501, 0.999, 1.001, 2.0, np.pi - 1e-8, np.pi]


def inverse(group, T):
    return np.swapaxes(T, -1, -2) if group == "so3" else getattr(lie, f"{group}_inverse")(T)


def tangents(group, angle, count, rng):
    """Tangents whose rotation has the given angle."""
    xi = rng.normal(size=(count, GROUPS[group]))
    if group == "se2":
        xi[:, 2] = angle * rng.choice([-1.0, 1.0], count)
        return xi
    axis = rng.normal(size=(count, 3))
    phi = angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    first = 0 if group == "so3" else 3
    xi[:, first : first + 3] = phi
    if group == "sim3":
        xi[:, 6] = rng.choice([0.0, 1e-12, 1e-5, 0.1, -0.7, 1.3, -2.5], count)
    return xi


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(group, angle):
    rng = np.random.default_rng(1)
    for xi in tangents(group, angle, 8, rng):
        expected = exponential(group, xi)
        got = getattr(lie, f"{group}_exp")(xi)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(group, angle):
    xi = tangents(group, angle, 50, np.random.default_rng(2))
    exp, log = getattr(lie, f"{group}_exp"), getattr(lie, f"{group}_log")
    back = log(exp(xi))
    if angle < np.pi:
        np.testing.assert_allclose(back, xi, rtol=0, atol=1e-12)
    else:
        # At π both axes are right; the motion must be the same and the angle exact.
        np.testing.assert_allclose(exp(back), exp(xi), rtol=0, atol=2e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_has_the_angle_to_the_last_digits(angle):
    rng = np.random.default_rng(3)
    R = lie.so3_exp(tangents("so3", angle, 200, rng))
    got = np.linalg.norm(lie.so3_log(R), axis=1)
    np.testing.assert_allclose(got, angle, rtol=4e-16, atol=1e-15)


def test_log_at_pi_about_every_axis():
    axes = np.concatenate([np.eye(3), np.random.default_rng(4).normal(size=(100, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    R = 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    phi = lie.so3_log(R)
    np.testing.assert_allclose(np.abs(np.sum(phi * axes, axis=1)), np.pi, atol=1e-12)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 0.5, 0.999, 1.001, 2.0, 3.0])
def test_jacobians_against_differences(group, angle):
    exp, log = getattr(lie, f"{group}_exp"), getattr(lie, f"{group}_log")
    right, left = (getattr(lie, f"{group}_{s}_jacobian") for s in ("right", "left"))
    n = GROUPS[group]
    for xi in tangents(group, angle, 4, np.random.default_rng(5)):
        back = inverse(group, exp(xi))
        scale = max(1.0, np.abs(left(xi)).max())
        got = numeric_jacobian(lambda d, b=back, x=xi: log(b @ exp(x + d)), n)
        np.testing.assert_allclose(right(xi), got, rtol=0, atol=2e-8 * scale)
        got = numeric_jacobian(lambda d, b=back, x=xi: log(exp(x + d) @ b), n)
        np.testing.assert_allclose(left(xi), got, rtol=0, atol=2e-8 * scale)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("side", ["left", "right"])
def test_inverse_jacobians(group, side):
    rng = np.random.default_rng(6)
    for angle in ANGLES:
        xi = tangents(group, angle, 20, rng)
        J = getattr(lie, f"{group}_{side}_jacobian")(xi)
        J_inverse = getattr(lie, f"{group}_{side}_jacobian_inverse")(xi)
        eye = np.broadcast_to(np.eye(GROUPS[group]), J.shape)
        np.testing.assert_allclose(J @ J_inverse, eye, rtol=0, atol=2e-12)


@pytest.mark.parametrize("group", ["so3", "se3", "sim3"])
def test_batches_are_their_items(group):
    xi = np.random.default_rng(7).normal(size=(2, 3, GROUPS[group]))
    for name in ("exp", "left_jacobian", "right_jacobian_inverse"):
        f = getattr(lie, f"{group}_{name}")
        stacked = f(xi)
        assert stacked.shape[:2] == (2, 3)
        np.testing.assert_allclose(stacked[1, 2], f(xi[1, 2]), rtol=0, atol=1e-13)
        assert f(xi[:0]).shape == (0, *stacked.shape[1:])


def test_quaternions_round_trip_and_are_canonical():
    rng = np.random.default_rng(8)
    q = rng.normal(size=(500, 4))
    q[:3] = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    back = lie.quaternion_from_rotation(lie.rotation_from_quaternion(3.0 * q))
    assert np.all(back[:, 0] >= 0)
    np.testing.assert_allclose(np.abs(np.sum(back * q, axis=1)), 1.0, atol=1e-15)
    same = np.sign(np.sum(back * q, axis=1, keepdims=True))
    np.testing.assert_allclose(back, same * q, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_quaternion_of_one_rotation_is_that_of_a_stack_to_the_last_bit(angle):
    axes = np.concatenate([np.eye(3), np.random.default_rng(5).normal(size=(20, 3))])
    R = lie.so3_exp(angle * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    one_by_one = [lie.quaternion_from_rotation(each) for each in R]
    np.testing.assert_array_equal(lie.quaternion_from_rotation(R), one_by_one)


def test_quaternion_of_a_known_turn():
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(lie.quaternion_from_rotation(R), [half, 0, 0, half], atol=1e-15)


def test_orthonormalize_finds_the_nearest_rotation():
    rng = np.random.default_rng(9)
    R = lie.so3_exp(rng.normal(size=(20, 3)))
    np.testing.assert_allclose(lie.orthonormalize(R), R, atol=1e-14)
    noisy = R + 1e-3 * rng.normal(size=R.shape)
    near = lie.orthonormalize(noisy)
    np.testing.assert_allclose(np.linalg.det(near), 1.0, atol=1e-14)
    for turn in 1e-4 * np.concatenate([np.eye(3), -np.eye(3)]):
        other = np.linalg.norm(near @ lie.so3_exp(turn) - noisy, axis=(1, 2))
        assert np.all(np.linalg.norm(near - noisy, axis=(1, 2)) < other)
    assert np.linalg.det(lie.orthonormalize(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


def test_so2_angles():
    theta = np.array([0.0, 1e-12, 3.0, -3.0, np.pi])
    np.testing.assert_allclose(lie.so2_log(lie.so2_exp(theta)), theta, atol=1e-15)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: lie.so3_exp([1.0, 2.0]), r"phi: has shape \(2,\)"),
        (lambda: lie.se3_log(np.eye(3)), "T: has shape"),
        (lambda: lie.so3_exp("abc"), "not an array of numbers"),
        (lambda: lie.rotation_from_quaternion([0.0, 0.0, 0.0, 0.0]), "length 0"),
        (lambda: lie.sim3_log(np.diag([-1.0, 1.0, 1.0, 1.0])), "scale is not positive"),
    ],
)
def test_wrong_input_is_named(call, words):
    with pytest.raises(InputError, match=words):
        call()
