"""Descent: Gauss-Newton, Levenberg-Marquardt and Powell's dogleg on large sparse problems.

Around x the cost is modelled as c + gᵀδ + ½ δᵀHδ with δ in the tangent of x and H sparse. All
methods solve that model, try the step and look at the gain it brought over the gain it promised:

    Gauss-Newton          δ = -H⁻¹ g; every step is taken: few steps, from a good start
    Levenberg-Marquardt   δ = -(H + λ diag H)⁻¹ g; λ falls with good steps, grows with bad ones
    dogleg                from the Cauchy point -(ĝᵀĝ / ĝᵀĤĝ) ĝ towards the Gauss-Newton step, as
                          far as a radius of trust allows; a refused step costs no factorisation

Hats are the variables scaled by √diag H, so that metres and radians compare. The radius begins
unbounded: from a good start the dogleg is Gauss-Newton. A descent ends when the next step promises
a smaller fraction of the cost than the tolerance, or hardly moves; otherwise it says honestly why
it stopped. The point returned is never worse than the start, nor anything but finite.

Reference: K. Madsen, H. B. Nielsen, O. Tingleff, "Methods for non-linear least squares problems",
2nd ed., DTU, 2004.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Generic, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.errors import ConfigError
from odomap.limits import Limits, NotNegative, Positive, check_limits

__all__ = ["Descent", "IterationRecord", "Linear", "Method", "Problem", "SolverConfig", "descend"]

Array = NDArray[np.float64]
Method = Literal["gauss_newton", "levenberg_marquardt", "dogleg"]
METHODS = ("gauss_newton", "levenberg_marquardt", "dogleg")
X = TypeVar("X")

_ZERO = 1e-300


@dataclass(frozen=True)
class SolverConfig:
    """How a large problem is solved."""

    method: Method = "dogleg"
    """gauss_newton, levenberg_marquardt or dogleg."""
    iterations: Annotated[int, Limits(least=0)] = 100
    """Most steps tried."""
    tolerance: NotNegative = 1e-9
    """Stop when a step promises a smaller fraction of the cost."""
    step_tolerance: NotNegative = 1e-10
    """Stop when no unknown would move by more, metres or radians."""
    damping: Positive = 1e-4
    """First λ of Levenberg-Marquardt."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.method not in METHODS:
            raise ConfigError(f"method: '{self.method}' is unknown, give {', '.join(METHODS)}")
        if not isinstance(self.iterations, int | np.integer):
            raise ConfigError(f"iterations: {self.iterations} must be a whole number")


@dataclass(frozen=True)
class IterationRecord:
    """One step: its number, the cost after it, the largest change of an unknown, and the time.

    Attributes:
        iteration: 0 is the start.
        cost: at the best point so far.
        step: largest entry of the step tried, metres or radians.
        seconds: since the descent began.
    """

    iteration: int
    cost: float
    step: float
    seconds: float


@dataclass
class Linear:
    """The problem linearised at a point: its cost, values of H by the pattern, and g (n,)."""

    cost: float
    values: Array
    gradient: Array

    @classmethod
    def empty(cls, pattern: BlockPattern) -> "Linear":
        """Return room for a problem of that pattern."""
        return cls(np.inf, np.zeros(pattern.num_values), np.zeros(pattern.size))


class Problem(Protocol[X]):
    """What can be descended: a cost that knows its sparse second-order model."""

    @property
    def pattern(self) -> BlockPattern:
        """Where H has blocks."""
        ...

    @property
    def factor(self) -> BlockCholesky:
        """Room for the factor of H, analysed."""
        ...

    def linearise(self, x: X, out: Linear) -> None:
        """Write cost, H and g at x."""
        ...

    def retract(self, x: X, step: Array) -> X:
        """Return x moved by a step (n,) in its tangent."""
        ...


@dataclass(frozen=True)
class Descent(Generic[X]):
    """Where a descent ended, and why.

    Attributes:
        x: the best point found.
        cost_before, cost_after: at the start and at x.
        iterations: steps tried.
        converged: whether there was nothing left to gain.
        reason: why it stopped, in words.
        history: one record per step, the start first.
    """

    x: X
    cost_before: float
    cost_after: float
    iterations: int
    converged: bool
    reason: str
    history: tuple[IterationRecord, ...]


def descend(
    problem: Problem[X],
    x: X,
    config: SolverConfig,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[IterationRecord], None] | None = None,
) -> Descent[X]:
    """Minimise a problem from a start.

    Args:
        problem: what to minimise.
        x: the start.
        config: method and limits.
        stop: asked before each step; true ends the descent with what there is.
        progress: told of each step.

    Returns:
        The best point found and why it stopped; look at `converged`.
    """
    began, history = time.perf_counter(), list[IterationRecord]()

    def record(cost: float, step: float) -> None:
        elapsed = time.perf_counter() - began
        history.append(IterationRecord(len(history), cost, step, elapsed))
        if progress is not None:
            progress(history[-1])

    now, spare = Linear.empty(problem.pattern), Linear.empty(problem.pattern)
    problem.linearise(x, now)
    before = now.cost
    record(before, 0.0)
    if not np.isfinite(before):
        return Descent(x, before, before, 0, False, "the cost is not finite", tuple(history))
    region = _REGIONS[config.method](problem, config)
    reason, converged = f"{config.iterations} iterations were spent", False
    best, lowest = x, before
    for _ in range(config.iterations):
        if stop is not None and stop():
            reason = "stopped on request"
            break
        proposal = region.propose(now)
        if proposal is None:
            reason = "the equations are singular: something is not determined by what was measured"
            break
        size = float(np.abs(proposal.step).max(initial=0.0))
        is_still = size <= config.step_tolerance and proposal.promised >= proposal.possible
        if is_still or proposal.possible <= config.tolerance * now.cost:
            reason, converged = "converged", True
            break
        moved = problem.retract(x, proposal.step)
        problem.linearise(moved, spare)
        gained = now.cost - spare.cost if np.isfinite(spare.cost) else -np.inf
        if region.accepts(gained, proposal.promised):
            x, now, spare = moved, spare, now
            best, lowest = (x, now.cost) if now.cost <= lowest else (best, lowest)
        record(lowest, size)
        if region.is_hopeless():
            reason = "no step lowers the cost"
            break
    return Descent(best, before, lowest, len(history) - 1, converged, reason, tuple(history))


class _Proposal(NamedTuple):
    """A step, the decrease that the model promises for it, and for a step without bounds."""

    step: Array
    promised: float
    possible: float


class _GaussNewton:
    """Trusts the model everywhere."""

    def __init__(self, problem: Problem[Any], config: SolverConfig) -> None:
        self.problem = problem
        self.rises = 0

    def propose(self, now: Linear) -> _Proposal | None:
        """Return a step, or None if there is none."""
        if not _factor(self.problem, now):
            return None
        step = -self.problem.factor.solve(now.gradient)
        promised = -0.5 * float(now.gradient @ step)
        return _Proposal(step, promised, promised)

    def accepts(self, gained: float, promised: float) -> bool:
        """Say whether to take the step, and learn from it."""
        self.rises = self.rises + 1 if gained < 0.0 else 0
        return bool(np.isfinite(gained))

    def is_hopeless(self) -> bool:
        """Say whether to give up."""
        return self.rises >= 5


class _Levenberg(_GaussNewton):
    """Trusts the model less where it was wrong."""

    def __init__(self, problem: Problem[Any], config: SolverConfig) -> None:
        super().__init__(problem, config)
        self.damping, self.raise_by = config.damping, 2.0

    def propose(self, now: Linear) -> _Proposal | None:
        where, factor = self.problem.pattern.diagonal, self.problem.factor
        diagonal = now.values[where]
        floor = 1e-12 * diagonal.max(initial=0.0)
        while not self.is_hopeless():
            added = self.damping * np.maximum(diagonal, floor)
            now.values[where] = diagonal + added
            is_sound = factor.factor(now.values)
            now.values[where] = diagonal
            if is_sound:
                step = -factor.solve(now.gradient)
                promised = 0.5 * float(step @ (added * step - now.gradient))
                return _Proposal(step, promised, promised * max(1.0, self.damping))
            self.accepts(-np.inf, 1.0)
        return None

    def accepts(self, gained: float, promised: float) -> bool:
        if not gained > 0.0:
            self.damping, self.raise_by = self.damping * self.raise_by, 2.0 * self.raise_by
            return False
        trust = 1.0 - (2.0 * gained / max(promised, _ZERO) - 1.0) ** 3
        self.damping, self.raise_by = max(self.damping * max(1.0 / 3.0, trust), 1e-15), 2.0
        return True

    def is_hopeless(self) -> bool:
        return self.damping > 1e12


class _Dogleg(_GaussNewton):
    """Trusts the model within a radius."""

    def __init__(self, problem: Problem[Any], config: SolverConfig) -> None:
        super().__init__(problem, config)
        self.radius, self.length = np.inf, 0.0
        self.newton: _Proposal | None = None

    def propose(self, now: Linear) -> _Proposal | None:
        if self.newton is None:
            self.newton = super().propose(now)
            if self.newton is None:
                return None
        scale = np.sqrt(np.maximum(now.values[self.problem.pattern.diagonal], _ZERO))
        full = scale * self.newton.step
        self.length = float(np.linalg.norm(full))
        if self.length <= self.radius:
            return self.newton
        step = self._within(full, scale * self._cauchy(now, scale)) / scale
        self.length = float(np.linalg.norm(scale * step))
        curved = self.problem.pattern.multiply(now.values, step)
        promised = -float(now.gradient @ step) - 0.5 * float(step @ curved)
        return _Proposal(step, promised, self.newton.possible)

    def _cauchy(self, now: Linear, scale: Array) -> Array:
        """Return the lowest point along steepest descent of the scaled variables."""
        downhill = -now.gradient / (scale * scale)
        curved = self.problem.pattern.multiply(now.values, downhill)
        length = -float(now.gradient @ downhill) / max(float(downhill @ curved), _ZERO)
        return np.asarray(length * downhill)

    def _within(self, newton: Array, cauchy: Array) -> Array:
        """Return where the path 0 → Cauchy → Newton leaves the radius, in scaled variables."""
        size = float(np.linalg.norm(cauchy))
        if size >= self.radius:
            return np.asarray(self.radius / size * cauchy)
        leg = newton - cauchy
        a, b, c = float(leg @ leg), float(cauchy @ leg), size * size - self.radius**2
        further = (-b + np.sqrt(max(b * b - a * c, 0.0))) / max(a, _ZERO)
        return np.asarray(cauchy + further * leg)

    def accepts(self, gained: float, promised: float) -> bool:
        ratio = gained / max(promised, _ZERO)
        if ratio > 0.75:
            self.radius = max(self.radius, 3.0 * self.length)
        elif not ratio > 0.25:
            self.radius = 0.5 * self.length
        if not gained > 0.0:
            return False
        self.newton = None
        return True

    def is_hopeless(self) -> bool:
        return self.radius < 1e-12


_REGIONS = MappingProxyType(
    {"gauss_newton": _GaussNewton, "levenberg_marquardt": _Levenberg, "dogleg": _Dogleg}
)


def _factor(problem: Problem[Any], now: Linear) -> bool:
    """Factor H; where something is not determined, H plus as little as makes it definite."""
    if problem.factor.factor(now.values):
        return True
    mean = float(np.abs(now.values[problem.pattern.diagonal]).mean())
    return any(problem.factor.factor(now.values, mean * 10.0**power) for power in range(-12, 1, 2))
