"""The difference of a path and its truth, in the two ways a picture needs.

For the eye, the whole path is laid on the truth as well as a rigid motion can (Umeyama), and each
pose coloured by its distance. For the covariance, which is relative to the first pose, the first
poses are laid on each other, and the error is e = log(T_true⁻¹ T̂), to be seen inside ±3σ.
O(N) after matching by time.

Reference: Z. Zhang, D. Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation for
Visual(-Inertial) Odometry", IROS 2018.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.align import umeyama
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.geometry.pose import Sim3
from odomap.geometry.trajectory import Trajectory

__all__ = ["PathError", "finite_part"]

AT_LEAST = 3


@dataclass(frozen=True, eq=False)
class PathError:
    """Errors of a trajectory at the times the truth knows.

    Attributes:
        index: (N,) which poses of the trajectory these are.
        stamps_ns: (N,) their stamps, nanoseconds.
        distances: (N,) position errors after the best rigid alignment, metres.
        errors: (N, 6) log(T_true⁻¹ T_est) after aligning the first poses, metres and radians.
        sigmas: (N, 6) claimed standard deviations of `errors`, or None.
        T_truth_estimate: the best rigid alignment.
    """

    index: NDArray[np.intp]
    stamps_ns: NDArray[np.int64]
    distances: NDArray[np.float64]
    errors: NDArray[np.float64]
    sigmas: NDArray[np.float64] | None
    T_truth_estimate: Sim3

    @classmethod
    def of(
        cls, trajectory: Trajectory | None, truth: Trajectory | None, max_dt_s: float = 0.02
    ) -> "PathError | None":
        """Compare two trajectories; None where fewer than three poses can be compared."""
        if trajectory is None or truth is None or not len(trajectory) or not len(truth):
            return None
        i, j = trajectory.associate(truth, max_dt_s)
        E, G = trajectory.Ts_world_body[i], truth.Ts_world_body[j]
        finite = np.isfinite(E).all(axis=(1, 2)) & np.isfinite(G).all(axis=(1, 2))
        i, E, G = i[finite], E[finite], G[finite]
        if len(i) < AT_LEAST:
            return None
        S = umeyama(E[:, :3, 3], G[:, :3, 3])
        distances = np.linalg.norm(G[:, :3, 3] - S @ np.ascontiguousarray(E[:, :3, 3]), axis=1)
        errors = se3_log(se3_inverse(G) @ (G[0] @ se3_inverse(E[0]) @ E))
        return cls(i, trajectory.stamps_ns[i], distances, errors, sigmas(trajectory, i), S)


def sigmas(trajectory: Trajectory, index: NDArray[np.intp]) -> NDArray[np.float64] | None:
    """Return the standard deviations (N, 6) of some poses, NaN where a variance is no number."""
    if trajectory.covariances is None:
        return None
    variances = np.diagonal(trajectory.covariances[index], axis1=1, axis2=2)
    good = np.isfinite(variances) & (variances >= 0)
    return np.sqrt(np.where(good, variances, np.nan))


def finite_part(trajectory: Trajectory | None) -> NDArray[np.intp]:
    """Return the indices of the poses that are numbers."""
    if trajectory is None:
        return np.zeros(0, np.intp)
    return np.nonzero(np.isfinite(trajectory.Ts_world_body).all(axis=(1, 2)))[0]
