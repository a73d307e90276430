"""Rays: the tree finds what asking every rectangle finds."""

import numpy as np
import pytest

from odomap.simulation.rays import BoxTree, cast_kernel


def random_rectangles(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    u = rng.standard_normal((count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.standard_normal((count, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    faces = np.ones((count, 8))
    faces[:, :2] = rng.uniform(0.2, 2.0, (count, 2))
    return np.hstack([rng.uniform(-5, 5, (count, 3)), u, v]), faces


def by_asking_all(o: np.ndarray, d: np.ndarray, frames: np.ndarray, faces: np.ndarray) -> tuple:
    """The nearest hit of each ray, and whose it is."""
    c, u, v = frames[:, :3], frames[:, 3:6], frames[:, 6:]
    n = np.cross(u, v)
    t = ((c - o[:, None]) * n).sum(-1) / (d @ n.T)
    x = o[:, None] + t[..., None] * d[:, None] - c
    s, r = (x * u).sum(-1), (x * v).sum(-1)
    hit = (t > 1e-6) & (s >= 0) & (s <= faces[:, 0]) & (r >= 0) & (r <= faces[:, 1])
    t = np.where(hit, t, np.inf)
    return t.min(1), np.where(hit.any(1), t.argmin(1), -1)


@pytest.mark.parametrize("by_area", [False, True])
def test_the_tree_agrees_with_asking_every_rectangle(by_area: bool) -> None:
    rng = np.random.default_rng(0)
    frames, faces = random_rectangles(rng, 300)
    c, a = frames[:, :3], frames[:, 3:6] * faces[:, :1]
    b = frames[:, 6:] * faces[:, 1:2]
    still = np.arange(280)
    tree = BoxTree.of(np.stack([c, c + a, c + a + b, c + b], 1)[still], by_area=by_area)
    movers = np.arange(280, 300)
    velocities = rng.standard_normal((20, 3))
    origins, directions = rng.uniform(-6, 6, (400, 3)), rng.standard_normal((400, 3))
    times = np.repeat([0.0, 0.5], 200)
    distance, hit = np.empty(400), np.empty(400, np.int64)
    cast_kernel(
        origins, directions, times, 50.0, frames, faces, tree.boxes, tree.nodes, tree.order,
        movers, velocities, distance, hit,
    )  # fmt: skip
    for time, part in ((0.0, slice(0, 200)), (0.5, slice(200, 400))):
        moved = frames.copy()
        moved[movers, :3] += velocities * time
        t, who = by_asking_all(origins[part], directions[part], moved, faces)
        np.testing.assert_array_equal(hit[part], who)
        found = who >= 0
        assert 0.3 < found.mean() < 1.0
        np.testing.assert_allclose(distance[part][found], t[found], rtol=1e-12)
        assert (distance[part][~found] == 50.0).all()
