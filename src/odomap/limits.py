"""What a setting may be: limits written beside the field, checked whenever a section is made.

A number that cannot be (no features, a deviation of zero, NaN) would otherwise fail far from where
it was set. A field says its limits in its type, and its section checks them all at once:

    @dataclass(frozen=True)
    class FeatureConfig:
        count: Count = 300

        def __post_init__(self) -> None:
            check_limits(self)

Only what cannot be is refused; what is merely unwise is the user's choice. The message begins with
the field; `settings` puts the file and the section before it.
"""

import math
import typing
from dataclasses import dataclass
from typing import Annotated

from odomap.errors import ConfigError

__all__ = ["Correlation", "Count", "Fraction", "Limits", "NotNegative", "Positive", "check_limits"]


@dataclass(frozen=True)
class Limits:
    """The numbers a field may hold.

    Attributes:
        above: it must be larger than this.
        least: it must be this or larger.
        most: it must be this or smaller.
    """

    above: float = -math.inf
    least: float = -math.inf
    most: float = math.inf

    def admit(self, value: float) -> bool:
        """Say whether a number is finite and within the limits."""
        return math.isfinite(value) and self.above < value and self.least <= value <= self.most

    def __str__(self) -> str:
        """Return the limits in words, such as ``above 0 and at most 1``."""
        words = {"above": self.above, "at least": self.least, "at most": self.most}
        return " and ".join(f"{word} {x:g}" for word, x in words.items() if math.isfinite(x))


Count = Annotated[int, Limits(above=0)]
"""How many (things, steps, pixels): 1 or more."""
Positive = Annotated[float, Limits(above=0)]
"""A standard deviation, a width, a radius."""
NotNegative = Annotated[float, Limits(least=0)]
"""A distance or a tolerance that may be zero."""
Fraction = Annotated[float, Limits(least=0, most=1)]
"""A part of a whole."""
Correlation = Annotated[float, Limits(least=-1, most=1)]
"""A normalised correlation."""


def check_limits(section: object) -> None:
    """Check all fields of a dataclass that have `Limits` in their type.

    Args:
        section: the dataclass, just made.

    Raises:
        ConfigError: a number is NaN, infinite or outside its limits.
    """
    for name, hint in typing.get_type_hints(type(section), include_extras=True).items():
        value = getattr(section, name)
        for limits in getattr(hint, "__metadata__", ()):
            if isinstance(limits, Limits) and not limits.admit(value):
                wanted = limits if math.isfinite(value) else "a finite number"
                raise ConfigError(f"{name}: {value} must be {wanted}")
