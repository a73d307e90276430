import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry import lie
from odomap.geometry.leastsquares import gauss_newton, levenberg_marquardt
from odomap.geometry.pose import SE3
from odomap.geometry.robust import Loss

each_solver = pytest.mark.parametrize("solve", [gauss_newton, levenberg_marquardt])


def line(a, b):
    return lambda x: (a @ x - b, a)


@each_solver
def test_a_linear_problem_is_solved_with_its_covariance(solve):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(30, 4)), rng.normal(size=30)
    result = solve(line(a, b), np.zeros(4))
    expected, residuals, *_ = np.linalg.lstsq(a, b)
    np.testing.assert_allclose(result.x, expected, atol=1e-9)
    np.testing.assert_allclose(result.covariance, np.linalg.inv(a.T @ a), rtol=1e-9)
    assert result.cost == pytest.approx(0.5 * residuals[0])
    assert result.initial_cost == pytest.approx(0.5 * b @ b)
    assert result.converged


def rosenbrock(x):
    r = np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
    return r, np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


def test_marquardt_walks_the_banana():
    result = levenberg_marquardt(rosenbrock, np.array([-1.2, 1.0]), max_iterations=100)
    np.testing.assert_allclose(result.x, [1.0, 1.0], atol=1e-8)
    assert result.converged
    assert result.cost < 1e-16 < result.initial_cost


def pose_problem(seed):
    rng = np.random.default_rng(seed)
    truth = SE3.exp(rng.normal(size=6))
    points = rng.normal(size=(30, 3))
    seen = truth @ points + 0.01 * rng.normal(size=(30, 3))

    def linearise(T):
        r = (T @ points - seen) / 0.01
        J = np.concatenate([np.broadcast_to(np.eye(3), (30, 3, 3)), -lie.hat(points)], axis=2)
        return r.ravel(), (T.R @ J / 0.01).reshape(90, 6)

    return truth, linearise


def retract(T, step):
    return T @ SE3.exp(step)


@each_solver
def test_a_pose_on_its_manifold_with_an_honest_covariance(solve):
    errors = []
    for seed in range(60):
        truth, linearise = pose_problem(seed)
        result = solve(linearise, truth @ SE3.exp(0.1 * np.ones(6)), retract)
        assert result.converged
        e = (truth.inverse() @ result.x).log()
        errors.append(e @ np.linalg.solve(result.covariance, e) / 6)
    assert 0.8 < np.mean(errors) < 1.25


def test_a_robust_loss_ignores_gross_errors_and_blocks_share_a_weight():
    rng = np.random.default_rng(2)
    a = np.tile(np.eye(2), (40, 1))
    b = np.tile([1.0, 2.0], 40) + 0.1 * rng.normal(size=80)
    b[:20] += 50.0
    plain = levenberg_marquardt(line(a, b), np.zeros(2))
    robust = levenberg_marquardt(line(a, b), plain.x, loss=Loss("cauchy", 0.3), block=2)
    assert np.abs(plain.x - [1.0, 2.0]).min() > 5.0
    np.testing.assert_allclose(robust.x, [1.0, 2.0], atol=0.1)


def test_it_says_why_it_stopped():
    a = np.array([[1.0, 0.0], [2.0, 0.0]])
    lost = gauss_newton(line(a, np.ones(2)), np.zeros(2))
    assert not lost.converged
    assert "not observed" in lost.reason
    assert np.all(np.isinf(lost.covariance))
    short = levenberg_marquardt(rosenbrock, np.array([-1.2, 1.0]), max_iterations=2)
    assert not short.converged
    assert short.reason == "2 iterations were spent"
    assert short.iterations == 2
    done = levenberg_marquardt(rosenbrock, np.array([1.0, 1.0]))
    assert done.converged
    assert done.reason == "the step is small"
    wrong = levenberg_marquardt(lambda x: (x - 3.0, -np.eye(1)), np.zeros(1))
    assert not wrong.converged
    assert "is the Jacobian right?" in wrong.reason
    blown = gauss_newton(lambda x: (np.exp(x), 1e-3 * np.exp(x)[:, None]), np.array([-1.0]))
    assert not blown.converged


def test_marquardt_survives_an_unobserved_direction():
    a = np.array([[1.0, 0.0], [2.0, 0.0]])
    result = levenberg_marquardt(line(a, np.array([3.0, 6.0])), np.zeros(2))
    assert result.x[0] == pytest.approx(3.0)
    assert np.all(np.isinf(result.covariance))


def test_wrong_input_is_named():
    with pytest.raises(InputError, match="residual_and_jacobian"):
        gauss_newton(lambda x: (np.zeros(3), np.zeros((2, 1))), np.zeros(1))
    with pytest.raises(InputError, match="block = 2"):
        gauss_newton(lambda x: (np.zeros(3), np.zeros((3, 1))), np.zeros(1), block=2)
    with pytest.raises(InputError, match="not finite"):
        levenberg_marquardt(lambda x: (np.array([np.nan]), np.eye(1)), np.zeros(1))
