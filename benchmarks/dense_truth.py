"""How far a mesh is from the true surface of a simulated scene, and how much of that it covers.

Accuracy: points spread evenly over the mesh, each with its distance to the nearest rectangle of the
scene that faces the same way. Completeness: what the cameras saw in truth, by ray casting, and the
share of it that has a point of the mesh within 5 cm.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from odomap.geometry.camera import Camera
from odomap.maps.surface import Surface
from odomap.simulation.rays import cast_kernel
from odomap.simulation.scene import Rectangles, Scene

Array = NDArray[np.float64]
NEAR_M = 0.05


@dataclass(frozen=True)
class Quality:
    """Distances in metres.

    Attributes:
        mean: of the mesh to the true surface.
        p95: 95 % of the mesh is nearer.
        far: share of the mesh farther than 5 cm.
        complete: share of what the cameras saw that has mesh within 5 cm.
    """

    mean: float
    median: float
    p95: float
    far: float
    complete: float

    def __str__(self) -> str:
        return (
            f"mean {100 * self.mean:.2f} cm, median {100 * self.median:.2f} cm, "
            f"p95 {100 * self.p95:.2f} cm, beyond 5 cm {100 * self.far:.2f} %, "
            f"complete {100 * self.complete:.1f} %"
        )


def judge(
    mesh: Surface, scene: Scene, camera: Camera, Ts_world_camera: Array, max_depth: float
) -> Quality:
    """Compare a mesh in the scene's world with the scene."""
    points, normals = sample(mesh, 40_000)
    distance = distance_to(scene.rectangles, points, normals)
    seen = visible_points(scene, camera, Ts_world_camera, max_depth)
    dense, _ = sample(mesh, 400_000)
    gap, _ = cKDTree(dense).query(seen, distance_upper_bound=NEAR_M)
    return Quality(
        float(distance.mean()),
        float(np.median(distance)),
        float(np.quantile(distance, 0.95)),
        float(np.mean(distance > NEAR_M)),
        float(np.mean(np.isfinite(gap))),
    )


def sample(mesh: Surface, count: int) -> tuple[Array, Array]:
    """Return (N, 3) points spread evenly over the triangles, and their normals."""
    rng = np.random.default_rng(0)
    areas = mesh.areas()
    rows = np.searchsorted(np.cumsum(areas) / areas.sum(), rng.random(count))
    a, b, c = (mesh.points[mesh.faces[rows, k]].astype(np.float64) for k in range(3))
    s, t = rng.random((2, count, 1))
    s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
    # Normals of the points: those of slivers say nothing.
    normals = mesh.normals[mesh.faces[rows]].sum(axis=1).astype(np.float64)
    return a + s * (b - a) + t * (c - a), normals


def distance_to(rectangles: Rectangles, points: Array, normals: Array) -> Array:
    """Return (N,) distances to the nearest rectangle that faces the same way."""
    corner, u, v = (rectangles.frames[:, k : k + 3] for k in (0, 3, 6))
    # A rectangle is seen from the side away from u x v.
    out = -np.cross(u, v)
    two_sided = rectangles.faces[:, 6] > 0
    best = np.full(len(points), np.inf)
    for k in range(len(rectangles)):
        offset = points - corner[k]
        s, t = offset @ u[k], offset @ v[k]
        aside = s - np.clip(s, 0, rectangles.faces[k, 0]), t - np.clip(t, 0, rectangles.faces[k, 1])
        distance = np.sqrt((offset @ out[k]) ** 2 + aside[0] ** 2 + aside[1] ** 2)
        faces_us = np.ones(len(points), bool) if two_sided[k] else normals @ out[k] > 0
        best = np.where(faces_us, np.minimum(best, distance), best)
    return best


def visible_points(scene: Scene, camera: Camera, Ts_world_camera: Array, max_depth: float) -> Array:
    """Return what the cameras see, up to a depth, one ray per 16 x 16 pixels."""
    u, v = np.meshgrid(np.arange(8, camera.width, 16.0), np.arange(8, camera.height, 16.0))
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], 1))
    rays /= rays[:, 2:]
    found = []
    for T in Ts_world_camera:
        directions = np.ascontiguousarray(rays @ T[:3, :3].T)
        origins = np.tile(T[:3, 3], (len(rays), 1))
        depth, hit = np.empty(len(rays)), np.empty(len(rays), np.int64)
        cast_kernel(
            origins, directions, np.zeros(len(rays)), max_depth, scene.rectangles.frames,
            scene.rectangles.faces, scene.tree.boxes, scene.tree.nodes, scene.tree.order,
            np.zeros(0, np.int64), np.zeros((0, 3)), depth, hit,
        )  # fmt: skip
        found.append((origins + depth[:, None] * directions)[hit >= 0])
    return np.concatenate(found)
