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


def corner_strength(image: Array, x: int, y: int) -> float:
    """Smaller eigenvalue of the mean of ∇I ∇Iᵀ over the 7x7 pixels around (x, y)."""
    dy, dx = np.gradient(image.astype(float)[y - 4 : y + 5, x - 4 : x + 5])
    g = np.stack([dx[1:-1, 1:-1].ravel(), dy[1:-1, 1:-1].ravel()])
    return float(np.linalg.eigvalsh(g @ g.T / 49)[0])


def spread(points: Array, strength: Array, count: int, radius: float, occupied: Array) -> list[int]:
    """The strongest point that keeps its distance, again and again; then at half the distance."""
    kept: list[int] = []
    for r in (radius, radius / 2):
        for k in np.argsort(-strength, kind="stable").tolist():
            others = np.concatenate([occupied, points[kept]])
            if len(kept) < count and (np.sum((others - points[k]) ** 2, axis=1) >= r * r).all():
                kept.append(k)
    return kept


def distances(wanted: Array, others: Array) -> Array:
    """Bits that differ of 32 bytes; squared distances of longer descriptors; (M, N)."""
    if wanted.shape[1] == 32:
        return np.unpackbits(wanted[:, None] ^ others[None], axis=2).sum(axis=2)
    return np.sum((wanted[:, None].astype(float) - others[None].astype(float)) ** 2, axis=2)


def match_guided(
    near: Array, distance: Array, ratio: float, limit: float
) -> list[tuple[int, float]]:
    """For each row (its match or -1, distance): the best of those near, if clearly the best."""
    rows = []
    for is_near, row in zip(near, distance):
        order = sorted((d, n) for n, d in enumerate(row.tolist()) if is_near[n])
        second = order[1][0] if len(order) > 1 else np.inf
        good = bool(order) and order[0][0] <= limit and order[0][0] < ratio * second
        rows.append((order[0][1], order[0][0]) if good else (-1, np.inf))
    return rows


def residual(
    T_world_body: Array,
    T_camera_body: Array,
    baseline: float,
    p: Array,
    xy: Array,
    disparity: float,
    weights: Array,
) -> Array:
    """Weighted reprojection errors of x, y and disparity (0 if there is none)."""
    X, Y, Z = (T_camera_body @ np.linalg.inv(T_world_body) @ np.append(p, 1.0))[:3]
    last = 0.0 if np.isnan(disparity) else baseline / Z - disparity
    return np.array([X / Z - xy[0], Y / Z - xy[1], last]) * (weights[0], weights[0], weights[1])


def kannala_brandt(x: float, y: float, z: float, k: Array) -> tuple[float, float]:
    theta = np.arccos(z / np.sqrt(x * x + y * y + z * z))
    r = theta + sum(k[i] * theta ** (2 * i + 3) for i in range(4))
    azimuth = np.arctan2(y, x)
    return r * np.cos(azimuth), r * np.sin(azimuth)


def double_sphere(x: float, y: float, z: float, xi: float, alpha: float) -> tuple[float, float]:
    on_sphere = np.array([x, y, z]) / np.sqrt(x * x + y * y + z * z) + [0, 0, xi]
    on_second = on_sphere / np.linalg.norm(on_sphere) + [0, 0, alpha / (1 - alpha)]
    # The pinhole's plane is where the axis has focal length 1 before both shifts.
    u, v = on_second[:2] / on_second[2]
    return u / (1 - alpha), v / (1 - alpha)
