"""Adjusting: how a map is adjusted as a whole after a loop was closed; what a configuration says.

Stands apart from what adjusts (`globaladjustment`), so that a run that closes no loops compiles
none of it.

Reference: Mur-Artal, Tardós, "ORB-SLAM2: an open-source SLAM system for monocular, stereo and RGB-D
cameras", T-RO 2017, section III-D.
"""

from dataclasses import dataclass
from typing import Annotated

from odomap.limits import Count, Limits, NotNegative, check_limits

__all__ = ["AdjustingConfig"]


@dataclass(frozen=True)
class AdjustingConfig:
    """How the whole map is adjusted after a loop was closed."""

    enabled: bool = True
    """Whether it is; only where loops are closed (`closing.enabled`)."""
    after: Annotated[int, Limits(least=0)] = 10
    """Keyframes from a loop to the one at which that begins: what mapping ties of the two sides
    meanwhile, a window's worth, is what holds the loop closed."""
    iterations: Count = 10
    """Most steps of the solver."""
    tolerance: NotNegative = 1e-3
    """Stop when a step gains a smaller fraction of the cost."""

    def __post_init__(self) -> None:
        check_limits(self)
