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

NEAREST = 1e-6
"""Depth from which on a point lies ahead."""

STEPS = 1
"""Gauss-Newton steps of a point: one, as it starts within its noise."""


@kernel
def _add_view(p: Array, T: Array, seen: Array, noise: Array, H: Array, g: Array) -> float:
    """Add JᵀJ to H (00 01 02 11 12 22) and Jᵀr to g, and return |r|²; ∞ behind the view.

    r = ((X/Z − x)/σ, (Y/Z − y)/σ, (1/Z − d)/σ_d), (X, Y, Z) = R p + t; no third without d.
    """
    X = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    Y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    Z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if not Z > NEAREST:
        return np.inf
    chi2, inverse = 0.0, 1.0 / Z
    w = 1.0 / (noise[0] * seen[3])
    for axis in range(3):
        value = X * inverse if axis == 0 else (Y * inverse if axis == 1 else inverse)
        if axis == 2 and not np.isfinite(seen[2]):
            break
        if axis == 2:
            w, own = 1.0 / noise[1], 0.0  # d(1/Z) = −(1/Z)² dZ
        else:
            own = 1.0
        r = w * (value - seen[axis])
        j0 = w * inverse * (own * T[axis, 0] - value * T[2, 0])
        j1 = w * inverse * (own * T[axis, 1] - value * T[2, 1])
        j2 = w * inverse * (own * T[axis, 2] - value * T[2, 2])
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
def _start(first: Array, second: Array, T: Array, noise: Array, p: Array) -> float:
    """Write a first guess of the point into p, and return what tells its depth, rad.

    p is nearest to both rays, λa and c + μb, or, where a depth measured in one of the views is
    worth a wider angle, w = σ d/σ_d, than α between the rays, at that depth. Returns
    √(α² + Σ w²). Where the rays meet behind a camera p is put behind the first one.
    """
    ax, ay = first[0], first[1]
    x, y = second[0], second[1]
    bx = T[0, 0] * x + T[1, 0] * y + T[2, 0]
    by = T[0, 1] * x + T[1, 1] * y + T[2, 1]
    bz = T[0, 2] * x + T[1, 2] * y + T[2, 2]
    cx = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    cy = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    cz = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    ab = ax * bx + ay * by + bz
    ac = ax * cx + ay * cy + cz
    bc = bx * cx + by * cy + bz * cz
    aa, bb = ax * ax + ay * ay + 1.0, bx * bx + by * by + bz * bz
    square = (ay * bz - by) ** 2 + (bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    angle = np.arctan2(np.sqrt(square), ab)
    worth = noise[0] * first[3] * first[2] / noise[1]
    worth = worth if worth > 0.0 else 0.0
    other = noise[0] * second[3] * second[2] / noise[1]
    other = other if other > 0.0 else 0.0
    p[0], p[1], p[2] = 0.0, 0.0, -1.0
    if worth > angle and worth >= other:
        z = 1.0 / first[2]
        p[0], p[1], p[2] = z * ax, z * ay, z
    elif other > angle:
        z = 1.0 / second[2]
        p[0], p[1], p[2] = cx + z * bx, cy + z * by, cz + z * bz
    elif square > 0.0:
        along, beyond = (bb * ac - ab * bc) / square, (ab * ac - aa * bc) / square
        if along > 0.0 and beyond > 0.0:
            p[0] = 0.5 * (along * ax + cx + beyond * bx)
            p[1] = 0.5 * (along * ay + cy + beyond * by)
            p[2] = 0.5 * (along + cz + beyond * bz)
    return float(np.sqrt(angle * angle + worth * worth + other * other))


@kernel
def _is_noise(chi2: float, seen: Array) -> bool:
    """|r|² within what 95 of 100 true sightings have."""
    return chi2 <= (GATE_WITH_DEPTH if np.isfinite(seen[2]) else GATE)


@kernel
def _chi2(p: Array, T: Array, seen: Array, noise: Array) -> float:
    """|r|² of a sighting, ∞ behind the view: what `_add_view` returns, without derivatives."""
    Z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if not Z > NEAREST:
        return np.inf
    X = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    Y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    inverse, w = 1.0 / Z, 1.0 / (noise[0] * seen[3])
    u, v = w * (X * inverse - seen[0]), w * (Y * inverse - seen[1])
    d = (inverse - seen[2]) / noise[1]
    return float(u * u + v * v + (d * d if np.isfinite(d) else 0.0))


@kernel
def _sizes_agree(p: Array, T: Array, first: Array, second: Array, noise: Array) -> bool:
    """Whether |p| / |R p + t| is the levels' s₂ / s₁, within the tolerance: far is small."""
    near, far = 0.0, 0.0
    for m in range(3):
        q = T[m, 0] * p[0] + T[m, 1] * p[1] + T[m, 2] * p[2] + T[m, 3]
        near += p[m] * p[m]
        far += q * q
    factor = np.sqrt(near / far) * first[3] / second[3]
    return bool(factor <= noise[3] and factor * noise[3] >= 1.0)


@kernel
def _sees(p: Array, T: Array, first: Array, second: Array, noise: Array) -> bool:
    """Whether the second sighting is one of p."""
    chi2 = _chi2(p, T, second, noise)
    return _is_noise(chi2, second) and _sizes_agree(p, T, first, second, noise)


@kernel
def _next_widest(parallax: Array, verdict: Index, begin: int, end: int, last: int) -> int:
    """The sound pair of the widest angle after the last one, −1 for none; lower rows first."""
    chosen = -1
    for i in range(begin, end):
        if verdict[i] != 0 or (chosen >= 0 and not parallax[i] > parallax[chosen]):
            continue
        angle = parallax[last] if last >= 0 else np.inf
        if parallax[i] < angle or (parallax[i] == angle and i > last):
            chosen = i
    return chosen


@kernel
def judge(
    first: Array,
    second: Array,
    view: Index,
    Ts: Array,
    noise: Array,
    newest: int,
    points: Array,
    parallax: Array,
    verdict: Index,
) -> None:
    """For each pair p = argmin Σ |r|² by Gauss-Newton, and the first check it fails (or 0)."""
    H, g = np.empty(6), np.empty(3)
    for i in range(len(first)):
        p, a, b, T = points[i], first[i], second[i], Ts[view[i]]
        parallax[i] = _start(a, b, T, noise, p)
        if not parallax[i] >= noise[2]:
            verdict[i] = 1
            continue
        for _ in range(STEPS):
            for m in range(6):
                H[m], g[m // 2] = 0.0, 0.0
            chi2 = _add_view(p, Ts[newest], a, noise, H, g)
            chi2 += _add_view(p, T, b, noise, H, g)
            if not (np.isfinite(chi2) and _step(H, g, p)):
                break
        here = _chi2(p, Ts[newest], a, noise)
        there = _chi2(p, T, b, noise)
        if not np.isfinite(here + there):
            verdict[i] = 2
        elif not (_is_noise(here, a) and _is_noise(there, b)):
            verdict[i] = 3
        elif not _sizes_agree(p, T, a, b, noise):
            verdict[i] = 4


@kernel
def agree(
    first: Array,
    second: Array,
    view: Index,
    Ts: Array,
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
    begin = 0
    while begin < len(keypoint):
        end = begin + 1
        while end < len(keypoint) and keypoint[end] == keypoint[begin]:
            end += 1
        best, most, last = -1, 0, -1
        # From the widest angle down: one that all see cannot be beaten.
        while most < end - begin:
            i = _next_widest(parallax, verdict, begin, end, last)
            if i < 0:
                break
            votes, last = 0, i
            for j in range(begin, end):
                votes += _sees(points[i], Ts[view[j]], first[j], second[j], noise)
                if votes + end - 1 - j <= most:
                    break
            if votes > most:
                best, most = i, votes
        for j in range(begin, end):
            if best >= 0 and _sees(points[best], Ts[view[j]], first[j], second[j], noise):
                winner[j] = best
        begin = end


def warm_up() -> None:
    """Compile the kernels of this module."""
    seen, Ts, noise = np.ones((2, 4)), np.tile(np.eye(4)[:3], (2, 1, 1)), np.ones(4)
    view, verdict, points = np.ones(2, np.int64), np.zeros(2, np.int64), np.zeros((2, 3))
    measured = (seen, seen.copy(), view, Ts, noise)
    judge(*measured, 0, points, np.zeros(2), verdict)
    agree(*measured, view, points, np.zeros(2), verdict, np.zeros(2, np.int64))
