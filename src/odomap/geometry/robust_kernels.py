"""Compiled robust losses: the formulas of `robust`, one residual at a time.

A loss is handed to a kernel as its number in `LOSS_CODES` and its constant c; see `robust` for what
each is, and when to use it. O(1), no allocation.

Reference: Z. Zhang, "Parameter estimation techniques: a tutorial with application to conic
fitting", Image and Vision Computing 15(1), 1997.
"""

from types import MappingProxyType

import numpy as np

from odomap.geometry.robust import LOSSES, Loss
from odomap.kernels import kernel

__all__ = ["LOSS_CODES", "loss_code", "loss_cost", "loss_weight", "warm_up"]

LOSS_CODES = MappingProxyType({name: code for code, name in enumerate(LOSSES)})
"""Number of each loss, in the order of `robust.LOSSES`."""


def loss_code(loss: Loss) -> tuple[int, float]:
    """Return what kernels take for a loss: its number and its constant."""
    return LOSS_CODES[loss.name], float(loss.c)


@kernel
def loss_cost(code: int, c: float, s: float) -> float:
    """ρ(s) of the normalised squared residual s."""
    c2 = c * c
    if code == 1:
        return s if s <= c2 else 2.0 * c * np.sqrt(s) - c2
    if code == 2:
        return float(c2 * np.log1p(s / c2))
    if code == 3:
        return s / (1.0 + s / c2)
    if code == 4:
        rest = max(1.0 - s / c2, 0.0)
        return c2 / 3.0 * (1.0 - rest * rest * rest)
    if code == 5:
        return min(s, c2)
    if code == 6:
        return s if s <= c2 else c2 * (3.0 * s - c2) / (s + c2)
    return s


@kernel
def loss_weight(code: int, c: float, s: float) -> float:
    """ρ'(s) of the normalised squared residual s."""
    c2 = c * c
    if code == 1:
        return 1.0 if s <= c2 else c / np.sqrt(s)
    if code == 2:
        return 1.0 / (1.0 + s / c2)
    if code == 3:
        return 1.0 / ((1.0 + s / c2) * (1.0 + s / c2))
    if code == 4:
        rest = max(1.0 - s / c2, 0.0)
        return rest * rest
    if code == 5:
        return 1.0 if s <= c2 else 0.0
    if code == 6:
        scale = min(1.0, 2.0 * c2 / (c2 + s))
        return scale * scale
    return 1.0


def warm_up() -> None:
    """Compile the kernels of this file."""
    loss_cost(1, 1.0, 2.0)
    loss_weight(1, 1.0, 2.0)
