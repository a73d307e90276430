"""The point of two sightings: where it is, whether it is one, and who else sees it.

A sighting i of a view is x/z, y/z, the inverse depth d (NaN where not measured) and the size s of
its pyramid level; its residuals in standard deviations are

    r = ((X/Z − x)/(s σ), (Y/Z − y)/(s σ), (1/Z − d)/σ_d),   (X, Y, Z) = R_k p + t_k,

with all points in the axes of the newest camera, to which R_k, t_k lead from view k. The noise is
(4,): σ on the plane z = 1, σ_d, the least parallax in rad, and by which factor sizes in the image
may contradict distances. What it is for is told in `creating`.

Reference: R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., Cambridge
University Press 2004, chapter 12.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["agree", "judge", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

GATE, GATE_WITH_DEPTH = 5.991, 7.815
"""95 % of χ² with two and three degrees of freedom."""

STEPS = 2
"""Gauss-Newton steps of a point; the bundle adjustment takes more."""


@kernel
def _add_view(
    p: Array, R: Array, t: Array, k: int, seen: Array, i: int, noise: Array, H: Array, g: Array
) -> float:
    """Add JᵀJ to H (00 01 02 11 12 22) and Jᵀr to g, and return |r|² of view k, ∞ behind it.

    r = ((X/Z − x)/σ, (Y/Z − y)/σ, (1/Z − d)/σ_d), (X, Y, Z) = R_k p + t_k; no third without d.
    """
    X = R[k, 0, 0] * p[0] + R[k, 0, 1] * p[1] + R[k, 0, 2] * p[2] + t[k, 0]
    Y = R[k, 1, 0] * p[0] + R[k, 1, 1] * p[1] + R[k, 1, 2] * p[2] + t[k, 1]
    Z = R[k, 2, 0] * p[0] + R[k, 2, 1] * p[1] + R[k, 2, 2] * p[2] + t[k, 2]
    if not Z > 1e-6:
        return np.inf
    chi2, inverse = 0.0, 1.0 / Z
    w = 1.0 / (noise[0] * seen[i, 3])
    for axis in range(3):
        value = X * inverse if axis == 0 else (Y * inverse if axis == 1 else inverse)
        if axis == 2 and not np.isfinite(seen[i, 2]):
            break
        if axis == 2:
            w, own = 1.0 / noise[1], 0.0  # d(1/Z) = −(1/Z)² dZ
        else:
            own = 1.0
        r = w * (value - seen[i, axis])
        j0 = w * inverse * (own * R[k, axis, 0] - value * R[k, 2, 0])
        j1 = w * inverse * (own * R[k, axis, 1] - value * R[k, 2, 1])
        j2 = w * inverse * (own * R[k, axis, 2] - value * R[k, 2, 2])
        H[0] += j0 * j0
        H[1] += j0 * j1
        H[2] += j0 * j2
        H[3] += j1 * j1
        H[4] += j1 * j2
        H[5] += j2 * j2
        g[0] += j0 * r
        g[1] += j1 * r
        g[2] += j2 * r
        chi2 += r * r
    return chi2


@kernel
def _step(H: Array, g: Array, p: Array) -> bool:
    """Move p by −H⁻¹ g, by cofactors; false where H is singular."""
    c00 = H[3] * H[5] - H[4] * H[4]
    c01 = H[2] * H[4] - H[1] * H[5]
    c02 = H[1] * H[4] - H[2] * H[3]
    det = H[0] * c00 + H[1] * c01 + H[2] * c02
    if not det > 0.0:
        return False
    c11 = H[0] * H[5] - H[2] * H[2]
    c12 = H[1] * H[2] - H[0] * H[4]
    c22 = H[0] * H[3] - H[1] * H[1]
    p[0] -= (c00 * g[0] + c01 * g[1] + c02 * g[2]) / det
    p[1] -= (c01 * g[0] + c11 * g[1] + c12 * g[2]) / det
    p[2] -= (c02 * g[0] + c12 * g[1] + c22 * g[2]) / det
    return True


@kernel
def _start(
    first: Array, second: Array, i: int, R: Array, t: Array, k: int, noise: Array, p: Array
) -> float:
    """Write a first guess of the point into p, and return what tells its depth, rad.

    p is nearest to both rays, λa and c + μb, or, where a depth measured in one of the views is
    worth a wider angle, w = σ d/σ_d, than α between the rays, at that depth. Returns
    √(α² + Σ w²). Where the rays meet behind a camera p is put behind the first one.
    """
    ax, ay = first[i, 0], first[i, 1]
    x, y = second[i, 0], second[i, 1]
    bx = R[k, 0, 0] * x + R[k, 1, 0] * y + R[k, 2, 0]
    by = R[k, 0, 1] * x + R[k, 1, 1] * y + R[k, 2, 1]
    bz = R[k, 0, 2] * x + R[k, 1, 2] * y + R[k, 2, 2]
    cx = -(R[k, 0, 0] * t[k, 0] + R[k, 1, 0] * t[k, 1] + R[k, 2, 0] * t[k, 2])
    cy = -(R[k, 0, 1] * t[k, 0] + R[k, 1, 1] * t[k, 1] + R[k, 2, 1] * t[k, 2])
    cz = -(R[k, 0, 2] * t[k, 0] + R[k, 1, 2] * t[k, 1] + R[k, 2, 2] * t[k, 2])
    ab = ax * bx + ay * by + bz
    ac = ax * cx + ay * cy + cz
    bc = bx * cx + by * cy + bz * cz
    aa, bb = ax * ax + ay * ay + 1.0, bx * bx + by * by + bz * bz
    square = (ay * bz - by) ** 2 + (bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    angle = np.arctan2(np.sqrt(square), ab)
    worth = noise[0] * first[i, 3] * first[i, 2] / noise[1]
    worth = worth if worth > 0.0 else 0.0
    other = noise[0] * second[i, 3] * second[i, 2] / noise[1]
    other = other if other > 0.0 else 0.0
    p[0], p[1], p[2] = 0.0, 0.0, -1.0
    if worth > angle and worth >= other:
        z = 1.0 / first[i, 2]
        p[0], p[1], p[2] = z * ax, z * ay, z
    elif other > angle:
        z = 1.0 / second[i, 2]
        p[0], p[1], p[2] = cx + z * bx, cy + z * by, cz + z * bz
    elif square > 0.0:
        along, beyond = (bb * ac - ab * bc) / square, (ab * ac - aa * bc) / square
        if along > 0.0 and beyond > 0.0:
            p[0] = 0.5 * (along * ax + cx + beyond * bx)
            p[1] = 0.5 * (along * ay + cy + beyond * by)
            p[2] = 0.5 * (along + cz + beyond * bz)
    return float(np.sqrt(angle * angle + worth * worth + other * other))


@kernel
def _is_noise(chi2: float, seen: Array, i: int) -> bool:
    """|r|² within what 95 of 100 true sightings have."""
    return chi2 <= (GATE_WITH_DEPTH if np.isfinite(seen[i, 2]) else GATE)


@kernel
def _sizes_agree(
    p: Array, R: Array, t: Array, k: int, first: Array, second: Array, i: int, noise: Array
) -> bool:
    """Whether |p| / |R p + t| is the levels' s₂ / s₁, within the tolerance: far is small."""
    near, far = 0.0, 0.0
    for m in range(3):
        q = R[k, m, 0] * p[0] + R[k, m, 1] * p[1] + R[k, m, 2] * p[2] + t[k, m]
        near += p[m] * p[m]
        far += q * q
    factor = np.sqrt(near / far) * first[i, 3] / second[i, 3]
    return bool(factor <= noise[3] and factor * noise[3] >= 1.0)


@kernel
def judge(
    first: Array,
    second: Array,
    view: Index,
    R: Array,
    t: Array,
    noise: Array,
    newest: int,
    points: Array,
    parallax: Array,
    verdict: Index,
) -> None:
    """For each pair p = argmin Σ |r|² by Gauss-Newton, and the first check it fails (or 0)."""
    H, g = np.empty(6), np.empty(3)
    for i in range(len(first)):
        p, k = points[i], view[i]
        parallax[i] = _start(first, second, i, R, t, k, noise, p)
        if not parallax[i] >= noise[2]:
            verdict[i] = 1
            continue
        a, b = np.inf, np.inf
        for iteration in range(STEPS + 1):
            H[:] = 0.0
            g[:] = 0.0
            a = _add_view(p, R, t, newest, first, i, noise, H, g)
            b = _add_view(p, R, t, k, second, i, noise, H, g)
            if not np.isfinite(a + b) or iteration == STEPS or not _step(H, g, p):
                break
        if not np.isfinite(a + b):
            verdict[i] = 2
        elif not (_is_noise(a, first, i) and _is_noise(b, second, i)):
            verdict[i] = 3
        elif not _sizes_agree(p, R, t, k, first, second, i, noise):
            verdict[i] = 4


@kernel
def agree(
    first: Array,
    second: Array,
    view: Index,
    R: Array,
    t: Array,
    noise: Array,
    keypoint: Index,
    points: Array,
    parallax: Array,
    verdict: Index,
    winner: Index,
) -> None:
    """Among pairs of one keypoint, winner = the point that most of them see, by parallax in ties.

    Pairs come sorted by keypoint; winner[j] is written for those that see the point, j included.
    """
    H, g = np.empty(6), np.empty(3)
    begin = 0
    while begin < len(keypoint):
        end = begin + 1
        while end < len(keypoint) and keypoint[end] == keypoint[begin]:
            end += 1
        best, most = -1, 0
        # The last round, i = end, marks those that see the best one.
        for i in range(begin, end + 1):
            chosen = best if i == end else i
            if chosen < 0 or verdict[chosen] != 0:
                continue
            p, votes = points[chosen], 0
            for j in range(begin, end):
                chi2 = _add_view(p, R, t, view[j], second, j, noise, H, g)
                if _is_noise(chi2, second, j) and _sizes_agree(
                    p, R, t, view[j], first, second, j, noise
                ):
                    votes += 1
                    if i == end:
                        winner[j] = chosen
            if votes > most or (votes == most and parallax[chosen] > parallax[best]):
                best, most = i, votes
        begin = end


def warm_up() -> None:
    """Compile the kernels of this module."""
    seen, T = np.ones((2, 4)), np.tile(np.eye(4), (2, 1, 1))
    R, t = np.ascontiguousarray(T[:, :3, :3]), np.zeros((2, 3))
    view, verdict, points, noise = (
        np.ones(2, np.int64),
        np.zeros(2, np.int64),
        np.zeros((2, 3)),
        np.ones(4),
    )
    measured = (seen, seen.copy(), view, R, t, noise)
    judge(*measured, 0, points, np.zeros(2), verdict)
    agree(*measured, view, points, np.zeros(2), verdict, np.zeros(2, np.int64))
