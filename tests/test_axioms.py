"""What must hold for every pose, camera and path, whatever the numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.geometry import lie
from odomap.geometry.align import umeyama
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE2, SE3, SO3, Sim3
from odomap.geometry.trajectory import Trajectory

GROUPS = {"so3": (SO3, 3), "se2": (SE2, 3), "se3": (SE3, 6), "sim3": (Sim3, 7)}
ROTATION = {"so3": slice(0, 3), "se2": slice(2, 3), "se3": slice(3, 6), "sim3": slice(3, 6)}
each_group = pytest.mark.parametrize("group", GROUPS)
checked = settings(derandomize=True, deadline=None, max_examples=40, database=None)

number = st.floats(-3.0, 3.0, allow_subnormal=False)
small = st.sampled_from([0.0, 1e-12, 1e-9, 1e-6, 1e-3])


@st.composite
def numbers(draw, n):
    """n numbers, of everyday size or all of them tiny."""
    values = np.array(draw(st.lists(number, min_size=n, max_size=n)))
    return values * draw(st.one_of(st.just(1.0), small))


def tangent(group, values):
    """The first numbers as a tangent with a rotation inside the ball of radius π."""
    xi = values[: GROUPS[group][1]].copy()
    angle = np.linalg.norm(xi[ROTATION[group]])
    if angle > 3.1:
        xi[ROTATION[group]] *= 3.1 / angle
    return xi


def element(group, values):
    return GROUPS[group][0].exp(tangent(group, values))


def close(a, b, size=1.0):
    np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11 * max(1.0, size))


@each_group
@checked
@given(a=numbers(7), b=numbers(7), c=numbers(7))
def test_associativity(group, a, b, c):
    A, B, C = (element(group, v) for v in (a, b, c))
    left, right = ((A @ B) @ C).matrix, (A @ (B @ C)).matrix
    close(left, right, np.abs(left).max())


@each_group
@checked
@given(a=numbers(7))
def test_identity_and_inverse(group, a):
    A, one = element(group, a), GROUPS[group][0].identity()
    close((A @ one).matrix, A.matrix)
    close((one @ A).matrix, A.matrix)
    size = np.abs(A.matrix).max() * np.abs(A.inverse().matrix).max()
    close((A @ A.inverse()).matrix, one.matrix, size)
    close((A.inverse() @ A).matrix, one.matrix, size)
    close(A.inverse().inverse().matrix, A.matrix, size)


@each_group
@checked
@given(a=numbers(7), b=numbers(7))
def test_inverse_of_a_product(group, a, b):
    A, B = element(group, a), element(group, b)
    left, right = (A @ B).inverse().matrix, (B.inverse() @ A.inverse()).matrix
    close(left, right, np.abs(A.inverse().matrix).max() * np.abs(B.inverse().matrix).max())


@each_group
@checked
@given(a=numbers(7))
def test_exp_and_log_round_trip(group, a):
    xi = tangent(group, a)
    A = GROUPS[group][0].exp(xi)
    np.testing.assert_allclose(A.log(), xi, rtol=1e-10, atol=1e-11)
    close(GROUPS[group][0].exp(A.log()).matrix, A.matrix, np.abs(A.matrix).max())


@each_group
@checked
@given(a=numbers(7), b=numbers(7))
def test_adjoint_moves_a_twist_to_the_left(group, a, b):
    A, xi = element(group, a), tangent(group, b)
    exp = GROUPS[group][0].exp
    left = (A @ exp(xi)).matrix
    right = (exp(A.adjoint() @ xi) @ A).matrix if np.all(np.isfinite(xi)) else left
    close(left, right, np.abs(left).max() * np.abs(A.matrix).max())


@each_group
@checked
@given(a=numbers(7), b=numbers(7))
def test_adjoint_of_a_product(group, a, b):
    A, B = element(group, a), element(group, b)
    product = A.adjoint() @ B.adjoint()
    close((A @ B).adjoint(), product, np.abs(product).max())


@each_group
@checked
@given(a=numbers(7))
def test_left_and_right_jacobian(group, a):
    xi = tangent(group, a)
    left, right = (getattr(lie, f"{group}_{side}_jacobian") for side in ("left", "right"))
    size = np.abs(left(xi)).max() * np.abs(right(xi)).max()
    close(right(xi), left(-xi), size)
    close(left(xi), GROUPS[group][0].exp(xi).adjoint() @ right(xi), 100 * size)
    np.testing.assert_allclose(left(xi) @ xi, xi, rtol=1e-10, atol=1e-10)


@each_group
@checked
@given(a=numbers(7), b=numbers(7), p=numbers(3))
def test_action_on_points(group, a, b, p):
    A, B = element(group, a), element(group, b)
    points = np.stack([p, -2.0 * p])[:, : 2 if group == "se2" else 3]
    once, twice = (A @ B) @ points, A @ (B @ points)
    close(once, twice, np.abs(A.matrix).max() * np.abs(B.matrix).max())
    close((A @ B) @ points[0], once[0], np.abs(once).max())


@checked
@given(a=numbers(3))
def test_quaternion_is_the_rotation(a):
    R = SO3.exp(tangent("so3", a))
    close(SO3.from_quaternion(R.quaternion).matrix, R.matrix)
    close(SO3.from_quaternion(-R.quaternion).matrix, R.matrix)


@checked
@given(
    uv=st.tuples(st.floats(0, 751), st.floats(0, 479)),
    k=st.tuples(st.floats(-0.3, 0.1), st.floats(0.06, 0.1)),
    p=st.tuples(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3)),
    depth=st.floats(0.1, 100.0),
)
def test_camera_round_trip(uv, k, p, depth):
    camera = Camera("pinhole", [460.0, 455.0, 370.0, 245.0], [*k, *p], (752, 480))
    pixel = np.array([uv])
    assert np.abs(camera.project(depth * camera.unproject(pixel)) - pixel).max() < 1e-8
    assert np.abs(camera.distort(camera.undistort(pixel)) - pixel).max() < 1e-8


@checked
@given(a=numbers(7), seed=st.integers(0, 1000))
def test_alignment_finds_the_similarity(a, seed):
    S = element("sim3", a)
    points = np.random.default_rng(seed).normal(size=(12, 3))
    found = umeyama(points, S @ points, with_scale=True)
    close(found.matrix, S.matrix, 10 * np.abs(S.matrix).max())
    close(
        umeyama(S @ points, points, with_scale=True).matrix,
        S.inverse().matrix,
        1e3 * np.abs(S.inverse().matrix).max(),
    )


@checked
@given(a=numbers(6), seed=st.integers(0, 1000), at=st.lists(st.integers(0, 9000), min_size=1))
def test_interpolation_does_not_care_about_the_world(a, seed, at):
    T = element("se3", a)
    rng = np.random.default_rng(seed)
    path = Trajectory(np.arange(10) * 1000, lie.se3_exp(rng.uniform(-1, 1, (10, 6))))
    stamps = np.unique(np.array(at))
    moved = path.transformed(T).interpolate(stamps).Ts_world_body
    close(moved, path.interpolate(stamps).transformed(T).Ts_world_body, 10.0)
