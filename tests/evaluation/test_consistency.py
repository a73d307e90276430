import numpy as np
import pytest

from odomap.errors import InputError
from odomap.evaluation.metrics import consistency, nees
from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse
from odomap.geometry.trajectory import Trajectory


def walk(seed: int, n: int, claimed: float = 1.0) -> tuple[Trajectory, Trajectory]:
    """Truth, and an odometry whose steps err as it says, times `claimed` in standard deviation."""
    rng = np.random.default_rng(seed)
    sigma = np.array([0.01, 0.02, 0.01, 0.001, 0.002, 0.003])
    true, noisy, P = [np.eye(4)], [np.eye(4)], [np.zeros((6, 6))]
    for _ in range(n - 1):
        step = se3_exp(np.r_[0.1, 0, 0, rng.normal(0, 0.02, 3)])
        true.append(true[-1] @ step)
        noisy.append(noisy[-1] @ step @ se3_exp(rng.normal(0, sigma)))
        A = se3_adjoint(se3_inverse(step))
        P.append(A @ P[-1] @ A.T + np.diag((claimed * sigma) ** 2))
    stamps = np.arange(n, dtype=np.int64) * 50_000_000
    return Trajectory(stamps, np.array(noisy), np.array(P)), Trajectory(stamps, np.array(true))


def test_nees_of_gaussian_errors_is_their_number() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    P = A @ A.T + np.eye(6)
    errors = rng.multivariate_normal(np.zeros(6), P, size=4000)
    values = nees(errors, np.tile(P, (4000, 1, 1)))
    assert values.mean() == pytest.approx(6.0, rel=0.05)
    np.testing.assert_allclose(values[:5], [e @ np.linalg.inv(P) @ e for e in errors[:5]])


def test_nees_survives_units_twelve_orders_apart() -> None:
    P = np.diag([1e6, 1e-12, 1.0])[None]
    assert nees(np.array([[1e3, 1e-6, 1.0]]), P)[0] == pytest.approx(3.0)


def test_nees_is_nan_where_nothing_was_promised() -> None:
    P = np.stack([np.zeros((2, 2)), np.array([[1.0, 2], [2, 1]]), np.full((2, 2), np.nan)])
    assert np.isnan(nees(np.ones((3, 2)), P)).all()
    assert np.isnan(nees(np.array([[np.nan, 1]]), np.eye(2)[None])).all()


def test_shapes_must_belong_together() -> None:
    with pytest.raises(InputError, match="covariances"):
        nees(np.ones((3, 6)), np.ones((3, 3, 3)))


@pytest.mark.parametrize(("claimed", "expected"), [(1.0, 1.0), (2.0, 0.25), (0.5, 4.0)])
def test_consistency_tells_honest_timid_and_overconfident(claimed: float, expected: float) -> None:
    per_dof = [consistency(*walk(seed, 40, claimed)).per_dof for seed in range(30)]
    assert np.mean(per_dof) == pytest.approx(expected, rel=0.2)


def test_the_first_pose_counts_as_exact_in_any_world() -> None:
    estimate, truth = walk(1, 30)
    T = se3_exp(np.array([3.0, 2, 1, 0.5, -0.4, 0.3]))
    other = Trajectory(truth.stamps_ns, T @ truth.Ts_world_body)
    here, there = consistency(estimate, truth), consistency(estimate, other)
    np.testing.assert_allclose(here.errors, there.errors, atol=1e-9)
    assert np.isnan(here.values[0])
    assert here.used == 29
    assert np.abs(here.errors[0]).max() < 1e-12
    assert 0.0 <= here.inside_95 <= 1.0
    assert here.as_dict()["nees_mean"] == pytest.approx(6 * here.per_dof)


def test_without_covariances_there_is_nothing_to_judge() -> None:
    estimate, truth = walk(0, 10)
    bare = Trajectory(estimate.stamps_ns, estimate.Ts_world_body)
    with pytest.raises(InputError, match="no covariances"):
        consistency(bare, truth)
    zero = Trajectory(estimate.stamps_ns, estimate.Ts_world_body, np.zeros((10, 6, 6)))
    with pytest.raises(InputError, match="positive definite"):
        consistency(zero, truth)
