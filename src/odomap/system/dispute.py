"""Disputes: when what was just created contradicts what is settled, the settled decide.

A thing that moves through the view makes landmarks like any other. The more of the view it fills,
the more of them there are, until the many new ones outvote the old and the camera is believed to
move with the thing. But it has only just come: landmarks that several keyframes have agreed on
were there before. So where a pose leaves too many of the settled landmarks out, it is solved for
with those alone, and of the others only those count that agree with it.

Where all agree, which is nearly always, nothing is different.

Reference: Wangsiripitak, Murray, "Avoiding moving outliers in visual SLAM by tracking moving
objects", ICRA 2009 (the danger of landmarks on things that move).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.motion import MotionSolution

__all__ = ["FEWEST", "SETTLED", "settle"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SETTLED = 2
"""Keyframes that must see a landmark for it to be settled."""
FEWEST = 15
"""With fewer settled landmarks there is nobody to decide."""
UNDISPUTED = 0.95
"""Part of the settled ones that agree with a pose nobody disputes."""
UNITED = 0.85
"""Part of the settled ones that must agree with each other for them to decide."""
ITERATIONS = 10
"""Most steps of each round of a solution."""
GATE = 3.5
"""Residual, in standard deviations, up to which another landmark agrees."""


def settle(
    solve: Callable[[Mask, Array, int], MotionSolution], is_settled: Mask, T_world_body: Array
) -> MotionSolution:
    """Find a pose by what is settled where that is in dispute, else by everything.

    Args:
        solve: finds the pose from some of the n observations, given a mask (n,) of them, a
            first pose (4, 4), and the most iterations.
        is_settled: (n,) which observations are of settled landmarks.
        T_world_body: (4, 4) predicted.

    Returns:
        The pose; in a dispute, what disagrees with the settled is an outlier.
    """
    everything = np.ones(len(is_settled), np.bool_)
    full = solve(everything, T_world_body, ITERATIONS)
    count = int(is_settled.sum())
    agreed = int(full.inliers[is_settled].sum()) if full.converged else 0
    if is_settled.all() or count < FEWEST or agreed >= UNDISPUTED * count:
        return full
    first = solve(is_settled, T_world_body, ITERATIONS)
    among = int(first.inliers.sum())
    if not first.converged or among <= agreed or among < UNITED * count:
        return full
    chi2 = solve(everything, first.T_world_body, 0).chi2
    agrees = is_settled | (chi2 <= GATE**2)
    part = solve(agrees, first.T_world_body, ITERATIONS)
    inliers, all_chi2 = np.zeros(len(agrees), np.bool_), np.full(len(agrees), np.inf)
    inliers[agrees], all_chi2[agrees] = part.inliers, part.chi2
    return replace(part, inliers=inliers, chi2=all_chi2)
