"""The rotations nearest to matrices.

A linear estimate of a rotation is a matrix M that is none. The rotation nearest to it in the sum of
squares of entries maximises tr(Rᵀ M). In the plane that is the direction (M₀₀ + M₁₁, M₁₀ − M₀₁). In
space, with R written by a unit quaternion q = (w, v), it is a quadratic form,

    tr(R(q)ᵀ M) = qᵀ K q,   K = | tr M         zᵀ         |     z = Σ_k (column k of R=I) × M_k
                                | z     M + Mᵀ − (tr M) I |

so q is the eigenvector of the largest eigenvalue of K, a symmetric 4×4 matrix which a few sweeps of
Jacobi's rotations make diagonal. A quaternion is always a proper rotation, so that mirrored, flat
and even zero matrices need no case of their own (zero gives the identity), where the singular value
decomposition needs the sign of a determinant. About 2 µs each, without the interpreter's lock.

Reference: B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions",
Journal of the Optical Society of America A 4(4), 1987.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["nearest_rotations", "nearest_rotations_into", "warm_up"]

Array = NDArray[np.float64]


def nearest_rotations(matrices: Array) -> Array:
    """Return the rotations nearest to matrices.

    Args:
        matrices: (N, d, d), d = 2 or 3, finite.

    Returns:
        (N, d, d) rotations; the identity for a matrix of zeros.

    Example:
        >>> nearest_rotations(np.array([[[0.0, -2.0], [2.0, 0.0]]])).tolist()
        [[[0.0, -1.0], [1.0, 0.0]]]
    """
    out = np.empty(matrices.shape)
    nearest_rotations_into(np.ascontiguousarray(matrices), out)
    return out


@kernel
def nearest_rotations_into(matrices: Array, out: Array) -> None:
    """out = argmax over rotations of tr(Rᵀ M), for each M; out may be the input."""
    K, V = np.empty((4, 4)), np.empty((4, 4))
    for n in range(len(matrices)):
        if matrices.shape[1] == 2:
            c = matrices[n, 0, 0] + matrices[n, 1, 1]
            s = matrices[n, 1, 0] - matrices[n, 0, 1]
            length = np.hypot(c, s)
            if length > 0.0:
                c, s = c / length, s / length
            else:
                c, s = 1.0, 0.0
            out[n, 0, 0], out[n, 0, 1], out[n, 1, 0], out[n, 1, 1] = c, -s, s, c
        else:
            _quadratic_form(matrices[n], K)
            _diagonalize(K, V)
            best = 0
            for k in range(1, 4):
                if K[k, k] > K[best, best]:
                    best = k
            _rotation_of(V[0, best], V[1, best], V[2, best], V[3, best], out[n])


@kernel
def _quadratic_form(M: Array, K: Array) -> None:
    """K with qᵀ K q = tr(R(q)ᵀ M), M scaled to entries of at most 1."""
    largest = 0.0
    for a in range(3):
        for b in range(3):
            largest = max(largest, abs(M[a, b]))
    scale = 1.0 / largest if largest > 1e-300 else 0.0
    trace = M[0, 0] + M[1, 1] + M[2, 2]
    K[0, 0] = scale * trace
    K[0, 1] = scale * (M[2, 1] - M[1, 2])
    K[0, 2] = scale * (M[0, 2] - M[2, 0])
    K[0, 3] = scale * (M[1, 0] - M[0, 1])
    for a in range(3):
        K[a + 1, 0] = K[0, a + 1]
        for b in range(3):
            K[a + 1, b + 1] = scale * (M[a, b] + M[b, a])
        K[a + 1, a + 1] -= scale * trace


@kernel
def _diagonalize(A: Array, V: Array) -> None:
    """A ← Vᵀ A V diagonal by cyclic Jacobi rotations, each of which zeroes A_pq and A_qp."""
    n = len(A)
    for p in range(n):
        for q in range(n):
            V[p, q] = 1.0 if p == q else 0.0
    for _ in range(12):  # quadratic convergence: six do
        off = 0.0
        for p in range(n):
            for q in range(p + 1, n):
                off += A[p, q] * A[p, q]
        if off < 1e-32:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if A[p, q] == 0.0:
                    continue
                h = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = 1.0 / (abs(h) + np.sqrt(h * h + 1.0))
                if h < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    x, y = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * x - s * y, s * x + c * y
                    x, y = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * x - s * y, s * x + c * y
                for k in range(n):
                    x, y = A[p, k], A[q, k]
                    A[p, k], A[q, k] = c * x - s * y, s * x + c * y


@kernel
def _rotation_of(w: float, x: float, y: float, z: float, R: Array) -> None:
    """R = (w² − v·v) I + 2 v vᵀ + 2 w v^ of a quaternion, normalised."""
    f = 2.0 / (w * w + x * x + y * y + z * z)
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - f * (y * y + z * z), f * (x * y - w * z), f * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = f * (x * y + w * z), 1.0 - f * (x * x + z * z), f * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = f * (x * z - w * y), f * (y * z + w * x), 1.0 - f * (x * x + y * y)


def warm_up() -> None:
    """Compile the kernels of this module."""
    nearest_rotations(np.eye(3)[None])
