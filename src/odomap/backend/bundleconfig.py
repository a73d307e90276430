"""How a bundle is adjusted: a section of the configuration, apart from what is compiled."""

from dataclasses import dataclass
from typing import Annotated

from odomap.limits import Limits, NotNegative, Positive, check_limits

__all__ = ["BundleConfig"]


@dataclass(frozen=True)
class BundleConfig:
    """How a bundle is solved."""

    iterations: Annotated[int, Limits(least=0)] = 4
    """Most Levenberg-Marquardt steps tried."""
    huber_width: Positive = 2.5
    """Residual, in standard deviations, beyond which Huber's loss grows linearly."""
    tolerance: NotNegative = 3e-3
    """Relative decrease of the cost below which the solver stops."""

    def __post_init__(self) -> None:
        check_limits(self)
