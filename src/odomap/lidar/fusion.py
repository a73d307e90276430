"""Fusion of two things that are known of one pose in the plane.

A prediction is sure to P, a scan says Λ; together the pose is sure to

    (P⁻¹ + Λ)⁻¹ = (I + P Λ)⁻¹ P,

where neither need be regular: along a corridor a scan says nothing, and what has not moved is sure.
Such a 3 by 3 system is solved several times a scan, so by a kernel: NumPy's solver takes longer to
be called than this takes to solve. With P and Λ exchanged it is how much a scan still says of
which all is off by D together, (H⁻¹ + D)⁻¹.

Cost: a microsecond.

Reference: S. Thrun, W. Burgard, D. Fox, "Probabilistic robotics", MIT Press 2005, section 3.2.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["fused"]

Array = NDArray[np.float64]


def fused(covariance: Array, information: Array) -> Array:
    """Return (P⁻¹ + Λ)⁻¹ = (I + P Λ)⁻¹ P (3, 3), for which neither need be regular."""
    both = np.empty((3, 3))
    fuse(covariance, information, both)
    return both


@kernel
def fuse(P: Array, information: Array, both: Array) -> None:
    """both ← X with (I + P Λ) X = P, by elimination with the largest pivots; made symmetric."""
    A = np.empty((3, 6))
    for i in range(3):
        for j in range(3):
            A[i, 3 + j] = P[i, j]
            A[i, j] = 1.0 if i == j else 0.0
            for k in range(3):
                A[i, j] += P[i, k] * information[k, j]
    for i in range(3):
        best = i
        for k in range(i + 1, 3):
            best = k if abs(A[k, i]) > abs(A[best, i]) else best
        for j in range(6):
            A[i, j], A[best, j] = A[best, j], A[i, j]
        for k in range(3):
            share = A[k, i] / A[i, i]
            for j in range(i, 6):
                A[k, j] -= share * A[i, j] if k != i else 0.0
    for i in range(3):
        for j in range(3):
            both[i, j] = 0.5 * (A[i, 3 + j] / A[i, i] + A[j, 3 + i] / A[j, j])


def warm_up() -> None:
    """Compile the kernels of this module."""
    fused(np.eye(3), np.eye(3))
