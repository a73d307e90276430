"""The gate of a bundle adjustment: gross errors are let go of first, and left out then.

Least squares bends good views until a gross error fits halfway, and a gate on its residuals then
throws out good and bad alike. So the problem is first solved by a loss that lets go of what is far,

    ρ(s) = s / (1 + s/c²)      (Geman, McClure),

from a width c at which most of it counts, a few times the median residual, down to half the gate:
the start says roughly what fits, and each solution says it better (graduated non-convexity). Only
then the gate decides, and the rest is solved again by the loss that was asked for until the same
observations stay. Cost: some more solutions; most of them take few steps.

Reference: M. J. Black, A. Rangarajan, "On the unification of line processes, outlier rejection, and
robust statistics with applications in early vision", IJCV 19(1), 1996.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["COARSE", "LETS_GO", "least_width", "next_width"]

Array = NDArray[np.float64]

LETS_GO = "geman_mcclure"
"""The loss by which gross errors lose their pull."""
COARSE = 1e-3
"""Part of the cost that a step must gain before the last width."""
WIDE = 3.0
"""First width, in median residuals."""
SHRINK = 3.0
"""By how much a width is smaller than the one before, at least."""


def least_width(gate: float) -> float:
    """Return the last width (standard deviations) before a gate decides."""
    return 0.5 * gate


def next_width(chi2: Array, weights: Array, gate: float, width: float = np.inf) -> float:
    """Return the width to solve with next.

    Args:
        chi2: (N,) squared residuals in standard deviations, infinite out of sight.
        weights: (N,) of the observations; those of zero have no say.
        gate: residual beyond which an observation is left out, in standard deviations.
        width: the one before.

    Example:
        >>> next_width(np.full(9, 100.0), np.ones(9), 5.0)
        30.0
        >>> next_width(np.full(9, 1.0), np.ones(9), 5.0, 30.0)
        3.0
        >>> next_width(np.full(9, 0.1), np.ones(9), 5.0, 3.0)
        2.5
    """
    counted = chi2[np.isfinite(chi2) & (weights > 0.0)]
    typical = float(np.sqrt(np.median(counted))) if len(counted) else 0.0
    return max(least_width(gate), min(width / SHRINK, WIDE * typical))
