"""Whether an estimator is as good as it says: errors against its own covariances.

A covariance P is a promise about the error e. If it is kept, the normalised error squared follows
a χ² distribution with as many degrees of freedom as e has numbers (here 6):

    NEES_k = e_kᵀ P_k⁻¹ e_k,      e_k = log(T_true,k⁻¹ T̂_k),      E[NEES] = 6

A mean per degree of freedom above 1 is overconfidence, below 1 timidity. The tangent is that of
all poses here: (translation, rotation), update on the right. Covariances are relative to the first
pose, which is exact by definition, so the first poses are laid on each other before comparing.
O(N) 6x6 Cholesky factorisations.

Reference: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
Navigation", Wiley 2001, section 5.4.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.evaluation.match import match
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.geometry.trajectory import Trajectory

__all__ = ["NeesResult", "consistency", "nees"]

CHI2_6_95 = (1.2373, 14.4494)
"""Two-sided 95 % interval of χ² with six degrees of freedom."""


@dataclass(frozen=True, eq=False)
class NeesResult:
    """Normalised estimation error squared of every pose.

    Attributes:
        values: (N,) eᵀ P⁻¹ e, no unit; NaN where P is not positive definite (the first pose).
        errors: (N, 6) e = log(T_true⁻¹ T_est), translation in metres, rotation in radians.
        stamps_ns: (N,) stamps, nanoseconds.
        mean: mean of the values that are numbers; 6 when the covariances are right.
        per_dof: mean divided by 6; 1 when the covariances are right.
        inside_95: share of the values inside the 95 % interval of χ² with 6 degrees of freedom.
        used: how many values are numbers.
    """

    values: NDArray[np.float64]
    errors: NDArray[np.float64]
    stamps_ns: NDArray[np.int64]
    mean: float
    per_dof: float
    inside_95: float
    used: int

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by name."""
        return {
            "used": self.used,
            "nees_mean": self.mean,
            "nees_per_dof": self.per_dof,
            "inside_95": self.inside_95,
        }


def nees(errors: NDArray[np.float64], covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute eᵀ P⁻¹ e of each error.

    Args:
        errors: (N, D) errors.
        covariances: (N, D, D) their claimed covariances, same units and order.

    Returns:
        (N,) values; NaN where a covariance is not positive definite or anything is not finite.

    Raises:
        InputError: the shapes do not belong together.
    """
    e, P = np.asarray(errors, np.float64), np.asarray(covariances, np.float64)
    if e.ndim != 2 or P.shape != (*e.shape, e.shape[1]):
        raise InputError(f"errors {e.shape} and covariances {P.shape}: want (N, D) and (N, D, D)")
    return np.array([_one(ek, Pk) for ek, Pk in zip(e, P)], dtype=np.float64)


def _one(e: NDArray[np.float64], P: NDArray[np.float64]) -> float:
    if not (np.isfinite(e).all() and np.isfinite(P).all()):
        return float("nan")
    # Metres and radians differ by orders of magnitude: scale to unit variances before factoring.
    s = np.sqrt(np.clip(np.diag(P), 0.0, None))
    if not (s > 0).all():
        return float("nan")
    try:
        L = np.linalg.cholesky(P / np.outer(s, s))
    except np.linalg.LinAlgError:
        return float("nan")
    z = np.linalg.solve(L, e / s)
    return float(z @ z)


def consistency(estimate: Trajectory, reference: Trajectory, max_dt_s: float = 0.02) -> NeesResult:
    """Compare the errors of a trajectory with its own covariances.

    Args:
        estimate: trajectory with covariances, relative to its first pose.
        reference: ground truth, of the same body.
        max_dt_s: largest difference in time of two poses compared, seconds.

    Raises:
        InputError: the estimate has no covariances, none is positive definite, or too few poses
            match in time.
    """
    pairs = match(estimate, reference, max_dt_s)
    if pairs.covariances is None:
        raise InputError("estimate: has no covariances, so that its consistency cannot be judged")
    A = pairs.Ts_reference[0] @ se3_inverse(pairs.Ts_estimate[0])
    errors = se3_log(se3_inverse(pairs.Ts_reference) @ (A @ pairs.Ts_estimate))
    values = nees(errors, pairs.covariances)
    good = values[np.isfinite(values)]
    if len(good) == 0:
        raise InputError("estimate: no covariance is positive definite")
    inside = (good >= CHI2_6_95[0]) & (good <= CHI2_6_95[1])
    mean = float(good.mean())
    return NeesResult(
        values, errors, pairs.stamps_ns, mean, mean / 6.0, float(inside.mean()), len(good)
    )
