"""Plain twins of formulas and kernels: slow, short, written straight from the definition."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]


def numeric_jacobian(f: Callable[[Array], Any], n: int, step: float = 1e-6) -> Array:
    """Central differences of f at the origin of its n arguments; output shape + (n,)."""
    axes = step * np.eye(n)
    return np.stack([(np.asarray(f(a)) - np.asarray(f(-a))) / (2 * step) for a in axes], axis=-1)


def hat3(phi: Array) -> Array:
    x, y, z = phi
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def algebra(group: str, xi: Array) -> Array:
    """The matrix of a tangent vector: the generator whose exponential is the group element."""
    if group == "so3":
        return hat3(xi)
    if group == "se2":
        return np.array([[0, -xi[2], xi[0]], [xi[2], 0, xi[1]], [0, 0, 0]])
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = hat3(xi[3:6]), xi[:3]
    if group == "sim3":
        out[:3, :3] += xi[6] * np.eye(3)
    return out


def exponential(group: str, xi: Array) -> Array:
    return expm(algebra(group, xi))


def associate(ours: Array, theirs: Array, limit: int) -> list[tuple[int, int]]:
    """The benchmark's rule in words: each proposes its nearest, the closest proposals win."""
    proposals = []
    for i, stamp in enumerate(ours.tolist()):
        nearest = min(range(len(theirs)), key=lambda k: (abs(int(theirs[k]) - stamp), k))
        proposals.append((abs(int(theirs[nearest]) - stamp), i, nearest))
    taken: set[int] = set()
    pairs = []
    for distance, i, k in sorted(proposals):
        if distance <= limit and k not in taken:
            taken.add(k)
            pairs.append((i, k))
    return sorted(pairs)


def radtan(x: float, y: float, d: Array) -> tuple[float, float]:
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(d, (0, 8 - len(d)))
    r2 = x * x + y * y
    g = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return u, g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def pixel_errors(R: Array, t: Array, points: Array, plane: Array, slopes: Array) -> Array:
    """L (π(p_camera) - x) for T_world_camera = (R, t); (N, 2)."""
    p = (points - t) @ R
    return np.einsum("nij,nj->ni", slopes, p[:, :2] / p[:, 2:] - plane)
