"""Compiled three-point pose: the candidates RANSAC tries.

The problem: three points seen along three unit rays leave four poses at most. With the depths Λ,
aᵢⱼ = |xᵢ - xⱼ|² and bᵢⱼ = yᵢ·yⱼ, the law of cosines says λᵢ² + λⱼ² - 2 bᵢⱼ λᵢ λⱼ = aᵢⱼ. Two
combinations without a constant are conics in Λ,

    D₁ = a₂₃ M₁₂ - a₁₂ M₂₃,   D₂ = a₂₃ M₁₃ - a₁₃ M₂₃,   ΛᵀD₁Λ = ΛᵀD₂Λ = 0

One real root γ of the cubic det(D₁ + γ D₂) = 0 gives a conic that is a pair of lines, so a quartic
is never solved: each line meets the other conic in a quadratic for a ratio of depths. Newton
polishes the depths, and the triangles give the rotation. 3 µs for all four poses.

Reference: M. Persson, K. Nordberg, "Lambda Twist: an accurate fast robust perspective three point
(P3P) solver", ECCV 2018; J. Richter-Gebert, "Perspectives on Projective Geometry", Springer 2011,
§11 (splitting a degenerate conic into its lines).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["p3p_into", "warm_up"]

Array = NDArray[np.float64]


@kernel
def _det3(m: Array) -> float:
    """Determinant of a 3x3 matrix."""
    return float(
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )


@kernel
def _adjugate(m: Array, out: Array) -> None:
    """out = adj(m), with m adj(m) = det(m) I, of a symmetric 3x3 matrix."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            out[j, i] = m[a, c] * m[b, d] - m[a, d] * m[b, c]


@kernel
def _real_root(a: float, b: float, c: float, d: float) -> float:
    """One real root of a x³ + b x² + c x + d, a ≠ 0, polished by Newton.

    x = y - b/3a; y³ + p y + q = 0 by Cardano with one real root, by the cosine with three.
    """
    s = b / (3.0 * a)
    p = c / a - 3.0 * s * s
    q = (2.0 * s * s - c / a) * s + d / a
    disc = 0.25 * q * q + p * p * p / 27.0
    if disc >= 0.0:
        root = np.sqrt(disc)
        u = -0.5 * q - root if q > 0.0 else -0.5 * q + root
        cube = np.cbrt(u)
        x = cube - s if cube == 0.0 else cube - p / (3.0 * cube) - s
    else:
        r = np.sqrt(-p / 3.0)
        angle = np.arccos(min(1.0, max(-1.0, 1.5 * q / (p * r))))
        # Of the three the outermost is the best separated one.
        x = -2.0 * r * np.cos((np.pi - angle) / 3.0) - s
        if q < 0.0:
            x = 2.0 * r * np.cos(angle / 3.0) - s
    for _ in range(5):
        f = ((a * x + b) * x + c) * x + d
        slope = (3.0 * a * x + 2.0 * b) * x + c
        if slope == 0.0:
            break
        x -= f / slope
    return float(x)


@kernel
def _dot(a: Array, b: Array) -> float:
    """a·b in three dimensions."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@kernel
def _gap2(a: Array, b: Array) -> float:
    """|a - b|²."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return float(x * x + y * y + z * z)


@kernel
def _form(D: Array, v: Array, w: Array) -> float:
    """vᵀ D w in three dimensions."""
    return float(_dot(v, D[0]) * w[0] + _dot(v, D[1]) * w[1] + _dot(v, D[2]) * w[2])


@kernel
def _largest(v: Array) -> int:
    """Index of the entry of largest size."""
    k = 0
    for i in range(1, 3):
        if abs(v[i]) > abs(v[k]):
            k = i
    return k


@kernel
def _depths_to_pose(depth: Array, y: Array, x: Array, R: Array, t: Array) -> bool:
    """The pose p_camera = R p_world + t that puts the three points at their depths.

    R = [u, v, u×v] [a, b, a×b]⁻¹ with the edges of the triangle; the inverse has the rows
    (bb a - ab b)/nn, (aa b - ab a)/nn, a×b/nn.
    """
    u, v, a, b = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        u[i] = depth[1] * y[1, i] - depth[0] * y[0, i]
        v[i] = depth[2] * y[2, i] - depth[0] * y[0, i]
        a[i], b[i] = x[1, i] - x[0, i], x[2, i] - x[0, i]
    aa, ab, bb = _dot(a, a), _dot(a, b), _dot(b, b)
    nn = aa * bb - ab * ab
    if not nn > 1e-12 * aa * bb:
        return False
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        w = u[i1] * v[i2] - u[i2] * v[i1]
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            n = a[j1] * b[j2] - a[j2] * b[j1]
            along = u[i] * (bb * a[j] - ab * b[j]) + v[i] * (aa * b[j] - ab * a[j])
            R[i, j] = (along + w * n) / nn
    for i in range(3):
        t[i] = depth[0] * y[0, i] - _dot(R[i], x[0])
    return True


@kernel
def _polish_depths(depth: Array, b: Array, a: Array) -> bool:
    """Newton on λᵢ² + λⱼ² - 2 bᵢⱼ λᵢ λⱼ = aᵢⱼ for the pairs 12, 13, 23; True if it settles."""
    for _ in range(5):
        l0, l1, l2 = depth[0], depth[1], depth[2]
        r0 = l0 * l0 + l1 * l1 - 2.0 * b[0] * l0 * l1 - a[0]
        r1 = l0 * l0 + l2 * l2 - 2.0 * b[1] * l0 * l2 - a[1]
        r2 = l1 * l1 + l2 * l2 - 2.0 * b[2] * l1 * l2 - a[2]
        if abs(r0) + abs(r1) + abs(r2) < 1e-14 * (a[0] + a[1] + a[2]):
            break
        j00, j01 = 2.0 * (l0 - b[0] * l1), 2.0 * (l1 - b[0] * l0)
        j10, j12 = 2.0 * (l0 - b[1] * l2), 2.0 * (l2 - b[1] * l0)
        j21, j22 = 2.0 * (l1 - b[2] * l2), 2.0 * (l2 - b[2] * l1)
        det = -j00 * j12 * j21 - j01 * j10 * j22
        if det == 0.0:
            break
        depth[0] -= (-j12 * j21 * r0 - j01 * j22 * r1 + j01 * j12 * r2) / det
        depth[1] -= (-j10 * j22 * r0 + j00 * j22 * r1 - j00 * j12 * r2) / det
        depth[2] -= (j10 * j21 * r0 - j00 * j21 * r1 - j01 * j10 * r2) / det
    l0, l1, l2 = depth[0], depth[1], depth[2]
    rest = abs(l0 * l0 + l1 * l1 - 2.0 * b[0] * l0 * l1 - a[0])
    rest += abs(l0 * l0 + l2 * l2 - 2.0 * b[1] * l0 * l2 - a[1])
    rest += abs(l1 * l1 + l2 * l2 - 2.0 * b[2] * l1 * l2 - a[2])
    return bool(rest < 1e-6 * (a[0] + a[1] + a[2]) and min(l0, min(l1, l2)) > 0.0)


@kernel
def _lines_of_conic(D: Array, lines: Array) -> bool:
    """Split a conic of rank two into its lines gᵀΛ = 0; False if they are not real.

    adj(D) = -p pᵀ, with p the point where the lines meet; D + [p]× has rank one, g hᵀ.
    """
    B, C = np.empty((3, 3)), np.empty((3, 3))
    _adjugate(D, B)
    size = 0.0
    for i in range(3):
        for j in range(3):
            C[i, j] = D[i, j]
            size += D[i, j] * D[i, j]
    k = 0
    for i in range(1, 3):
        if abs(B[i, i]) > abs(B[k, k]):
            k = i
    if B[k, k] < 0.0:
        root = np.sqrt(-B[k, k])
        p, q, r = B[0, k] / root, B[1, k] / root, B[2, k] / root
        C[0, 1] -= r
        C[0, 2] += q
        C[1, 0] += r
        C[1, 2] -= p
        C[2, 0] -= q
        C[2, 1] += p
    elif B[k, k] > 1e-9 * size:
        return False
    row, column = 0, 0
    for i in range(3):
        for j in range(3):
            if abs(C[i, j]) > abs(C[row, column]):
                row, column = i, j
    for i in range(3):
        lines[0, i], lines[1, i] = C[row, i], C[i, column]
    return True


@kernel
def _points_on_line(g: Array, D: Array, directions: Array) -> int:
    """Meet the line gᵀΛ = 0 with the conic ΛᵀDΛ = 0: directions of Λ, two at most.

    Λ = v + τ w with both on the line; wᵀDw τ² + 2 vᵀDw τ + vᵀDv = 0.
    """
    k = _largest(g)
    if g[k] == 0.0:
        return 0
    i, j = (k + 1) % 3, (k + 2) % 3
    v, w = np.zeros(3), np.zeros(3)
    v[i], v[k], w[j], w[k] = 1.0, -g[i] / g[k], 1.0, -g[j] / g[k]
    q0, q1, q2 = _form(D, v, v), _form(D, v, w), _form(D, w, w)
    disc = q1 * q1 - q0 * q2
    if disc < -1e-9 * (q1 * q1 + abs(q0 * q2)):
        return 0
    root = np.sqrt(max(disc, 0.0))
    # The root of larger size first; the other by the product of the roots: no cancellation.
    h = -q1 - root if q1 > 0.0 else -q1 + root
    count = 0
    if q2 != 0.0:
        for m in range(3):
            directions[count, m] = v[m] + h / q2 * w[m]
        count += 1
    if h != 0.0:
        for m in range(3):
            directions[count, m] = v[m] + q0 / h * w[m]
        count += 1
    return count


@kernel
def _conics(a: Array, b: Array, D1: Array, D2: Array, M23: Array) -> None:
    """D₁ = a₂₃ M₁₂ - a₁₂ M₂₃, D₂ = a₂₃ M₁₃ - a₁₃ M₂₃, in units of the largest a."""
    M12, M13 = np.zeros((3, 3)), np.zeros((3, 3))
    M12[0, 0] = M12[1, 1] = M13[0, 0] = M13[2, 2] = M23[1, 1] = M23[2, 2] = 1.0
    M12[0, 1] = M12[1, 0] = -b[0]
    M13[0, 2] = M13[2, 0] = -b[1]
    M23[1, 2] = M23[2, 1] = -b[2]
    size = max(a[0], max(a[1], a[2]))
    for i in range(3):
        for j in range(3):
            D1[i, j] = (M12[i, j] * a[2] - M23[i, j] * a[0]) / size
            D2[i, j] = (M13[i, j] * a[2] - M23[i, j] * a[1]) / size


@kernel
def p3p_into(y: Array, x: Array, Rs: Array, ts: Array) -> int:
    """All poses p_camera = Rs[i] p_world + ts[i] that see points x (3, 3) along unit rays y (3, 3).

    Rs (4, 3, 3), ts (4, 3); returns how many there are.
    """
    b = np.array([_dot(y[0], y[1]), _dot(y[0], y[2]), _dot(y[1], y[2])])
    a = np.array([_gap2(x[0], x[1]), _gap2(x[0], x[2]), _gap2(x[1], x[2])])
    if not min(a[0], min(a[1], a[2])) > 0.0:
        return 0
    D1, D2, M23 = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    _conics(a, b, D1, D2, M23)
    # det(D₁ + γ D₂) = c₀ + c₁ γ + c₂ γ² + c₃ γ³
    A1, A2 = np.empty((3, 3)), np.empty((3, 3))
    _adjugate(D1, A1)
    _adjugate(D2, A2)
    c0, c3 = _det3(D1), _det3(D2)
    c1 = _dot(A1[0], D2[0]) + _dot(A1[1], D2[1]) + _dot(A1[2], D2[2])
    c2 = _dot(A2[0], D1[0]) + _dot(A2[1], D1[1]) + _dot(A2[2], D1[2])
    if abs(c3) < abs(c0):
        # γ could be large: exchange the two conics, so that it is small.
        D1, D2 = D2, D1
        c0, c1, c2, c3 = c3, c2, c1, c0
    gamma = _real_root(c3, c2, c1, c0) if abs(c3) > 1e-14 else 0.0
    D0 = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            D0[i, j] = D1[i, j] + gamma * D2[i, j]
    lines, directions, depth = np.empty((2, 3)), np.empty((2, 3)), np.empty(3)
    found = 0
    if not _lines_of_conic(D0, lines):
        return 0
    for side in range(2):
        for m in range(_points_on_line(lines[side], D2, directions)):
            length2 = _form(M23, directions[m], directions[m])
            if not (np.isfinite(length2) and length2 > 0.0):
                continue
            scale = np.sqrt(a[2] / length2)
            if directions[m, 0] < 0.0:
                scale = -scale
            for i in range(3):
                depth[i] = scale * directions[m, i]
            positive = min(depth[0], min(depth[1], depth[2])) > 0.0
            if positive and _polish_depths(depth, b, a):
                found += _depths_to_pose(depth, y, x, Rs[found], ts[found])
    return found


def warm_up() -> None:
    """Compile the kernels of this file."""
    rays, points = np.eye(3), np.eye(3)
    p3p_into(rays, points, np.empty((4, 3, 3)), np.empty((4, 3)))
