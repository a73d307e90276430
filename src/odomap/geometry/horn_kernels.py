"""Compiled absolute orientation: the motion that brings a few points onto others.

For centred points p, q with M = Σ p qᵀ the best rotation, as a unit quaternion, is the eigenvector
of the largest eigenvalue of the symmetric

    N = [[tr M, δᵀ], [δ, M + Mᵀ - tr(M) I]],    δ = (M_yz - M_zy, M_zx - M_xz, M_xy - M_yx),

found by Jacobi's rotations; then t = q̄ - s R p̄. A quaternion is never a mirror; where points lie on
a line two eigenvalues are the same. O(N), no allocation.

Reference: B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions",
JOSA A 4(4), 1987.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["horn_into", "horn_rotation", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel
def _jacobi(A: Array, V: Array) -> None:
    """Diagonalise a symmetric 4x4 A in place, A ← Vᵀ A V, by rotations of pairs of axes."""
    for i in range(4):
        for j in range(4):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, size = 0.0, 0.0
        for i in range(4):
            size += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if off <= 1e-30 * size:
            return
        for p in range(3):
            for q in range(p + 1, 4):
                if A[p, q] == 0.0:
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                t = t if theta >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):
                    a, b = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = A[p, k], A[q, k]
                    A[p, k], A[q, k] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * a - s * b, s * a + c * b


@kernel
def horn_rotation(N: Array, V: Array, size: float, R: Array) -> bool:
    """R of the eigenvector of the largest eigenvalue of N, given above its diagonal; destroys N.

    False, and R as it was, if the two largest are the same to 1e-6 of `size`.
    """
    for i in range(4):
        for j in range(i):
            N[i, j] = N[j, i]
    _jacobi(N, V)
    best = 0
    for i in range(1, 4):
        if N[i, i] > N[best, best]:
            best = i
    second = -np.inf
    for i in range(4):
        if i != best:
            second = max(second, N[i, i])
    if not N[best, best] - second > 1e-6 * size:
        return False
    o, x, y, z = V[0, best], V[1, best], V[2, best], V[3, best]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - o * z), 2 * (x * z + o * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + o * z), 1 - 2 * (x * x + z * z), 2 * (y * z - o * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - o * y), 2 * (y * z + o * x), 1 - 2 * (x * x + y * y)
    return True


@kernel
def horn_into(
    p: Array, q: Array, rows: Index, with_scale: bool, R: Array, t: Array, A: Array, V: Array
) -> float:
    """Least squares q ≈ s R p + t over some rows; returns s, 0 where points lie on a line.

    s = √(Σ |q - q̄|² / Σ |p - p̄|²), the same from both sides. A and V are (4, 4) to work in.
    """
    n = len(rows)
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        i = rows[k]
        a, b, c = a + p[i, 0], b + p[i, 1], c + p[i, 2]
        d, e, f = d + q[i, 0], e + q[i, 1], f + q[i, 2]
    a, b, c, d, e, f = a / n, b / n, c / n, d / n, e / n, f / n
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    pp, qq = 0.0, 0.0
    for k in range(n):
        i = rows[k]
        x, y, z = p[i, 0] - a, p[i, 1] - b, p[i, 2] - c
        u, v, w = q[i, 0] - d, q[i, 1] - e, q[i, 2] - f
        xx, xy, xz = xx + x * u, xy + x * v, xz + x * w
        yx, yy, yz = yx + y * u, yy + y * v, yz + y * w
        zx, zy, zz = zx + z * u, zy + z * v, zz + z * w
        pp += x * x + y * y + z * z
        qq += u * u + v * v + w * w
    A[0, 0], A[1, 1], A[2, 2], A[3, 3] = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    A[0, 1], A[0, 2], A[0, 3] = yz - zy, zx - xz, xy - yx
    A[1, 2], A[1, 3], A[2, 3] = xy + yx, zx + xz, yz + zy
    # On a line every turn about it is as good: two eigenvalues are the same.
    if not pp > 0.0 or not horn_rotation(A, V, np.sqrt(pp * qq), R):
        return 0.0
    s = np.sqrt(qq / pp) if with_scale else 1.0
    t[0] = d - s * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c)
    t[1] = e - s * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c)
    t[2] = f - s * (R[2, 0] * a + R[2, 1] * b + R[2, 2] * c)
    return float(s)


def warm_up() -> None:
    """Compile the kernels of this file."""
    p, R, t = np.eye(3), np.empty((3, 3)), np.empty(3)
    horn_into(p, p, np.arange(3), True, R, t, np.empty((4, 4)), np.empty((4, 4)))
    horn_rotation(np.eye(4), np.empty((4, 4)), 1.0, R)
