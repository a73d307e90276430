"""Small dense least squares: Gauss-Newton and Levenberg-Marquardt on any manifold.

The problem: find x that minimises ½ Σ ρ(|r_i(x)|²) for residuals r already divided by their
standard deviation, where x may be a vector or a pose. Each step solves the linearised problem for a
tangent step and puts it back on the manifold,

    (JᵀWJ + λ diag(JᵀWJ)) δ = -JᵀW r,   x ← retract(x, δ),   W = ρ'(|r|²)

Gauss-Newton has λ = 0. Levenberg-Marquardt accepts a step only if the cost falls, and then lowers λ
by how well the linear model predicted it (Nielsen's rule); a refused step doubles the raise. The
covariance is (JᵀWJ)⁻¹ at the solution, infinite if some direction was not observed. Dense:
O(M N² + N³) per step, for up to some hundred unknowns.

Reference: K. Madsen, H. B. Nielsen, O. Tingleff, "Methods for non-linear least squares problems",
2nd ed., DTU, 2004.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from odomap.errors import InputError
from odomap.geometry.robust import Loss
from odomap.geometry.so3 import Array

__all__ = ["LeastSquaresResult", "gauss_newton", "levenberg_marquardt"]

X = TypeVar("X")
Linearise = Callable[[X], tuple[Array, Array]]

_STUCK = "no step lowers the cost: is the Jacobian right?"


@dataclass(frozen=True)
class LeastSquaresResult(Generic[X]):
    """Where the iteration ended, and why.

    Attributes:
        x: the solution, of the type of the start.
        cost: ½ Σ ρ at the solution.
        initial_cost: ½ Σ ρ at the start.
        covariance: (N, N) of the tangent at x, for residuals of unit variance.
        iterations: linear systems solved.
        converged: whether it stopped because there was nothing left to gain.
        reason: why it stopped, in words.
    """

    x: X
    cost: float
    initial_cost: float
    covariance: Array
    iterations: int
    converged: bool
    reason: str


@dataclass(frozen=True)
class _Normal(Generic[X]):
    """The problem linearised at x: H δ = -g."""

    x: X
    cost: float
    H: Array
    g: Array


def gauss_newton(
    residual_and_jacobian: Linearise[X],
    x0: X,
    retract: Callable[[X, Array], X] | None = None,
    *,
    loss: Loss | None = None,
    block: int = 1,
    max_iterations: int = 20,
    step_tolerance: float = 1e-10,
) -> LeastSquaresResult[X]:
    """Minimise by full Gauss-Newton steps; for good starts, where nothing can go wrong.

    Arguments, result and errors as `levenberg_marquardt`; it stops when a step is small.

    Example:
        >>> result = gauss_newton(lambda x: (x - 3.0, np.eye(1)), np.zeros(1))
        >>> result.x.round(6), result.reason
        (array([3.]), 'the step is small')
    """
    now = _linearise(residual_and_jacobian, x0, loss or Loss(), block)
    initial, move = now.cost, retract or _add
    for iteration in range(1, max_iterations + 1):
        step = _solve(now.H, now.g)
        if step is None:
            reason = "the normal equations are singular: some direction is not observed"
            return _result(now, initial, iteration, False, reason)
        now = _linearise(residual_and_jacobian, move(now.x, step), loss or Loss(), block)
        if not np.isfinite(now.cost):
            return _result(now, initial, iteration, False, "the cost is no longer finite")
        if np.max(np.abs(step), initial=0.0) < step_tolerance:
            return _result(now, initial, iteration, True, "the step is small")
    return _result(now, initial, max_iterations, False, f"{max_iterations} iterations were spent")


def levenberg_marquardt(
    residual_and_jacobian: Linearise[X],
    x0: X,
    retract: Callable[[X, Array], X] | None = None,
    *,
    loss: Loss | None = None,
    block: int = 1,
    max_iterations: int = 50,
    step_tolerance: float = 1e-10,
    cost_tolerance: float = 1e-12,
    initial_damping: float = 1e-4,
) -> LeastSquaresResult[X]:
    """Minimise by damped steps that never raise the cost.

    Args:
        residual_and_jacobian: x → r (M,), J (M, N) = ∂r(retract(x, δ))/∂δ at 0; r in standard
            deviations.
        x0: the start.
        retract: (x, δ (N,)) → x; default addition of vectors.
        loss: robust loss of the squared length of each block; default quadratic.
        block: residuals per block (2 for pixels); divides M.
        max_iterations: linear systems to solve at most.
        step_tolerance: stop when all of δ is smaller.
        cost_tolerance: stop when the cost falls by a smaller fraction.
        initial_damping: first λ.

    Returns:
        The solution, its covariance, and why it stopped.

    Raises:
        InputError: shapes do not agree, or the start has no finite cost.
    """
    now = _linearise(residual_and_jacobian, x0, loss or Loss(), block)
    initial, move = now.cost, retract or _add
    if not np.isfinite(initial):
        raise InputError("x0: the residuals at the start are not finite")
    damping, raise_by = initial_damping, 2.0
    for iteration in range(1, max_iterations + 1):
        scale = np.maximum(np.diag(now.H), 1e-12)
        step = _solve(now.H + damping * np.diag(scale), now.g)
        small = step is not None and np.max(np.abs(step), initial=0.0) < step_tolerance
        if step is None or small:
            reason = "the step is small" if small else "the damped equations are singular"
            return _result(now, initial, iteration, bool(small), reason)
        after = _linearise(residual_and_jacobian, move(now.x, step), loss or Loss(), block)
        predicted = 0.5 * float(step @ (damping * scale * step - now.g))
        gained = now.cost - after.cost
        better = bool(np.isfinite(after.cost)) and gained >= 0.0
        now = after if better else now
        # A refused step that promised less than rounding can deliver also means the minimum.
        if (gained if better else predicted) <= cost_tolerance * now.cost:
            return _result(now, initial, iteration, True, "the cost no longer falls")
        if better:
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gained / max(predicted, 1e-300) - 1.0) ** 3)
            damping, raise_by = max(damping, 1e-15), 2.0
        else:
            damping, raise_by = damping * raise_by, 2.0 * raise_by
        if damping > 1e12:
            return _result(now, initial, iteration, False, _STUCK)
    return _result(now, initial, max_iterations, False, f"{max_iterations} iterations were spent")


def _add(x: Any, step: Array) -> Any:
    return x + step


def _linearise(function: Linearise[X], x: X, loss: Loss, block: int) -> _Normal[X]:
    """Weigh the residuals by their loss and gather JᵀWJ and JᵀWr."""
    r, J = (np.asarray(a, dtype=np.float64) for a in function(x))
    if r.ndim != 1 or J.ndim != 2 or J.shape[0] != len(r) or len(r) % block:
        raise InputError(
            f"residual_and_jacobian: shapes {r.shape}, {J.shape}, give (M,), (M, N), M a multiple "
            f"of block = {block}"
        )
    r2 = np.sum(r.reshape(-1, block) ** 2, axis=1)
    weight = np.repeat(loss.weight(r2), block)
    WJ = weight[:, None] * J
    return _Normal(x, 0.5 * float(np.sum(loss.cost(r2))), J.T @ WJ, WJ.T @ r)


def _solve(H: Array, g: Array) -> Array | None:
    """Return the step -H⁻¹ g, or None where H is singular or not finite."""
    if not (np.all(np.isfinite(H)) and np.all(np.isfinite(g))):
        return None
    try:
        L = np.linalg.cholesky(H)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(-np.linalg.solve(L.T, np.linalg.solve(L, g)))


def _result(
    now: _Normal[X], initial: float, iterations: int, converged: bool, reason: str
) -> LeastSquaresResult[X]:
    n = len(now.g)
    covariance = np.full((n, n), np.inf)
    if np.all(np.isfinite(now.H)):
        # Unit diagonal first: metres and radians may differ by orders of magnitude.
        d = np.sqrt(np.maximum(np.diag(now.H), 1e-300))
        values, vectors = np.linalg.eigh(now.H / np.outer(d, d))
        if values.min(initial=1.0) > 1e-13:
            covariance = (vectors / values) @ vectors.T / np.outer(d, d)
    return LeastSquaresResult(now.x, now.cost, initial, covariance, iterations, converged, reason)
