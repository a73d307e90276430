"""Rooms for scans: walls as segments, and what a scanner would see of them."""

import numpy as np

# A room of 8 m by 5 m with a pillar and an alcove: no turn or shift makes it the same again.
OUTLINE = np.array([[-4, -2], [4, -2], [4, 3], [1, 3], [1, 4], [-1, 4], [-1, 3], [-4, 3]], float)
PILLAR = np.array([[2, 0], [2.4, 0], [2.4, 0.5], [2, 0.5]], float)
ROOM = (OUTLINE, PILLAR)
CORRIDOR = (np.array([[-50, -1], [50, -1], [50, 1], [-50, 1]], float),)


def segments(polygons):
    return np.concatenate([np.stack([p, np.roll(p, -1, axis=0)], axis=1) for p in polygons])


def cast(polygons, x_world_body, angles, rng=None, sigma=0.01, farthest=30.0):
    """Return (N,) ranges from a pose (x, y, heading), inf beyond the farthest."""
    a, b = np.swapaxes(segments(polygons), 0, 1)
    d = np.stack([np.cos(angles + x_world_body[2]), np.sin(angles + x_world_body[2])], axis=1)
    e, w = b - a, a - np.asarray(x_world_body[:2])
    cross = d[:, None, 0] * e[:, 1] - d[:, None, 1] * e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (w[:, 0] * e[:, 1] - w[:, 1] * e[:, 0]) / cross
        u = (w[:, 0] * d[:, None, 1] - w[:, 1] * d[:, None, 0]) / cross
    t = np.where((u >= 0) & (u <= 1) & (t > 0), t, np.inf).min(axis=1)
    noise = 0.0 if rng is None else rng.normal(0.0, sigma, len(t))
    return np.where(t > farthest, np.inf, t + noise)
