"""Levenberg-Marquardt on a bundle adjustment problem.

Each step linearises, solves the damped reduced system for views and lenses, moves the points to
match, and looks at the gain over the gain promised, ρ. A step that lowers the cost is taken and

    λ ← λ max(1/3, 1 - (2ρ - 1)³),   else   λ ← λ ν, ν ← 2ν   (Nielsen).

An observation that leaves its lens's sight would take its residual with it and look like progress:
it is charged as much as the worst one at the start. The iteration ends when a step gains less than
a fraction of the cost; what is returned is never worse than the start, nor anything but finite.

Reference: K. Madsen, H. B. Nielsen, O. Tingleff, "Methods for non-linear least squares problems",
2nd ed., DTU, 2004.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.layout import Layout, lay_out
from odomap.backend.adjustment.lenses import LensArrays, lens_arrays, reaches
from odomap.backend.adjustment.normal import (
    System,
    Views,
    linearise,
    move_views,
    robust_cost,
)
from odomap.backend.adjustment.points import move_points, refine_points
from odomap.backend.adjustment.problem import Adjustment
from odomap.backend.adjustment.reduced import Reduced
from odomap.backend.descent import IterationRecord
from odomap.errors import InputError
from odomap.geometry.robust import Loss
from odomap.geometry.robust_kernels import loss_code

__all__ = [
    "Account",
    "Criteria",
    "Descent",
    "State",
    "checked_loss",
    "chi2_of",
    "room_for",
    "state_of",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LEAST_CHARGE = 1e6
"""Squared residual, in standard deviations, that is charged at least for one out of sight."""
ROUNDING = 1e-15
"""Part of the cost that a step must promise to be worth trying."""
EXACT = 1e-14
"""Cost per observation below which the residuals are rounding."""


class State(NamedTuple):
    """What is to be found: views, lenses, points (M, 3)."""

    views: Views
    lenses: LensArrays
    points: Array


@dataclass(frozen=True)
class Criteria:
    """When to stop: most steps, part of the cost a step must gain, and the first damping."""

    iterations: int
    tolerance: float
    damping: float


@dataclass(frozen=True)
class Account:
    """Where a descent ended, and why.

    Attributes:
        cost_before, cost_after: ½ Σ ρ of what is in sight.
        iterations: steps tried.
        converged: whether there was nothing left to gain.
        reason: why it stopped, in words.
        chi2: (N,) in the order of the problem; infinite out of sight.
        history: one record per step, the start first.
    """

    cost_before: float
    cost_after: float
    iterations: int
    converged: bool
    reason: str
    chi2: Array
    history: tuple[IterationRecord, ...]


def checked_loss(loss: Loss | None) -> Loss:
    """Return a loss, quadratic if none is given.

    Raises:
        InputError: it is something else, such as a name.
    """
    if loss is not None and not isinstance(loss, Loss):
        raise InputError(f"adjustment: loss: {loss!r} is none: give one such as Loss('huber')")
    return Loss() if loss is None else loss


def state_of(problem: Adjustment, layout: Layout) -> State:
    """Return the start of a problem, its points as they are laid out.

    Raises:
        InputError: a row of the intrinsics is of no lens.
    """
    Ts, lenses = problem.Ts_camera_world, lens_arrays(problem)
    if np.isnan(lenses.reach).any():
        row = int(np.argmax(np.isnan(lenses.reach)))
        name = problem.models[row]
        raise InputError(f"adjustment: intrinsics: row {row} has numbers that no {name} lens has")
    R, t = Ts[:, :3, :3].copy(), Ts[:, :3, 3].copy()
    return State(Views(R, t, problem.lens.copy()), lenses, problem.points_world[layout.point_order])


def room_for(layout: Layout, num_views: int) -> System:
    """Return room for the normal equations of a problem."""
    blocks, m = layout.blocks, len(layout.is_free_point)
    has_coupling = bool((blocks.lens >= 0).any()) and not layout.is_joined
    return System(
        np.where(blocks.is_held, 0.0, 1.0),
        np.empty(int(blocks.at[-1])),
        np.empty((num_views if has_coupling else 0, 6, 12)),
        np.empty(int(blocks.row[-1])),
        np.empty(int(layout.incidences.at[-1])),
        np.empty((m, 6)),
        np.zeros((m, 3)),
        np.zeros((m, 3)),
        np.zeros((m, 3)),
    )


def chi2_of(problem: Adjustment) -> Array:
    """Return the squared residuals (N,) of a problem in standard deviations; infinite unseen."""
    layout = lay_out(problem)
    laid, costs = np.empty(problem.num_observations), np.empty(problem.num_points)
    state = state_of(problem, layout)
    robust_cost(*state, layout.seen, loss_code(Loss()), 0.0, laid, costs)
    chi2 = np.empty_like(laid)
    chi2[layout.order] = laid
    return chi2


class Descent:
    """One descent: the state, its normal equations, and a second state to try."""

    def __init__(self, state: State, layout: Layout, loss: Loss, reduced: Reduced) -> None:
        self.state, self.layout, self.reduced = state, layout, reduced
        self.loss = loss_code(loss)
        self.system = room_for(layout, len(state.views.R))
        views, lenses, points = state
        self._trial = State(
            Views(np.empty_like(views.R), np.empty_like(views.t), views.lens),
            lenses._replace(theta=lenses.theta.copy(), reach=lenses.reach.copy()),
            np.empty_like(points),
        )
        is_free = (layout.blocks.lens >= 0) & (lenses.kind != 0)
        blocks = layout.blocks
        within = np.arange(len(blocks.is_held)) - np.repeat(blocks.row[:-1], blocks.size)
        row_at = np.repeat(blocks.at[:-1], blocks.size)
        self._diagonal = row_at + within * (np.repeat(blocks.size, blocks.size) + 1)
        self._free_lenses = np.flatnonzero(is_free)
        self.chi2 = np.empty(len(layout.order))
        self._costs, self._next_costs = np.zeros((2, len(points)))
        self._charge = 0.0
        self.cost, self.lost = self.evaluate(state)
        worst = float(np.max(self.chi2, where=np.isfinite(self.chi2), initial=LEAST_CHARGE))
        self._charge = 0.5 * float(loss.cost(worst))
        self.evaluate(state)
        self._set_scale()

    def evaluate(self, state: State) -> tuple[float, int]:
        """Return the cost of what is in sight, and how many observations are not."""
        seen, charge = self.layout.seen, self._charge
        return robust_cost(*state, seen, self.loss, charge, self.chi2, self._costs)

    def linearise(self, damping: float) -> System:
        """Fill the normal equations at the present state."""
        layout, state = self.layout, self.state
        linearise(
            *state,
            layout.is_free_point,
            layout.seen,
            layout.blocks,
            layout.incidences,
            self.loss,
            damping,
            self.system,
        )
        return self.system

    def attempt(self, damping: float, stopped: Callable[[], bool]) -> tuple[float, float, float]:
        """Try a step; return what it gains, what it promised, and the largest change.

        The gain is -inf, and the promise NaN, where there is no step.
        """
        system = self.linearise(damping)
        delta = self.reduced.step(system, damping, stopped)
        if delta is None or not np.isfinite(delta).all():
            return -np.inf, np.nan, 0.0
        blocks, trial = self.layout.blocks, self._trial
        promised = float(delta @ (damping * system.A[self._diagonal] * delta - system.a))
        step = system.scale * delta
        move_views(
            self.state.views, self.state.lenses, blocks, step, trial.views, trial.lenses.theta
        )
        fall, longest = move_points(
            self.state.views,
            self.state.points,
            self.layout.is_free_point,
            self.layout.seen,
            blocks,
            self.layout.incidences,
            system,
            delta,
            damping,
            trial.points,
        )
        promised = 0.5 * (promised + fall)
        largest = max(float(np.abs(step).max(initial=0.0)), longest)
        if not self._fit_lenses():
            return -np.inf, promised, largest
        cost, lost = refine_points(
            trial.views,
            trial.lenses,
            self.state.points,
            trial.points,
            self.layout.is_free_point,
            self.layout.seen,
            self.loss,
            self._charge,
            damping,
            self._costs,
            self._next_costs,
        )
        gained = self.cost - cost + self._charge * (self.lost - lost)
        self._next = cost, lost
        return (gained if np.isfinite(gained) else -np.inf), promised, largest

    def accept(self) -> None:
        """Take the step that was tried."""
        self.state, self._trial = self._trial, self.state
        self._costs, self._next_costs = self._next_costs, self._costs
        self.cost, self.lost = self._next

    def run(
        self,
        criteria: Criteria,
        stopped: Callable[[], bool],
        progress: Callable[[IterationRecord], None] | None,
    ) -> Account:
        """Descend until there is nothing left to gain, or a reason to stop."""
        began, history, before = time.perf_counter(), list[IterationRecord](), self.cost

        def record(step: float) -> None:
            elapsed = time.perf_counter() - began
            history.append(IterationRecord(len(history), self.cost, step, elapsed))
            if progress is not None:
                progress(history[-1])

        record(0.0)
        if not np.isfinite(before):
            reason = "the cost is not finite at the start"
            return Account(before, before, 0, False, reason, self._unsorted(), tuple(history))
        if not (np.isfinite(self.chi2) & (self.layout.seen.weight > 0.0)).any():
            reason = "nothing is in sight"
            return Account(before, before, 0, False, reason, self._unsorted(), tuple(history))
        damping, growth = criteria.damping, 2.0
        reason, converged = f"{criteria.iterations} iterations were spent", False
        for _ in range(criteria.iterations):
            if stopped():
                reason = "stopped on request"
                break
            gained, promised, step = self.attempt(damping, stopped)
            if stopped() and not gained > 0.0:
                reason = "stopped on request"
                break
            least = criteria.tolerance * self.cost + EXACT * len(self.chi2)
            if gained > 0.0:
                self.accept()
                trust = 1.0 - (2.0 * gained / max(promised, 1e-300) - 1.0) ** 3
                damping, growth = max(damping * max(0.1, trust), 1e-12), 2.0
            else:
                damping, growth = damping * growth, 2.0 * growth
            record(step)
            if 0.0 < gained <= least or promised <= ROUNDING * self.cost:
                reason, converged = "converged", True
                break
            if damping > 1e16:
                reason = "no step lowers the cost"
                break
        self.cost, self.lost = self.evaluate(self.state)
        chi2, spent = self._unsorted(), len(history) - 1
        return Account(before, self.cost, spent, converged, reason, chi2, tuple(history))

    def _unsorted(self) -> Array:
        chi2 = np.empty_like(self.chi2)
        chi2[self.layout.order] = self.chi2
        return chi2

    def _set_scale(self) -> None:
        """Scale the unknowns by the curvature at the start."""
        diagonal = self.linearise(0.0).A[self._diagonal]
        self.system.scale[diagonal > 0.0] = 1.0 / np.sqrt(diagonal[diagonal > 0.0])

    def _fit_lenses(self) -> bool:
        """Write how far the lenses tried reach; False if one is none."""
        lenses, which = self._trial.lenses, self._free_lenses
        if len(which):
            lenses.reach[which] = reaches(lenses, which)
        return not np.isnan(lenses.reach[which]).any()
