"""Pose graphs of places passed again and again: true loops next to each other, as in maps."""

import numpy as np

from graphworlds import DIM, EXP, INVERSE
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.geometry.lie import se2_exp, se3_exp, sim3_exp


def grid(side=8, laps=2):
    """Return poses of a plane path that goes over a square grid `laps` times, row by row."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    x[1::2] = x[1::2, ::-1]
    lap = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    points = np.concatenate([lap if n % 2 == 0 else lap[::-1] for n in range(laps)])
    Ts = se2_exp(
        np.stack([0.0 * points[:, 0], 0.0 * points[:, 0], np.arange(len(points)) * 0.3], 1)
    )
    Ts[:, :2, 2] = points
    return Ts


def sphere(rings=8, per_ring=14, radius=5.0):
    """Return poses of a path that winds around a sphere."""
    k = np.arange(rings * per_ring)
    up = np.pi * (k + per_ring) / (rings * per_ring + 2 * per_ring)
    around = 2 * np.pi * k / per_ring
    Ts = se3_exp(np.stack([*(0.0 * k,) * 3, 0.0 * k, 0.2 * up, around], axis=1))
    normal = np.stack([np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up)], 1)
    Ts[:, :3, 3] = radius * normal
    return Ts


def ring(count=60, laps=2, radius=6.0):
    """Return similarities along a ring gone round `laps` times, the scale changing slowly."""
    k = np.arange(count * laps)
    xi = np.zeros((len(k), 7))
    xi[:, 5], xi[:, 6] = 2 * np.pi * k / count, 0.1 * np.sin(0.05 * k)
    Ts = sim3_exp(xi)
    Ts[:, :2, 3] = radius * np.stack([np.cos(xi[:, 5]), np.sin(xi[:, 5])], axis=1)
    return Ts


PATHS = {"SE2": grid, "SE3": sphere, "Sim3": ring}


def passed_again(group, noise=0.03, reach=1.3, seed=0, modest=1.0):
    """Return a graph with a loop between poses that are near each other, and the true poses.

    Args:
        group: SE2 (grid), SE3 (sphere) or Sim3 (ring).
        noise: standard deviation of each tangent component.
        reach: how near nodes are that a loop ties, in steps of the path.
        seed: of the noise.
        modest: factor by which the covariances stated are too large.
    """
    Ts, k = PATHS[group](), DIM[group]
    n, d = len(Ts), Ts.shape[1] - 1
    at = Ts[:, :d, d]
    step = np.median(np.linalg.norm(np.diff(at, axis=0), axis=1))
    i, j = np.triu_indices(n, 4)
    near = np.linalg.norm(at[i] - at[j], axis=1) < reach * step
    first = np.concatenate([np.arange(n - 1), i[near]])
    second = np.concatenate([np.arange(1, n), j[near]])
    xi = noise * np.random.default_rng(seed).normal(size=(len(first), k))
    Zs = INVERSE[group](Ts[first]) @ Ts[second] @ EXP[group](xi)
    information = np.tile(np.eye(k) / noise**2 / modest, (len(first), 1, 1))
    return PoseGraph(group, np.full_like(Ts, np.nan), first, second, Zs, information), Ts
