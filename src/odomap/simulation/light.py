"""Light: how bright each surface is, with soft shadows, computed once.

At a point with normal n the light is the sky or the lamps' bounce seen past nearby obstacles plus
what arrives directly:

    E = ambient · (share of the hemisphere that is open) + Σ_lamps visible · I max(0, n·l) / d²
        + sun visible · max(0, n·l)

It is sampled by rays on a grid over each rectangle and interpolated between. Lamps are spread over
a small sphere, so their shadows have soft edges.

Cost: (rays per point) · O(log N) per grid point, about a second for a street.

Paper: R. L. Cook, T. Porter and L. Carpenter, "Distributed ray tracing", SIGGRAPH 1984.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.simulation.rays import BoxTree, cast_kernel

__all__ = ["LightGrid", "Lights", "bake", "warm_up"]

Array = NDArray[np.float64]
LAMP_RAYS = 3


@dataclass(frozen=True)
class Lights:
    """What shines.

    Attributes:
        ambient: light from everywhere.
        reach_m: obstacles farther than this do not dim the ambient light.
        lamps: (L, 3) positions, metres.
        powers: (L,) light on a facing surface at one metre.
        lamp_radius_m: size of a lamp.
        sun: (3,) direction towards it.
        sun_power: light on a surface that faces it.
        grid_m: distance between grid points.
        open_rays: rays per grid point that look for the ambient light.
    """

    ambient: float
    reach_m: float
    lamps: Array
    powers: Array
    lamp_radius_m: float = 0.15
    sun: Array | None = None
    sun_power: float = 0.0
    grid_m: float = 0.25
    open_rays: int = 6


@dataclass(frozen=True)
class LightGrid:
    """Baked light.

    Attributes:
        values: (G,) float32.
        table: (N, 3) int64: first value, columns and rows of each rectangle's grid.
    """

    values: NDArray[np.float32]
    table: NDArray[np.int64]


def bake(
    frames: Array,
    faces: Array,
    mover: NDArray[np.int64],
    tree: BoxTree,
    lights: Lights,
    rng: np.random.Generator,
) -> LightGrid:
    """Light all rectangles.

    Args:
        frames: (N, 9) corners and sides in the world.
        faces: (N, 8) as in `Rectangles`.
        mover: (N,) -1 where a rectangle stands still; the others cast no shadow.
        tree: over the still ones.
        lights: what shines.
        rng: where the rays come from.
    """
    cells = np.clip(np.ceil(faces[:, :2] / lights.grid_m).astype(np.int64), 1, 63) + 1
    count = cells[:, 0] * cells[:, 1]
    first = np.cumsum(count) - count
    points, normals = np.empty((int(count.sum()), 3)), np.empty((int(count.sum()), 3))
    grid_kernel(frames, faces, cells, points, normals)
    caster = _Caster(frames, faces, tree)
    values = lights.ambient * _openness(points, normals, lights, caster, rng)
    values += _direct(points, normals, lights, caster, rng)
    table = np.column_stack([first, cells]).astype(np.int64)
    return LightGrid(values.astype(np.float32), table)


class _Caster:
    """Tells which rays are free."""

    def __init__(self, frames: Array, faces: Array, tree: BoxTree) -> None:
        self._scene = (frames, faces, tree.boxes, tree.nodes, tree.order)

    def is_free(self, origins: Array, directions: Array, farthest: float) -> NDArray[np.bool_]:
        """Return (R,) whether nothing is met up to `farthest` times the direction's length."""
        distance = np.empty(len(origins))
        hit = np.empty(len(origins), np.int64)
        nobody = np.zeros(0, np.int64), np.zeros((0, 3))
        times = np.zeros(len(origins))
        cast_kernel(
            np.ascontiguousarray(origins),
            np.ascontiguousarray(directions),
            times,
            farthest,
            *self._scene,
            *nobody,
            distance,
            hit,
        )
        return hit < 0


@kernel
def grid_kernel(
    frames: Array, faces: Array, cells: NDArray[np.int64], points: Array, normals: Array
) -> None:
    """Write c + s u + t v + 3 cm n over the grid of each rectangle, 1 cm off its rim, and n."""
    k = 0
    for i in range(frames.shape[0]):
        f = frames[i]
        nx = f[5] * f[7] - f[4] * f[8]
        ny = f[3] * f[8] - f[5] * f[6]
        nz = f[4] * f[6] - f[3] * f[7]
        for row in range(cells[i, 1]):
            t = 0.01 + (faces[i, 1] - 0.02) * row / (cells[i, 1] - 1)
            for column in range(cells[i, 0]):
                s = 0.01 + (faces[i, 0] - 0.02) * column / (cells[i, 0] - 1)
                points[k, 0] = f[0] + s * f[3] + t * f[6] + 0.03 * nx
                points[k, 1] = f[1] + s * f[4] + t * f[7] + 0.03 * ny
                points[k, 2] = f[2] + s * f[5] + t * f[8] + 0.03 * nz
                normals[k, 0], normals[k, 1], normals[k, 2] = nx, ny, nz
                k += 1


def warm_up() -> None:
    """Compile the kernels."""
    out = np.empty((4, 3))
    frames = np.array([[0.0, 0, 0, 1, 0, 0, 0, 1, 0]])
    grid_kernel(frames, np.ones((1, 8)), np.full((1, 2), 2), out, out.copy())


def _openness(
    points: Array, normals: Array, lights: Lights, caster: _Caster, rng: np.random.Generator
) -> Array:
    """Return (G,) the cosine-weighted share of the hemisphere without obstacles within reach."""
    free = np.zeros(len(points))
    for _ in range(lights.open_rays):
        sphere = rng.standard_normal(points.shape)
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        free += caster.is_free(points, normals + 0.999 * sphere, lights.reach_m)
    return 0.35 + 0.65 * free / lights.open_rays


def _direct(
    points: Array, normals: Array, lights: Lights, caster: _Caster, rng: np.random.Generator
) -> Array:
    """Return (G,) light from the lamps and the sun."""
    total = np.zeros(len(points))
    for lamp, power in zip(lights.lamps, lights.powers, strict=True):
        for _ in range(LAMP_RAYS):
            spread = lights.lamp_radius_m * rng.standard_normal(points.shape)
            ray = lamp + spread - points
            far = np.linalg.norm(ray, axis=1)
            facing = np.maximum(0.0, (normals * ray).sum(1) / far)
            lit = caster.is_free(points, ray, 0.98) & (facing > 0)
            total += lit * facing * power / np.maximum(far, 0.3) ** 2 / LAMP_RAYS
    if lights.sun is not None:
        facing = np.maximum(0.0, normals @ lights.sun)
        ray = np.tile(lights.sun * 200.0, (len(points), 1))
        total += lights.sun_power * facing * caster.is_free(points, ray, 1.0)
    return total
