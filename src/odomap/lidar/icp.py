"""ICP: pairs of nearest points, and the motion that brings pairs together, in turns.

The problem: were it known which point of the source is which of the target, the motion would follow
in closed form; were the motion known, the nearest point would be the one. So each is found with the
other held, until nothing moves. What "together" means makes the method, with e = q - (R p + t):

    point to point    Σ w |e|²         closed form: R from Σ w (p - p̄)(q - q̄)ᵀ, t = q̄ - R p̄
    point to plane    Σ w (nᵀ e)²      Gauss-Newton: points may slide along the target's surface

Normals of any length weigh what they stand for: n is the shorter the less it is sure (`gicp`).
A step turns about the target's axes, T ← (Exp φ R, t + ρ) to first order e ← e - ρ - φ × x with
x = R p, so that with J = [I  -x^] and any metric M

    H = Σ w Jᵀ M J,   g = Σ w Jᵀ M e,   ξ = (ρ, φ) = H⁻¹ g

The closed form is Horn's quaternion, which is the rotation of the singular value decomposition with
its sign put right. Sums are of 32 numbers, so that parts can be made side by side.

Reference: P. J. Besl, N. D. McKay, "A method for registration of 3-D shapes", T-PAMI 14(2), 1992;
Y. Chen, G. Medioni, "Object modelling by registration of multiple range images", IVC 10(3), 1992.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.horn_kernels import horn_rotation
from odomap.geometry.lie_kernels import so3_exp_into, so3_orthonormalize_into
from odomap.geometry.pnp_kernels import cholesky_solve
from odomap.kernels import kernel

__all__ = [
    "COST",
    "COUNT",
    "SLOTS",
    "add_metric",
    "add_pair",
    "add_plane",
    "newton_step",
    "pair_step",
    "warm_up",
]

Array = NDArray[np.float64]

SLOTS = 32
"""Numbers in a sum: 21 of H above its diagonal row by row, 6 of g; or the moments of pairs."""
COST = 27
"""Where in a sum the weighted squares are."""
COUNT = 28
"""Where the number of pairs is."""
_DAMPING = 1e-9
"""Of the mean of the diagonal: what keeps a step small where nothing is known."""


@kernel
def add_pair(p: Array, q: Array, i: int, j: int, w: float, out: Array) -> None:
    """Σ w p qᵀ (0-8), Σ w p (9-11), Σ w q (12-14), Σ w (15), Σ w |p|², Σ w |q|² of pairs."""
    for a in range(3):
        for b in range(3):
            out[3 * a + b] += w * p[i, a] * q[j, b]
        out[9 + a] += w * p[i, a]
        out[12 + a] += w * q[j, a]
        out[16] += w * p[i, a] * p[i, a]
        out[17] += w * q[j, a] * q[j, a]
    out[15] += w


@kernel
def add_plane(
    x: float, y: float, z: float, a: float, b: float, c: float, r: float, w: float, out: Array
) -> None:
    """H += w a aᵀ, g += w r a with a = (n, x × n), n = (a, b, c) and r = nᵀ e."""
    d, e, f = y * c - z * b, z * a - x * c, x * b - y * a
    wa, wb, wc, wd, we, wf = w * a, w * b, w * c, w * d, w * e, w * f
    out[0] += wa * a
    out[1] += wa * b
    out[2] += wa * c
    out[3] += wa * d
    out[4] += wa * e
    out[5] += wa * f
    out[6] += wb * b
    out[7] += wb * c
    out[8] += wb * d
    out[9] += wb * e
    out[10] += wb * f
    out[11] += wc * c
    out[12] += wc * d
    out[13] += wc * e
    out[14] += wc * f
    out[15] += wd * d
    out[16] += wd * e
    out[17] += wd * f
    out[18] += we * e
    out[19] += we * f
    out[20] += wf * f
    out[21] += wa * r
    out[22] += wb * r
    out[23] += wc * r
    out[24] += wd * r
    out[25] += we * r
    out[26] += wf * r


@kernel
def add_metric(
    x: float, y: float, z: float, m00: float, m01: float, m02: float, m11: float, m12: float,
    m22: float, g0: float, g1: float, g2: float, out: Array,
) -> None:  # fmt: skip
    """H += Jᵀ M J, g += Jᵀ M e with g0, g1, g2 = M e; x^ M below is J_φᵀ M."""
    b00, b01, b02 = y * m02 - z * m01, y * m12 - z * m11, y * m22 - z * m12
    b10, b11, b12 = z * m00 - x * m02, z * m01 - x * m12, z * m02 - x * m22
    b20, b21, b22 = x * m01 - y * m00, x * m11 - y * m01, x * m12 - y * m02
    out[0] += m00
    out[1] += m01
    out[2] += m02
    out[3] += b00
    out[4] += b10
    out[5] += b20
    out[6] += m11
    out[7] += m12
    out[8] += b01
    out[9] += b11
    out[10] += b21
    out[11] += m22
    out[12] += b02
    out[13] += b12
    out[14] += b22
    out[15] += y * b02 - z * b01
    out[16] += z * b00 - x * b02
    out[17] += x * b01 - y * b00
    out[18] += z * b10 - x * b12
    out[19] += x * b11 - y * b10
    out[20] += x * b21 - y * b20
    out[21] += g0
    out[22] += g1
    out[23] += g2
    out[24] += y * g2 - z * g1
    out[25] += z * g0 - x * g2
    out[26] += x * g1 - y * g0


@kernel
def newton_step(total: Array, planar: bool, R: Array, t: Array, H: Array, xi: Array) -> bool:
    """ξ = H⁻¹ g; R ← Exp(φ) R, t ← t + ρ. In the plane x, y, θ alone. H is (6, 6) to work in."""
    at = 0
    for i in range(6):
        for j in range(i, 6):
            H[i, j] = H[j, i] = total[at]
            at += 1
        xi[i] = total[21 + i]
    shift = (H[0, 0] + H[1, 1] + H[2, 2]) / 3.0
    turn = (H[3, 3] + H[4, 4] + H[5, 5]) / 3.0
    for i in range(6):
        if planar and i in (2, 3, 4):
            for j in range(6):
                H[i, j] = H[j, i] = 0.0
            H[i, i], xi[i] = 1.0, 0.0
        else:
            H[i, i] += _DAMPING * (shift if i < 3 else turn)
    if not cholesky_solve(H, xi, xi):
        return False
    turned, product = np.empty((3, 3)), np.empty((3, 3))
    so3_exp_into(xi[3:], turned)
    for i in range(3):
        for j in range(3):
            product[i, j] = turned[i, 0] * R[0, j] + turned[i, 1] * R[1, j] + turned[i, 2] * R[2, j]
        t[i] += xi[i]
    so3_orthonormalize_into(product, R)
    return True


@kernel
def pair_step(total: Array, planar: bool, R: Array, t: Array, xi: Array) -> bool:
    """R, t that minimise Σ w |q - R p - t|²; ξ = how far that is from where they were."""
    w = total[15]
    if not w > 0.0:
        return False
    N, V, old = np.empty((4, 4)), np.empty((4, 4)), R.copy()
    xx, xy = total[0] - total[9] * total[12] / w, total[1] - total[9] * total[13] / w
    xz = total[2] - total[9] * total[14] / w
    yx, yy = total[3] - total[10] * total[12] / w, total[4] - total[10] * total[13] / w
    yz = total[5] - total[10] * total[14] / w
    zx, zy = total[6] - total[11] * total[12] / w, total[7] - total[11] * total[13] / w
    zz = total[8] - total[11] * total[14] / w
    if planar:
        size = np.sqrt((xx + yy) * (xx + yy) + (xy - yx) * (xy - yx))
        if size > 0.0:
            c, s = (xx + yy) / size, (xy - yx) / size
            R[0, 0], R[0, 1], R[1, 0], R[1, 1] = c, -s, s, c
    else:
        N[0, 0], N[1, 1], N[2, 2] = xx + yy + zz, xx - yy - zz, yy - xx - zz
        N[3, 3] = zz - xx - yy
        N[0, 1], N[0, 2], N[0, 3] = yz - zy, zx - xz, xy - yx
        N[1, 2], N[1, 3], N[2, 3] = xy + yx, zx + xz, yz + zy
        horn_rotation(N, V, np.sqrt(total[16] * total[17]), R)
    for i in range(3):
        before = t[i]
        t[i] = total[12 + i] / w
        for j in range(3):
            t[i] -= R[i, j] * total[9 + j] / w
        xi[i] = t[i] - before
    angle = 0.0
    for i in range(3):
        for j in range(3):
            d = R[i, j] - old[i, j]
            angle += d * d
    xi[3], xi[4], xi[5] = np.sqrt(0.5 * angle), 0.0, 0.0
    return True


def warm_up() -> None:
    """Compile the kernels of this file."""
    total, p, R, t = np.zeros(SLOTS), np.eye(3), np.eye(3), np.zeros(3)
    for i in range(3):
        add_plane(p[i, 0], p[i, 1], p[i, 2], p[0, i], p[1, i], p[2, i], 0.0, 1.0, total)
        add_metric(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, total)
    newton_step(total, False, R, t, np.empty((6, 6)), np.empty(6))
    add_pair(p, p, 0, 0, 1.0, total)
    pair_step(total, False, R, t, np.empty(6))
