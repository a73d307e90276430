"""Bundle adjustment in the large: views, points and lenses that agree best with what was seen.

    min  ½ Σ_o ρ( ‖ w_o ( π(θ_l, T_cw p) - u_o ) ‖² )

over all that an `Adjustment` does not hold: everything, a window of views among fixed ones, views
alone (all points fixed), points alone (all views fixed), lenses too. Each step of Levenberg and
Marquardt eliminates the points one by one (`normal`), solves what is left for the views
by a sparse factor or by conjugate gradients (`reduced`), and then betters each point for
itself (`points`), which saves more than half of the steps.

Observations beyond a gate can be left out (`gate`); how sure the result is says `covariance`. Cost
of a step: O(N + Σ n²) for N observations and points seen n times, plus that of the factor.

Reference: S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle adjustment in the large",
ECCV 2010; Y. Jeong et al., "Pushing the envelope of modern methods for bundle adjustment",
CVPR 2010.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.covariance import ViewCovariance, view_covariance
from odomap.backend.adjustment.descent import Criteria, Descent, checked_loss, chi2_of, state_of
from odomap.backend.adjustment.gate import COARSE, LETS_GO, least_width, next_width
from odomap.backend.adjustment.gauge import Gauge, bring_back, find_gauge
from odomap.backend.adjustment.layout import Layout, count_free, lay_out
from odomap.backend.adjustment.problem import Adjustment
from odomap.backend.adjustment.reduced import METHODS, Method, reduced_solver
from odomap.backend.descent import IterationRecord
from odomap.backend.graphs.solve import Stop
from odomap.errors import ConfigError, InputError
from odomap.geometry.robust import Loss
from odomap.limits import Count, Limits, NotNegative, Positive, check_limits

__all__ = [
    "Adjustment",
    "AdjustmentConfig",
    "AdjustmentSolution",
    "ViewCovariance",
    "adjust",
    "view_covariance",
    "warm_up",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class AdjustmentConfig:
    """How a bundle adjustment is solved."""

    method: Method = "auto"
    """How views are solved for: auto, factored or iterative (conjugate gradients)."""
    gauge: Literal["free", "hold"] = "free"
    """hold: first view and scale of a part that nothing holds come back to what they were."""
    iterations: Annotated[int, Limits(least=0)] = 100
    """Most steps tried."""
    tolerance: NotNegative = 1e-6
    """Stop when a step gains a smaller fraction of the cost."""
    damping: Positive = 1e-5
    """First λ."""
    gate: NotNegative = 0.0
    """Residual, in standard deviations, beyond which an observation is left out; 0: never."""
    rounds: Count = 5
    """Most times the problem is solved with other outliers left out."""
    inner_iterations: Count = 500
    """Most steps of conjugate gradients for one step of the solver."""
    inner_tolerance: Positive = 0.1
    """Their gain, relative to the mean so far, below which they stop."""

    def __post_init__(self) -> None:
        for name in ("iterations", "rounds", "inner_iterations"):
            if not isinstance(getattr(self, name), int | np.integer):
                raise ConfigError(f"{name}: {getattr(self, name)!r} must be a whole number")
        for name in ("tolerance", "damping", "gate", "inner_tolerance"):
            if not isinstance(getattr(self, name), int | float | np.number):
                raise ConfigError(f"{name}: {getattr(self, name)!r} must be a number")
        check_limits(self)
        for name, known in (("method", METHODS), ("gauge", ("free", "hold"))):
            value = getattr(self, name)
            if value not in known:
                raise ConfigError(f"{name}: '{value}' is unknown; known are {', '.join(known)}")


@dataclass(frozen=True)
class AdjustmentSolution:
    """What a bundle adjustment found, and how.

    Attributes:
        problem: at the views, points and lenses found.
        cost_before, cost_after: ½ Σ ρ of the observations used that are in sight of their lens;
            before, with a gate: of all that are in sight.
        iterations: steps tried.
        converged: whether there was nothing left to gain.
        reason: why it stopped, in words.
        chi2: (N,) squared residuals in standard deviations of all observations; infinite for a
            point that its lens cannot see.
        is_outlier: (N,) observations left out.
        num_parts: connected parts; more than one cannot be placed relative to each other.
        blind_views: views that see nothing, and stayed as they were.
        unseen_points: points that no view sees, and stayed as they were.
        method: "factored" or "iterative".
        variance_factor: χ² per degree of freedom of what was used and is in sight: about 1 where
            weights say the truth and the loss is quadratic; 1 where nothing is left over.
        history: one record per step; with a gate, costs are those of the loss of their round.
    """

    problem: Adjustment
    cost_before: float
    cost_after: float
    iterations: int
    converged: bool
    reason: str
    chi2: Array
    is_outlier: Mask
    num_parts: int
    blind_views: Index
    unseen_points: Index
    method: str
    variance_factor: float
    history: tuple[IterationRecord, ...] = field(repr=False)

    @property
    def Ts_camera_world(self) -> Array:
        """(K, 4, 4) views found."""
        return self.problem.Ts_camera_world

    @property
    def points_world(self) -> Array:
        """(M, 3) points found."""
        return self.problem.points_world

    @property
    def intrinsics(self) -> Array:
        """(L, P) numbers of the lenses found."""
        return self.problem.intrinsics


def adjust(
    problem: Adjustment,
    config: AdjustmentConfig | None = None,
    *,
    loss: Loss | None = None,
    stop: Stop | None = None,
    progress: Callable[[IterationRecord], None] | None = None,
) -> AdjustmentSolution:
    """Adjust views, points and lenses.

    Args:
        problem: what was seen, a start, and what to hold.
        config: method and limits.
        loss: robust loss; default none.
        stop: ends early, with what there is; such as `threading.Event`.
        progress: told of each step.

    Returns:
        The best found and why it stopped; look at `converged`.

    Raises:
        InputError: everything is held, fewer numbers were seen than are unknown, lenses that are
            none, or a loss that is none.

    Example:
        >>> from odomap.simulation.bundle import bundle_world
        >>> world = bundle_world(60, 300)
        >>> solution = adjust(world.problem)
        >>> solution.reason, bool(0.8 < solution.variance_factor < 1.2)
        ('converged', True)
    """
    config = AdjustmentConfig() if config is None else config
    loss = checked_loss(loss)

    def stopped() -> bool:
        return stop is not None and stop.is_set()

    def solve(at: Adjustment, left_out: Mask, how: AdjustmentConfig, by: Loss) -> _Solved:
        return _solve(at, left_out, how, by, stopped, progress)

    solve_all = _solve_gated if config.gate > 0.0 else _solve_plainly
    return solve_all(problem, config, loss, solve, stopped)


_Solved = AdjustmentSolution
_Solve = Callable[[Adjustment, Mask, AdjustmentConfig, Loss], AdjustmentSolution]


class _UnsolvableError(InputError):
    """What is seen does not tell what is unknown."""


def _solve_plainly(
    problem: Adjustment,
    config: AdjustmentConfig,
    loss: Loss,
    solve: _Solve,
    stopped: Callable[[], bool],
) -> AdjustmentSolution:
    return solve(problem, np.zeros(problem.num_observations, np.bool_), config, loss)


def _solve_gated(
    problem: Adjustment,
    config: AdjustmentConfig,
    loss: Loss,
    solve: _Solve,
    stopped: Callable[[], bool],
) -> AdjustmentSolution:
    """Solve without what is beyond the gate; keep the last solution if too little would be left."""
    as_is = replace(config, iterations=0)
    opening = _solve_plainly(problem, as_is, loss, solve, stopped)
    if not (np.isfinite(opening.cost_before) and np.isfinite(opening.chi2).any()):
        return opening
    found, history = _let_go(opening, config, solve, stopped)
    kept, reason = None, ""
    for _ in range(config.rounds):
        beyond = found.chi2 > config.gate * config.gate
        if kept is not None and (stopped() or np.array_equal(beyond, kept.is_outlier)):
            break
        if beyond.all():
            reason = "nothing is within the gate"
            break
        try:
            found = kept = solve(found.problem, beyond, config, loss)
        except _UnsolvableError as error:
            told = str(error).removeprefix("adjust: ").partition(": ")[0]
            reason = f"too few are within the gate: {told}"
            break
        history += found.history[1:]
    if kept is None:
        kept = _solve_plainly(found.problem, as_is, loss, solve, stopped)
    return replace(
        kept,
        cost_before=opening.cost_before,
        iterations=len(history) - 1,
        converged=kept.converged and not reason,
        reason=reason or kept.reason,
        history=tuple(replace(r, iteration=i) for i, r in enumerate(history)),
    )


def _let_go(
    opening: AdjustmentSolution,
    config: AdjustmentConfig,
    solve: _Solve,
    stopped: Callable[[], bool],
) -> tuple[AdjustmentSolution, tuple[IterationRecord, ...]]:
    """Solve by a loss that lets go of gross errors, of ever smaller width."""
    found, history, width = opening, opening.history, np.inf
    coarse = replace(config, tolerance=max(config.tolerance, COARSE))
    while width > least_width(config.gate) and not stopped():
        width = next_width(found.chi2, found.problem.weights, config.gate, width)
        how = coarse if width > least_width(config.gate) else config
        found = solve(found.problem, opening.is_outlier, how, Loss(LETS_GO, width))
        history += found.history[1:]
    return found, history


def _solve(
    problem: Adjustment,
    is_outlier: Mask,
    config: AdjustmentConfig,
    loss: Loss,
    stopped: Callable[[], bool],
    progress: Callable[[IterationRecord], None] | None,
) -> AdjustmentSolution:
    """Solve without the outliers."""
    used = problem.some(~is_outlier) if is_outlier.any() else problem
    gauge = find_gauge(used)
    layout = lay_out(used)
    _check_surplus(used, layout, gauge)
    reduced = reduced_solver(
        layout, used.lens, config.method, config.inner_iterations, config.inner_tolerance
    )
    descent = Descent(state_of(used, layout), layout, loss, reduced)
    criteria = Criteria(config.iterations, config.tolerance, config.damping)
    account = descent.run(criteria, stopped, progress)
    moved = _moved(problem, descent, layout)
    if config.gauge == "hold":
        moved = bring_back(problem, moved, gauge)
    chi2 = chi2_of(moved) if is_outlier.any() else account.chi2
    sees = np.bincount(used.view, minlength=used.num_views) > 0
    seen = np.bincount(used.point, minlength=used.num_points) > 0
    return AdjustmentSolution(
        moved,
        account.cost_before,
        account.cost_after,
        account.iterations,
        account.converged,
        account.reason,
        chi2,
        is_outlier,
        gauge.num_parts,
        np.flatnonzero(~sees),
        np.flatnonzero(~seen),
        reduced.name,
        _variance_factor(used, account.chi2),
        account.history,
    )


def _check_surplus(problem: Adjustment, layout: Layout, gauge: Gauge) -> None:
    """Refuse a problem with fewer numbers seen than are unknown."""
    free = int(np.count_nonzero(~layout.blocks.is_held))
    unknown = free + 3 * int(np.count_nonzero(layout.is_free_point))
    if unknown == 0:
        raise _UnsolvableError("adjust: every view, point and lens that is seen is held: free some")
    rows = 2 * int(np.count_nonzero(problem.weights > 0.0))
    rows += int(np.count_nonzero(problem.has_depth))
    if rows - unknown + int(np.count_nonzero(gauge.is_held)) < 0:
        raise _UnsolvableError(
            f"adjust: {rows} numbers were seen, {unknown} are unknown: hold views, points or lenses"
        )


def _variance_factor(problem: Adjustment, chi2: Array) -> float:
    """Return χ² per degree of freedom of the observations that count and are in sight."""
    is_lost = ~np.isfinite(chi2) | (problem.weights == 0.0)
    if is_lost.all():
        return 1.0
    counted = problem.some(~is_lost)
    # A point seen once has three unknowns, of which two numbers tell two.
    deep = counted.point[counted.has_depth]
    seen = 2 * np.bincount(counted.point, minlength=counted.num_points)
    told = np.minimum(3, seen + np.bincount(deep, minlength=counted.num_points))
    unknown = int(told[~counted.is_fixed_point].sum())
    unknown += count_free(counted)
    surplus = 2 * counted.num_observations + len(deep) - unknown
    surplus += int(np.count_nonzero(find_gauge(counted).is_held))
    return float(chi2[~is_lost].sum() / surplus) if surplus > 0 else 1.0


def _moved(problem: Adjustment, descent: Descent, layout: Layout) -> Adjustment:
    """Return the problem at the state where a descent ended."""
    views, lenses, laid = descent.state
    Ts, points = problem.Ts_camera_world.copy(), np.empty_like(problem.points_world)
    Ts[:, :3, :3], Ts[:, :3, 3] = views.R, views.t
    points[layout.point_order] = laid
    intrinsics = problem.intrinsics.copy()
    for row, used in enumerate(lenses.used):
        intrinsics[row, :used] = lenses.theta[row, :used]
    return replace(problem, Ts_camera_world=Ts, points_world=points, intrinsics=intrinsics)


def warm_up() -> None:
    """Compile the kernels of bundle adjustment, those of its other modules included."""
    T, points = np.tile(np.eye(4), (3, 1, 1)), np.zeros((12, 3))
    T[:, 0, 3] = 0.0, -1.0, 1.0
    points[:, 0], points[:, 1], points[:, 2] = np.arange(12) % 4, np.arange(12) // 4, 5.0
    points[:, 2] += np.arange(12) % 3
    view, point = np.repeat([0, 1, 2], 12), np.tile(np.arange(12), 3)
    seen = points[point] + T[view, :3, 3]
    pixels = 100.0 * seen[:, :2] / seen[:, 2:]
    problem = Adjustment(T, points + 0.01, view, point, pixels, np.array([[100.0, 100.0, 0, 0]]))
    shared = replace(problem, is_free_intrinsic=np.ones((1, 4), np.bool_))
    for config in (AdjustmentConfig("factored"), AdjustmentConfig("iterative")):
        adjust(problem, config)
        adjust(shared, config)
    view_covariance(problem, [1])
