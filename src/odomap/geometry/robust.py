"""Robust losses: how much a residual may count when it might be wrong.

The problem: least squares lets one false match outvote a hundred true ones. A loss ρ(s) of the
normalised squared residual s = (r/σ)² grows slower than s; minimising ½ Σ ρ(s) is least squares
with weights w(s) = ρ'(s), recomputed at each step. With a constant c (in σ), beyond c where split:

    quadratic      s                       1
    huber          2c√s - c²               c/√s
    cauchy         c² log(1 + s/c²)        1 / (1 + s/c²)
    geman_mcclure  s / (1 + s/c²)          1 / (1 + s/c²)²
    tukey          c²/3 (1 - (1 - s/c²)³)  (1 - s/c²)²; 0 beyond c
    truncated      min(s, c²)              1; 0 beyond c
    dcs            s; c² (3s - c²)/(s + c²)  1; (2c² / (c² + s))²

The first three keep a pull from every residual, the others let go of gross ones. The default
constants lose 5 % efficiency on Gaussian noise in one dimension (truncated: three σ). The last is
dynamic covariance scaling (Agarwal, Tipaldi, Spinello, Stachniss, Burgard, ICRA 2013), Φ = c².

Reference: Z. Zhang, "Parameter estimation techniques: a tutorial with application to conic
fitting", Image and Vision Computing 15(1), 1997.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from odomap.errors import ConfigError, nearest_name
from odomap.geometry.so3 import Array

__all__ = [
    "LOSSES",
    "Loss",
    "cauchy_cost",
    "cauchy_weight",
    "dcs_cost",
    "dcs_weight",
    "geman_mcclure_cost",
    "geman_mcclure_weight",
    "huber_cost",
    "huber_weight",
    "quadratic_cost",
    "quadratic_weight",
    "truncated_cost",
    "truncated_weight",
    "tukey_cost",
    "tukey_weight",
]


def quadratic_cost(r2: ArrayLike, c: float = 1.0) -> Array:
    """Return s itself; arguments as `huber_cost`, c has no effect."""
    return np.array(r2, dtype=np.float64)


def quadratic_weight(r2: ArrayLike, c: float = 1.0) -> Array:
    """Return 1 for every residual."""
    return np.ones_like(np.asarray(r2, dtype=np.float64))


def huber_cost(r2: ArrayLike, c: float = 1.345) -> Array:
    """Return s up to c², then 2c√s - c².

    Args:
        r2: (...) normalised squared residuals, 0 or more.
        c: residual at which the loss turns linear, in standard deviations.

    Returns:
        (...) ρ(s).
    """
    s = np.asarray(r2, dtype=np.float64)
    return np.where(s <= c * c, s, 2.0 * c * np.sqrt(s) - c * c)


def huber_weight(r2: ArrayLike, c: float = 1.345) -> Array:
    """Return 1 up to c², then c/√s; arguments as `huber_cost`."""
    s = np.asarray(r2, dtype=np.float64)
    return np.asarray(c / np.sqrt(np.maximum(s, c * c)))


def cauchy_cost(r2: ArrayLike, c: float = 2.385) -> Array:
    """Return c² log(1 + s/c²); arguments as `huber_cost`."""
    return np.asarray(c * c * np.log1p(np.asarray(r2, dtype=np.float64) / (c * c)))


def cauchy_weight(r2: ArrayLike, c: float = 2.385) -> Array:
    """Return 1 / (1 + s/c²); arguments as `huber_cost`."""
    return np.asarray(1.0 / (1.0 + np.asarray(r2, dtype=np.float64) / (c * c)))


def geman_mcclure_cost(r2: ArrayLike, c: float = 3.787) -> Array:
    """Return s / (1 + s/c²), which never exceeds c²; arguments as `huber_cost`."""
    s = np.asarray(r2, dtype=np.float64)
    return np.asarray(s / (1.0 + s / (c * c)))


def geman_mcclure_weight(r2: ArrayLike, c: float = 3.787) -> Array:
    """Return 1 / (1 + s/c²)²; arguments as `huber_cost`."""
    return np.asarray(cauchy_weight(r2, c) ** 2)


def tukey_cost(r2: ArrayLike, c: float = 4.685) -> Array:
    """Return c²/3 (1 - (1 - s/c²)³) up to c², then c²/3; arguments as `huber_cost`."""
    rest = 1.0 - np.minimum(np.asarray(r2, dtype=np.float64) / (c * c), 1.0)
    return np.asarray(c * c / 3.0 * (1.0 - rest**3))


def tukey_weight(r2: ArrayLike, c: float = 4.685) -> Array:
    """Return (1 - s/c²)² up to c², then 0; arguments as `huber_cost`."""
    rest = 1.0 - np.minimum(np.asarray(r2, dtype=np.float64) / (c * c), 1.0)
    return np.asarray(rest * rest)


def dcs_cost(r2: ArrayLike, c: float = 1.898) -> Array:
    """Return s up to c², then c² (3s - c²) / (s + c²), below 3c²; arguments as `huber_cost`."""
    s = np.asarray(r2, dtype=np.float64)
    return np.where(s <= c * c, s, c * c * (3.0 * s - c * c) / (s + c * c))


def dcs_weight(r2: ArrayLike, c: float = 1.898) -> Array:
    """Return 1 up to c², then (2c² / (c² + s))²; arguments as `huber_cost`."""
    s = np.asarray(r2, dtype=np.float64)
    return np.asarray(np.minimum(1.0, 2.0 * c * c / (c * c + s)) ** 2)


def truncated_cost(r2: ArrayLike, c: float = 3.0) -> Array:
    """Return min(s, c²); arguments as `huber_cost`."""
    return np.minimum(np.asarray(r2, dtype=np.float64), c * c)


def truncated_weight(r2: ArrayLike, c: float = 3.0) -> Array:
    """Return 1 up to c², then 0; arguments as `huber_cost`."""
    return np.where(np.asarray(r2, dtype=np.float64) <= c * c, 1.0, 0.0)


_Rule = Callable[[ArrayLike, float], Array]

LOSSES: Mapping[str, tuple[_Rule, _Rule, float]] = MappingProxyType(
    {
        "quadratic": (quadratic_cost, quadratic_weight, 1.0),
        "huber": (huber_cost, huber_weight, 1.345),
        "cauchy": (cauchy_cost, cauchy_weight, 2.385),
        "geman_mcclure": (geman_mcclure_cost, geman_mcclure_weight, 3.787),
        "tukey": (tukey_cost, tukey_weight, 4.685),
        "truncated": (truncated_cost, truncated_weight, 3.0),
        "dcs": (dcs_cost, dcs_weight, 1.898),
    }
)
"""Cost, weight and default constant of each loss by name."""


@dataclass(frozen=True)
class Loss:
    """A robust loss by name.

    Attributes:
        name: a key of `LOSSES`.
        c: tuning constant in standard deviations; 0 means the loss's default.

    Raises:
        ConfigError: an unknown name, or a negative constant.

    Example:
        >>> Loss("huber", 1.0).weight([0.25, 4.0])
        array([1. , 0.5])
    """

    name: str = "quadratic"
    c: float = 0.0

    def __post_init__(self) -> None:
        if self.name not in LOSSES:
            known = ", ".join(LOSSES)
            hint = nearest_name(self.name, LOSSES)
            raise ConfigError(f"loss: '{self.name}' is unknown{hint}; known are {known}")
        if not (np.isfinite(self.c) and self.c >= 0):
            raise ConfigError(f"loss: c is {self.c}, must be above 0 (0: the default)")
        if self.c == 0:
            object.__setattr__(self, "c", LOSSES[self.name][2])

    def cost(self, r2: ArrayLike) -> Array:
        """Return ρ of normalised squared residuals (...)."""
        return LOSSES[self.name][0](r2, self.c)

    def weight(self, r2: ArrayLike) -> Array:
        """Return ρ' of normalised squared residuals (...)."""
        return LOSSES[self.name][1](r2, self.c)
