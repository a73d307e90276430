"""Descent methods on functions whose minimum is known."""

import numpy as np
import pytest

from odomap.backend.descent import SolverConfig, descend
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.errors import ConfigError

METHODS = ("gauss_newton", "levenberg_marquardt", "dogleg")
each_method = pytest.mark.parametrize("method", METHODS)


class Curve:
    """½ Σ r², for residuals r (M,) of x (n,) with Jacobian J (M, n), one block per unknown."""

    def __init__(self, n, residual):
        pairs = np.triu_indices(n, 1)
        self.pattern = BlockPattern.of(np.ones(n, int), *pairs)
        self.factor = BlockCholesky(self.pattern)
        self.residual = residual
        self.pairs = pairs

    def linearise(self, x, out):
        r, J = self.residual(x)
        H = J.T @ J
        out.cost, out.gradient[:] = 0.5 * float(r @ r), J.T @ r
        out.values[self.pattern.diagonal] = np.diag(H)
        out.values[self.pattern.pair_start] = H[self.pairs]

    def retract(self, x, step):
        return x + step


def rosenbrock(x):
    r = np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
    return r, np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


def line(x):
    J = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, -1.0], [3.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
    return J @ x - np.arange(4.0), J


def arctan(x):
    """Gauss-Newton from beyond 1.39 leaps further away each time."""
    return np.arctan(x), np.diag(1.0 / (1.0 + x * x))


def nothing(x):
    return np.array([x[0] - 1.0]), np.array([[1.0, 0.0]])


@each_method
def test_a_line_is_fitted(method):
    result = descend(Curve(3, line), np.zeros(3), SolverConfig(method=method, tolerance=1e-14))
    r, J = line(np.zeros(3))
    np.testing.assert_allclose(result.x, np.linalg.lstsq(J, -r)[0], atol=1e-6)
    assert result.converged
    if method != "levenberg_marquardt":
        assert result.iterations == 1


@each_method
def test_a_curved_valley_is_followed(method):
    result = descend(Curve(2, rosenbrock), np.array([-1.2, 1.0]), SolverConfig(method=method))
    np.testing.assert_allclose(result.x, [1.0, 1.0], atol=1e-4)
    costs = [record.cost for record in result.history]
    assert costs == sorted(costs, reverse=True)
    assert result.converged


@pytest.mark.parametrize("method", METHODS[1:])
def test_damped_methods_survive_where_gauss_newton_leaps_away(method):
    start = np.array([20.0])
    bold = descend(Curve(1, arctan), start, SolverConfig(method="gauss_newton"))
    careful = descend(Curve(1, arctan), start, SolverConfig(method=method))
    assert not bold.converged
    assert bold.cost_after <= bold.cost_before  # what is returned is the best, not the last
    assert careful.converged
    assert abs(careful.x[0]) < 1e-4


@each_method
def test_what_is_not_measured_stays(method):
    result = descend(Curve(2, nothing), np.array([5.0, 3.0]), SolverConfig(method=method))
    np.testing.assert_allclose(result.x, [1.0, 3.0], atol=1e-4)


@each_method
def test_a_cost_that_is_not_finite_is_said(method):
    def broken(x):
        return np.array([np.nan]), np.array([[1.0]])

    result = descend(Curve(1, broken), np.zeros(1), SolverConfig(method=method))
    assert not result.converged
    assert result.reason == "the cost is not finite"


@each_method
def test_a_wrong_gradient_is_not_called_convergence(method):
    def backwards(x):
        return x - 1.0, -np.eye(1)

    result = descend(Curve(1, backwards), np.zeros(1), SolverConfig(method=method))
    assert not result.converged
    assert result.x == 0.0


def test_no_iteration_is_the_start():
    result = descend(Curve(1, arctan), np.ones(1), SolverConfig(iterations=0))
    assert result.x == 1.0
    assert result.iterations == 0
    assert len(result.history) == 1


def test_limits_are_checked():
    with pytest.raises(ConfigError):
        SolverConfig(iterations=-1)
    with pytest.raises(ConfigError):
        SolverConfig(damping=0.0)
    with pytest.raises(ConfigError, match="'newton' is unknown"):
        SolverConfig(method="newton")
    with pytest.raises(ConfigError, match="whole number"):
        SolverConfig(iterations=2.5)
