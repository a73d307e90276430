"""Solving the reduced system of bundle adjustment: by factors, or by conjugate gradients.

A step δ of all views and lenses solves S δ = -s. `Factored` makes S in blocks and factors it
(`BlockCholesky`): exact, and cheap as long as views see little of what others see; a handful of
views all of which see each other is one dense front. `Conjugate` never makes S. Which is quicker
is known before the first step:

    factored     flops of the factor, and of the products V Vᵀ
    iterative    products of S with some tens of vectors

Reference: S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle adjustment in the large",
ECCV 2010.
"""

from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment import cg
from odomap.backend.adjustment.layout import Layout
from odomap.backend.adjustment.normal import System
from odomap.backend.adjustment.schur import (
    add_couplings,
    damped_diagonal,
    num_pairs,
    pattern_of,
    reduced_matrix,
)
from odomap.backend.sparse.blockcholesky import BlockCholesky

__all__ = ["METHODS", "Factored", "Iterative", "Method", "Pointwise", "Reduced", "reduced_solver"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Method = Literal["auto", "factored", "iterative"]
METHODS = ("auto", "factored", "iterative")

PRODUCTS = 60.0
"""Products S x that a step of conjugate gradients is expected to take."""
SMALL = 1e8
"""Flops of a factor that are never worth avoiding."""
SLOWER = 4.0
"""By how much a flop of a product, fetched from memory, costs more than one of a factor."""
MAX_NUMBERS = 2**28
"""Numbers a factor may have: 2 GB."""
CHUNK = 10
"""Steps of conjugate gradients between two looks at the stop flag."""


class Reduced(Protocol):
    """What solves the reduced system."""

    @property
    def name(self) -> str:
        """What it is called in a solution."""
        ...

    def step(self, system: System, damping: float, stopped: Callable[[], bool]) -> Array | None:
        """Return δ (n,), or None where the system is not positive definite."""
        ...


class Pointwise:
    """Where only points are free there is nothing to solve."""

    name = "points"

    def step(self, system: System, damping: float, stopped: Callable[[], bool]) -> Array | None:
        """Return δ (0,)."""
        return np.zeros(0)


class Factored:
    """Makes S and factors it."""

    name = "factored"

    def __init__(self, layout: Layout, lens: Index) -> None:
        self.layout, self.lens = layout, lens
        self.pattern = pattern_of(layout, lens)
        self.factor = BlockCholesky(self.pattern)
        blocks = layout.blocks
        self._values = np.empty(self.pattern.num_values)
        self._s = np.empty(self.pattern.size)
        self._row_pair = np.searchsorted(self.pattern.first, np.arange(len(blocks.size) + 1))
        self._slot = np.zeros(len(blocks.size), np.int64)
        is_coupled = (blocks.pose >= 0) & (blocks.lens[lens] >= 0) & (not layout.is_joined)
        self._coupled = np.full(len(lens), -1)
        self._coupled[is_coupled] = self.pattern.pair_of(
            blocks.pose[is_coupled], blocks.lens[lens[is_coupled]]
        )

    def assemble(self, system: System, damping: float) -> tuple[Array, Array]:
        """Return the values of S and s (n,)."""
        blocks, pattern = self.layout.blocks, self.pattern
        damped_diagonal(blocks, system.A, damping, self._values)
        add_couplings(
            blocks, self.lens, system.coupling, self._coupled, pattern.pair_start, self._values
        )
        reduced_matrix(
            blocks,
            self.layout.incidences,
            pattern.second,
            self._row_pair,
            pattern.pair_start,
            system,
            self._slot,
            self._values,
            self._s,
        )
        return self._values, self._s

    def step(self, system: System, damping: float, stopped: Callable[[], bool]) -> Array | None:
        """Return δ (n,), or None where the system is not positive definite."""
        values, s = self.assemble(system, damping)
        return self.factor.solve(-s) if self.factor.factor(values) else None


class Iterative:
    """Conjugate gradients, preconditioned by the diagonal blocks of S."""

    name = "iterative"

    def __init__(self, layout: Layout, lens: Index, steps: int, eta: float) -> None:
        self.layout, self.lens, self.steps, self.eta = layout, lens, steps, eta
        self.inner = 0
        blocks = layout.blocks
        n = int(blocks.row[-1])
        x, r, p, z, Sp = np.zeros((5, n))
        self._state = cg.Conjugate(x, r, p, z, Sp, np.zeros(3))
        self._D, self._M = np.zeros(int(blocks.at[-1])), np.zeros(int(blocks.at[-1]))
        self._s = np.zeros(n)

    def step(self, system: System, damping: float, stopped: Callable[[], bool]) -> Array | None:
        """Return δ (n,), or None where the system is not positive definite."""
        blocks, incidences = self.layout.blocks, self.layout.incidences
        damped_diagonal(blocks, system.A, damping, self._D)
        self.inner = 0
        if not cg.precondition(blocks, incidences, self._D, system, self._M, self._s):
            return None
        cg.start_conjugate(blocks, self._M, self._s, self._state)
        done = False
        while not done and self.inner < self.steps and not stopped():
            done = cg.conjugate_steps(
                blocks,
                incidences,
                self._D,
                self.lens,
                system.coupling,
                system.V,
                self._M,
                self._s,
                min(CHUNK, self.steps - self.inner),
                self.eta,
                self._state,
            )
            self.inner = int(self._state.scalars[2])
        return self._state.x.copy()


def reduced_solver(layout: Layout, lens: Index, method: Method, steps: int, eta: float) -> Reduced:
    """Return what solves the reduced system of a problem.

    Args:
        layout: of the problem.
        lens: (K,) of each view.
        method: "auto" takes what promises to be quicker and fits into memory.
        steps: most conjugate gradient steps.
        eta: when these are good enough.
    """
    if len(layout.blocks.size) == 0:
        return Pointwise()
    product = 4.0 * float(layout.incidences.at[-1])
    if method == "iterative" or (method == "auto" and _num_values(layout, lens) > MAX_NUMBERS):
        return Iterative(layout, lens, steps, eta)
    factored = Factored(layout, lens)
    is_quick = factored.factor.flops <= max(PRODUCTS * SLOWER * product, SMALL)
    if method == "factored" or (is_quick and factored.factor.num_nonzeros <= MAX_NUMBERS):
        return factored
    return Iterative(layout, lens, steps, eta)


def _num_values(layout: Layout, lens: Index) -> float:
    """Return about how many numbers S has."""
    return num_pairs(layout, lens) * float(np.mean(layout.blocks.size)) ** 2
