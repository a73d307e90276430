"""Degeneracy: how well two clouds fix the motion between them, and in which directions they do not.

The problem: a corridor fixes everything but the way along it, yet the pairs of a registration count
there as much as elsewhere, since nearest points slide along. What fixes a motion is the surface:
with the target's normals n and residuals r = nᵀ(q - T p), by a right update T exp(ξ),

    I = (1/σ²) Σ f a aᵀ,    a = (Rᵀn, p × Rᵀn),    σ² = Σ r² / (N - 6), without what is beyond 3 σ

whatever the method; f is the share of its points that a pair has for its own (`target`). But
normals are noisy: one tilted by δ (`normals`) speaks for its own tangent plane with weight δ², and
ten thousand make a corridor look known. That, (1/σ²) Σ f δ² Jᵀ(I - n nᵀ) J, is subtracted.
A motion moves points by Σ f |J ξ|² = ξᵀ K ξ, and across the surface by σ² ξᵀ I ξ; an eigenvalue of
σ² I against K is the share of a motion that is seen. It is weak where less than 0.1 % is seen, or
less than may be chance, three times the share of the noise; in I it counts for nothing.

Errors are taken for independent; where pairs share what the model does not say (edges, curvature,
motion within a sweep) a motion is less sure than I says. Simulated rooms: the square of the error
in units of I is 0.7 to 2.1 of what it should be.

Reference: J. Zhang, M. Kaess, S. Singh, "On degeneracy of optimization-based state estimation
problems", ICRA 2016.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.so3 import hat
from odomap.kernels import kernel
from odomap.lidar.icp import SLOTS, add_plane

__all__ = ["UPPER", "Certainty", "holding", "judge", "known_part", "named", "symmetric", "warm_up"]

Array = NDArray[np.float64]

LEAST_SHARE = 1e-3
NOISE_FACTOR = 3.0
GROSS = 9.0
"""Squared residuals beyond this many σ² do not count for σ²."""
MEDIAN_OF_CHI2 = 0.4549
EXACT = 1e-9
"""Least σ, as a share of the cloud's radius: exact clouds have no noise to scale with."""
HELD = 1e4
"""β, where a motion is seen by 1 at most."""
UPPER = np.triu_indices(6)
"""Entries of a symmetric matrix in the order in which kernels sum them up."""
LEVER = 2.0
"""Metres that a body is moved as easily as it is turned by a radian."""
PLANE = (0, 1, 5)
"""What is free in the plane: x, y, θ."""


@dataclass(frozen=True, eq=False)
class Certainty:
    """How well a motion is fixed.

    Attributes:
        information: (6, 6), or (3, 3) of x, y, θ in the plane.
        weak_directions: (K, 6) or (K, 3) tangents about the source's mean that are not fixed,
            rotations first, each of a length that moves the points by 1 m, root mean square.
        error: root mean square distance from the target's surface, metres.
        reason: names the weak directions; empty if there is none.
    """

    information: Array
    weak_directions: Array
    error: float
    reason: str


def judge(
    p: Array, e: Array, n: Array, spreads: Array, own: Array, R: Array, origin: Array,
    planar: bool, least: float = LEAST_SHARE,
) -> Certainty:  # fmt: skip
    """Say how well pairs fix a motion.

    Args:
        p: (N, 3) source points about their mean.
        e: (N, 3) from where they lie in the target to their counterparts.
        n: (N, 3) the target's normals there, zero where there is none.
        spreads: (N, 5) number of points behind each normal, and their eigenvalues.
        own: (N,) the share of what a pair was made of that is its own.
        R: (3, 3) source to target.
        origin: (3,) the source's mean: the motion is that of its frame, not of its middle.
        planar: whether x, y and θ alone are free.
        least: share of a motion that must be seen.
    """
    free = np.array(PLANE) if planar else np.arange(6)
    squares, sums = np.empty(len(p)), np.zeros((4, SLOTS))
    known = _sum_fits(p, e, n, spreads, own, R, squares, sums)
    error = float(np.sqrt(sums[2, 10] / len(p))) if len(p) else 0.0
    if known <= len(free):
        nothing = np.zeros((len(free), len(free)))
        return Certainty(nothing, np.eye(len(free)), error, "hardly any surface was met")
    radius = max(float(np.sqrt(np.mean(p * p) * 3.0)), 1e-12)
    variance = max(_variance(squares[:known], len(free)), (EXACT * radius) ** 2)
    noise = _motion(sums[3]) - symmetric(sums[1])
    motion = _motion(sums[2]) + known * 1e-12 * np.diag([1.0] * 3 + [radius * radius] * 3)
    fits = symmetric(sums[0]) - noise
    noise, motion, fits = (M[np.ix_(free, free)] / known for M in (noise, motion, fits))
    root, weak = known_part(fits, noise, motion, least)
    shift = np.eye(6)
    shift[:3, 3:] = -hat(origin)
    root = shift[np.ix_(free, free)].T @ root
    information = root @ root.T * (known / variance)
    lever = np.where(free < 3, 1.0, radius)
    return Certainty(information, weak, error, named(weak * lever, planar))


def known_part(
    fits: Array, noise: Array, motion: Array, least: float = LEAST_SHARE
) -> tuple[Array, Array]:
    """Part what is known of a motion from what is not.

    Args:
        fits: (D, D) how much of a motion is seen across surfaces, without what noise pretends.
        noise: (D, D) what noise pretends.
        motion: (D, D) how much points move.
        least: share of a motion that must be seen.

    Returns:
        (D, D) a root of the information, zero along what is weak; (K, D) what is, each of a length
        that moves points by 1 m, root mean square, where `motion` is of one point.
    """
    L = np.linalg.cholesky(motion)
    inverse = np.linalg.inv(L)
    shares, axes = np.linalg.eigh(inverse @ fits @ inverse.T)
    shares = np.maximum(shares, 0.0)
    chance = np.einsum("ji,jk,ki->i", axes, inverse @ noise @ inverse.T, axes)
    is_weak = shares < least + NOISE_FACTOR * chance
    # What may be chance is no information: whoever fuses with it would be led astray.
    root = L @ axes * np.sqrt(np.where(is_weak, 0.0, shares))
    weak = (inverse.T @ axes).T[is_weak]
    return np.asarray(root), _parted(weak, 2 if len(weak.T) < 6 else 3)


@kernel
def _sum_fits(
    p: Array, e: Array, n: Array, spreads: Array, own: Array, R: Array, squares: Array, sums: Array
) -> int:
    """Sums of f a aᵀ (row 0), f δ² a aᵀ (1), moments f, f p, f p pᵀ of the points (2), of f δ² (3).

    δ² = λ₀ λ₁ / (n (λ₁ - λ₀)²). squares: r² of pairs with a normal, whose number is returned; those
    of all, as distances where there is no normal, are added up in sums[2, 10].
    """
    known = 0
    for i in range(p.shape[0]):
        if not spreads[i, 0] > 0.0:
            sums[2, 10] += e[i, 0] * e[i, 0] + e[i, 1] * e[i, 1] + e[i, 2] * e[i, 2]
            continue
        x, y, z = p[i, 0], p[i, 1], p[i, 2]
        a = R[0, 0] * n[i, 0] + R[1, 0] * n[i, 1] + R[2, 0] * n[i, 2]
        b = R[0, 1] * n[i, 0] + R[1, 1] * n[i, 1] + R[2, 1] * n[i, 2]
        c = R[0, 2] * n[i, 0] + R[1, 2] * n[i, 1] + R[2, 2] * n[i, 2]
        r = n[i, 0] * e[i, 0] + n[i, 1] * e[i, 1] + n[i, 2] * e[i, 2]
        squares[known] = r * r
        known += 1
        sums[2, 10] += r * r
        thin, wide = spreads[i, 1], spreads[i, 2] - spreads[i, 1]
        tilt = min(thin * spreads[i, 2] / (spreads[i, 0] * wide * wide), 1.0)
        for row in range(2):
            w = own[i] * tilt if row == 1 else own[i]
            add_plane(x, y, z, a, b, c, r, w, sums[row])
            m = sums[2 + row]
            m[0] += w
            m[1] += w * x
            m[2] += w * y
            m[3] += w * z
            m[4] += w * x * x
            m[5] += w * x * y
            m[6] += w * x * z
            m[7] += w * y * y
            m[8] += w * y * z
            m[9] += w * z * z
    return known


def symmetric(total: Array) -> Array:
    """Return (6, 6) of its 21 entries above the diagonal."""
    M = np.zeros((6, 6))
    M[UPPER] = total[:21]
    return M + np.triu(M, 1).T


def _motion(m: Array) -> Array:
    """Return (6, 6) the sum of w Jᵀ J, J = [I -p^], from the moments of the points."""
    second = np.array([[m[4], m[5], m[6]], [m[5], m[7], m[8]], [m[6], m[8], m[9]]])
    K = np.empty((6, 6))
    K[:3, :3] = m[0] * np.eye(3)
    K[:3, 3:], K[3:, :3] = -hat(m[1:4]), hat(m[1:4])
    K[3:, 3:] = np.trace(second) * np.eye(3) - second
    return K


def _variance(squares: Array, used: int) -> float:
    """Return σ² of squared residuals (N,), a part of which may be gross."""
    kept = squares[squares <= GROSS * float(np.median(squares)) / MEDIAN_OF_CHI2]
    return float(kept.sum() / max(len(kept) - used, 1))


def holding(weak: Array, weight: float) -> Array:
    """Return what (6, 6) is added to H for tangents (K, 6) to be held, with H of so much weight.

    It is β M W (Wᵀ M W)⁻¹ Wᵀ M, M saying how easily a body moves: the rest stays as it is.
    """
    if not len(weak):
        return np.zeros((6, 6))
    unlikely = weight * np.diag(np.repeat([1.0, LEVER**2], 3))
    moved = unlikely @ weak.T
    return np.asarray(HELD * moved @ np.linalg.solve(weak @ moved, moved.T))


def _parted(weak: Array, turns: int) -> Array:
    """Return weak directions (K, D) turned among themselves so that as few as can be are rotations.

    Of directions that are as weak any mixture is as good; from column `turns` on they turn.
    """
    if not len(weak):
        return weak
    mix = np.linalg.svd(weak[:, turns:])[0]
    return np.asarray(mix.T @ weak)


def named(weak: Array, planar: bool = False) -> str:
    """Name weak directions: along what the source may slide, about what it may turn.

    Args:
        weak: (K, 6) or (K, 3) tangents, rotations in units of how far they move points.
        planar: whether they are of x, y and θ.
    """
    if not len(weak):
        return ""
    named = []
    for direction in weak:
        shift, turn = direction[: 2 if planar else 3], direction[2 if planar else 3 :]
        if shift @ shift >= turn @ turn:
            named.append("translation along " + _axis(shift))
        else:
            named.append("rotation" if planar else "rotation about " + _axis(turn))
    return "degenerate: the clouds do not fix " + ", ".join(named)


def _axis(vector: Array) -> str:
    unit = vector / np.linalg.norm(vector)
    unit = unit * np.sign(unit[np.argmax(np.abs(unit))])
    return "(" + ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in unit.tolist()) + ")"


def warm_up() -> None:
    """Compile the kernels of this file."""
    p, one = np.eye(3), np.ones((3, 5))
    judge(p, p, p, one, np.ones(3), p, np.zeros(3), False)
