"""Bundle adjustment in the large: views, points and lenses that agree best with what was seen.

    min  ½ Σ_o ρ( ‖ w_o ( π(θ_l, T_cw p) - u_o ) ‖² )

over all that an `Adjustment` does not hold: everything, a window of views among fixed ones, views
alone (all points fixed), points alone (all views fixed), lenses too. Each step of Levenberg and
Marquardt eliminates the points one by one (`normal`), solves what is left for the views
by a sparse factor or by conjugate gradients (`reduced`), and then betters each point for
itself (`points`), which saves more than half of the steps.

Observations beyond a gate can be left out and the rest solved again until the same ones stay; how
sure the result is says `covariance`. Cost of a step: O(N + Σ n²) for N observations and
points seen n times, plus that of the factor.

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
from odomap.backend.adjustment.descent import Criteria, Descent, chi2_of, state_of
from odomap.backend.adjustment.gauge import Gauge, bring_back, find_gauge
from odomap.backend.adjustment.layout import Layout, lay_out
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
        cost_before, cost_after: ½ Σ ρ of the observations used that are in sight of their lens.
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
        variance_factor: χ² per degree of freedom of what was used: about 1 where weights say the
            truth and the loss is quadratic.
        history: one record per step.
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
        InputError: everything is held, fewer numbers were seen than are unknown, or lenses that
            are none.

    Example:
        >>> from odomap.simulation.bundle import bundle_world
        >>> world = bundle_world(60, 300)
        >>> solution = adjust(world.problem)
        >>> solution.reason, bool(0.8 < solution.variance_factor < 1.2)
        ('converged', True)
    """
    config = AdjustmentConfig() if config is None else config
    loss = Loss() if loss is None else loss

    def stopped() -> bool:
        return stop is not None and stop.is_set()

    is_outlier = np.zeros(problem.num_observations, np.bool_)
    found = _solve(problem, is_outlier, config, loss, stopped, progress)
    first, history = found, found.history
    for _ in range(config.rounds if config.gate > 0.0 else 0):
        beyond = found.chi2 > config.gate * config.gate
        if np.array_equal(beyond, is_outlier) or beyond.all() or stopped():
            break
        is_outlier = beyond
        found = _solve(found.problem, is_outlier, config, loss, stopped, progress)
        history += found.history[1:]
    return replace(
        found,
        cost_before=first.cost_before,
        iterations=len(history) - 1,
        history=tuple(replace(r, iteration=i) for i, r in enumerate(history)),
    )


def _solve(
    problem: Adjustment,
    is_outlier: Mask,
    config: AdjustmentConfig,
    loss: Loss,
    stopped: Callable[[], bool],
    progress: Callable[[IterationRecord], None] | None,
) -> AdjustmentSolution:
    """Solve without the outliers."""
    used = _without(problem, is_outlier) if is_outlier.any() else problem
    gauge = find_gauge(used)
    layout = lay_out(used)
    surplus = _surplus(used, layout, gauge)
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
    known = account.chi2[np.isfinite(account.chi2)]
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
        float(known.sum() / surplus) if surplus > 0 else 1.0,
        account.history,
    )


def _without(problem: Adjustment, is_outlier: Mask) -> Adjustment:
    """Return the problem without some of its observations."""
    kept = ~is_outlier
    return replace(
        problem,
        view=problem.view[kept],
        point=problem.point[kept],
        pixels=problem.pixels[kept],
        weights=problem.weights[kept],
    )


def _surplus(problem: Adjustment, layout: Layout, gauge: Gauge) -> int:
    """Return how many more numbers were seen than are unknown; raise InputError if fewer."""
    free = int(np.count_nonzero(~layout.blocks.is_held))
    unknown = free + 3 * int(np.count_nonzero(layout.is_free_point))
    if unknown == 0:
        raise InputError("adjust: every view, point and lens that is seen is held: free some")
    rows = 2 * int(np.count_nonzero(problem.weights > 0.0))
    surplus = rows - unknown + int(np.count_nonzero(gauge.is_held))
    if surplus < 0:
        raise InputError(
            f"adjust: {rows} numbers were seen, {unknown} are unknown: hold views, points or lenses"
        )
    return surplus


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
