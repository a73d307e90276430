"""Conjugate gradients on the reduced system of bundle adjustment, without ever making it.

With thousands of views the factor of S fills up. S x, however, is two passes over the slabs V,

    S x = (A + λ diag A) x - V (Vᵀ x),

and conjugate gradients, preconditioned by the inverse of the diagonal blocks of S, need some tens
of them: a step of Levenberg-Marquardt gains nothing from the last digits of its linear system.
They stop when a step adds little to what the quadratic Q has fallen already (Nash, Sofer),

    k (Q_k - Q_{k-1}) / Q_k < η.

Cost: 12 d flops per incidence and iteration; memory: that of V.

Reference: S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle adjustment in the large",
ECCV 2010, sections 4 and 5.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.layout import Blocks, Incidences
from odomap.backend.adjustment.normal import System
from odomap.kernels import kernel

__all__ = ["Conjugate", "conjugate_steps", "precondition", "start_conjugate"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Conjugate(NamedTuple):
    """State of the iteration, all (n,): solution x, residual r, direction p, z and S p.

    scalars: r·z, Q, and how many steps were taken.
    """

    x: Array
    r: Array
    p: Array
    z: Array
    Sp: Array
    scalars: Array


@kernel(reorder=True)
def _multiply(
    blocks: Blocks,
    incidences: Incidences,
    D: Array,
    lens: Index,
    coupling: Array,
    V: Array,
    x: Array,
    y: Array,
) -> None:
    """y = D x + (couplings) x - V (Vᵀ x)."""
    pose, lens_block, _, sizes, rows, block_at, _ = blocks
    start, touched, _, slab_at, _, _ = incidences
    for b in range(len(sizes)):
        size, at, row = sizes[b], block_at[b], rows[b]
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += D[at + i * size + j] * x[row + j]
            y[row + i] = total
    for i in range(len(coupling)):
        b, e = pose[i], lens_block[lens[i]]
        if b >= 0 and e >= 0:
            for j in range(6):
                for k in range(sizes[e]):
                    y[rows[b] + j] += coupling[i, j, k] * x[rows[e] + k]
                    y[rows[e] + k] += coupling[i, j, k] * x[rows[b] + j]
    for m in range(len(start) - 1):
        z0, z1, z2 = 0.0, 0.0, 0.0
        for e in range(start[m], start[m + 1]):
            at, size, row = slab_at[e], sizes[touched[e]], rows[touched[e]]
            for i in range(size):
                z0 += V[at + i] * x[row + i]
                z1 += V[at + size + i] * x[row + i]
                z2 += V[at + 2 * size + i] * x[row + i]
        for e in range(start[m], start[m + 1]):
            at, size, row = slab_at[e], sizes[touched[e]], rows[touched[e]]
            for i in range(size):
                y[row + i] -= V[at + i] * z0 + V[at + size + i] * z1 + V[at + 2 * size + i] * z2


@kernel(reorder=True)
def precondition(
    blocks: Blocks, incidences: Incidences, D: Array, system: System, M: Array, s: Array
) -> bool:
    """Write the Cholesky factors of the diagonal blocks of S into M, and s = a - V y.

    False if one is not positive definite.
    """
    _, _, _, sizes, rows, block_at, _ = blocks
    _, touched, point, slab_at, _, _ = incidences
    _, _, _, a, V, _, y, _, _ = system
    for i in range(len(D)):
        M[i] = D[i]
    for i in range(len(s)):
        s[i] = a[i]
    for e in range(len(touched)):
        b, at, m = touched[e], slab_at[e], point[e]
        size, row, to = sizes[b], rows[b], block_at[b]
        y0, y1, y2 = y[m, 0], y[m, 1], y[m, 2]
        for i in range(size):
            v0, v1, v2 = V[at + i], V[at + size + i], V[at + 2 * size + i]
            s[row + i] -= v0 * y0 + v1 * y1 + v2 * y2
            for j in range(i + 1):
                M[to + i * size + j] -= (
                    v0 * V[at + j] + v1 * V[at + size + j] + v2 * V[at + 2 * size + j]
                )
    is_definite = True
    for b in range(len(sizes)):
        is_definite = is_definite and _factor_block(D, M, block_at[b], sizes[b])
    return is_definite


@kernel(reorder=True)
def _factor_block(D: Array, M: Array, at: int, size: int) -> bool:
    """M = L Lᵀ in place, the diagonal inverted, which is what solving needs; D holds what M was."""
    for j in range(size):
        pivot = M[at + j * size + j]
        for k in range(j):
            pivot -= M[at + j * size + k] * M[at + j * size + k]
        if not pivot > 1e-14 * D[at + j * size + j]:
            return False
        inverse = 1.0 / np.sqrt(pivot)
        M[at + j * size + j] = inverse
        for i in range(j + 1, size):
            total = M[at + i * size + j]
            for k in range(j):
                total -= M[at + i * size + k] * M[at + j * size + k]
            M[at + i * size + j] = total * inverse
    return True


@kernel
def _apply_inverse(blocks: Blocks, M: Array, r: Array, z: Array) -> float:
    """z = M⁻¹ r, block by block; returns r·z."""
    product = 0.0
    sizes, rows, block_at = blocks.size, blocks.row, blocks.at
    for b in range(len(sizes)):
        size, at, row = sizes[b], block_at[b], rows[b]
        for i in range(size):
            total = r[row + i]
            for j in range(i):
                total -= M[at + i * size + j] * z[row + j]
            z[row + i] = total * M[at + i * size + i]
        for i in range(size - 1, -1, -1):
            z[row + i] *= M[at + i * size + i]
            for j in range(i):
                z[row + j] -= M[at + i * size + j] * z[row + i]
        for i in range(size):
            product += r[row + i] * z[row + i]
    return product


@kernel
def start_conjugate(blocks: Blocks, M: Array, s: Array, state: Conjugate) -> None:
    """x = 0 of S x = -s."""
    x, r, p, z, _, scalars = state
    for i in range(len(s)):
        x[i], r[i] = 0.0, -s[i]
    scalars[0] = _apply_inverse(blocks, M, r, z)
    scalars[1], scalars[2] = 0.0, 0.0
    for i in range(len(s)):
        p[i] = z[i]


@kernel
def conjugate_steps(
    blocks: Blocks,
    incidences: Incidences,
    D: Array,
    lens: Index,
    coupling: Array,
    V: Array,
    M: Array,
    s: Array,
    steps: int,
    eta: float,
    state: Conjugate,
) -> bool:
    """Take some steps; True when the solution is good enough, or no step makes it better."""
    x, r, p, z, Sp, scalars = state
    for _ in range(steps):
        rz = scalars[0]
        if not rz > 0.0:
            return True
        _multiply(blocks, incidences, D, lens, coupling, V, p, Sp)
        curvature = 0.0
        for i in range(len(p)):
            curvature += p[i] * Sp[i]
        if not curvature > 0.0:
            return True
        alpha = rz / curvature
        Q = 0.0
        for i in range(len(p)):
            x[i] += alpha * p[i]
            r[i] -= alpha * Sp[i]
            # Q = ½ xᵀ S x + sᵀ x, where S x = -s - r.
            Q += 0.5 * x[i] * (s[i] - r[i])
        scalars[2] += 1.0
        gain = scalars[2] * (Q - scalars[1])
        scalars[1] = Q
        if gain >= eta * Q:
            return True
        scalars[0] = _apply_inverse(blocks, M, r, z)
        beta = scalars[0] / rz
        for i in range(len(p)):
            p[i] = z[i] + beta * p[i]
    return False
