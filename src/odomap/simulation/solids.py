"""Solids: what a LiDAR can meet, without paint or light, quick to make and to search.

Four shapes make a town: rectangles (walls, cars, kerbs), upright cylinders (poles, trunks), balls
of leaves and the ground. A ball is no surface: a beam goes into it freely for a length that is
distributed exponentially, p(s) = exp(-s/λ)/λ, or through it where that is longer than its chord.
The ground is a grid of heights, bilinear between them, so that streets rise and fall:

    h(x, y) = (1-a)(1-b) h00 + a (1-b) h10 + (1-a) b h01 + a b h11.

A `SolidsBuilder` collects shapes; `build()` hangs those that stand still in a tree of boxes, each
node with the boxes of both its children, and the shapes in the order of its leaves, so that a beam
reads memory in order. Shapes that move are rectangles in the frame of their mover.

Cost: O(N log N) to build, about 50 µs a shape.

Paper: T. L. Kay and J. T. Kajiya, "Ray tracing complex scenes", SIGGRAPH 1986.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.simulation.path import Path
from odomap.simulation.rays import BoxTree
from odomap.simulation.scene import FACES

__all__ = ["KINDS", "Ground", "Solids", "SolidsBuilder"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

KINDS = ("ground", "building", "pole", "leaves", "vehicle", "furniture", "moving")
"""What things are."""
RECTANGLE, CYLINDER, BALL = range(3)
ALBEDO = {
    "ground": 0.2, "building": 0.45, "pole": 0.6, "leaves": 0.35, "vehicle": 0.5,
    "furniture": 0.4, "moving": 0.5,
}  # fmt: skip
"""Share of a LiDAR's light that is thrown back, where nothing else is said."""


@dataclass(frozen=True)
class Ground:
    """Heights over a grid.

    Attributes:
        heights: (rows, columns) metres at the nodes, rows along y; empty where there is no ground.
        corner: (3,) x and y of node (0, 0), and the side of a cell, metres.
        steepest: no slope is steeper.
    """

    heights: Array
    corner: Array
    steepest: float

    @classmethod
    def none(cls) -> "Ground":
        """Return no ground at all."""
        return cls(np.zeros((0, 0)), np.array([0.0, 0.0, 1.0]), 0.0)

    @classmethod
    def waves(cls, low: Array, high: Array, waves: Array, cell_m: float = 3.0) -> "Ground":
        """Return ground between two corners that rises and falls as a sum of waves.

        Args:
            low: (2,) corner with the least x and y, metres.
            high: (2,) the opposite corner.
            waves: (K, 4) amplitude, wave vector (rad/m) and phase of each.
            cell_m: side of a cell.
        """
        shape = np.ceil((high - low) / cell_m).astype(int) + 1
        x = low[0] + cell_m * np.arange(shape[0])
        y = low[1] + cell_m * np.arange(shape[1])
        heights = np.zeros((shape[1], shape[0]))
        for amplitude, kx, ky, phase in waves:
            heights += amplitude * np.sin(kx * x[None, :] + ky * y[:, None] + phase)
        steps = [np.abs(np.diff(heights, axis=axis)).max() / cell_m for axis in (0, 1)]
        return cls(heights, np.array([low[0], low[1], cell_m]), float(np.hypot(*steps)))

    def height(self, x: float, y: float) -> float:
        """Return the height at a place, metres; zero where there is no ground."""
        if not self.heights.size:
            return 0.0
        rows, columns = self.heights.shape
        u = np.clip((x - self.corner[0]) / self.corner[2], 0, columns - 1 - 1e-9)
        v = np.clip((y - self.corner[1]) / self.corner[2], 0, rows - 1 - 1e-9)
        i, j = int(u), int(v)
        a, b = u - i, v - j
        h = self.heights[j : j + 2, i : i + 2]
        return float(
            (1 - b) * ((1 - a) * h[0, 0] + a * h[0, 1]) + b * ((1 - a) * h[1, 0] + a * h[1, 1])
        )


@dataclass(frozen=True)
class Solids:
    """Shapes and the tree over those that stand still.

    Attributes:
        shapes: (N, 14) first those that stand still, in the order of the tree's leaves. Rectangles:
            n, n·c, u, u·c, v, v·c, a, b with normal n, corner c, unit sides u and v of lengths a
            and b. Cylinders: x, y, radius, lowest and highest z. Balls: centre, radius, λ.
        forms: (N,) 0 for rectangles, 1 for cylinders, 2 for balls.
        kinds: (N,) index of `KINDS`.
        albedos: (N,) share of the light that is thrown back.
        things: (N,) which thing a shape is a part of: all faces of a house have one number.
        is_ground: (N,) whether one could drive or walk on it, or it is the kerb between the two.
        boxes: (M, 12) boxes of the left and of the right child of each node.
        nodes: (M, 4) of either child: a node, or -1 - first shape, and then how many.
        num_still: how many stand still.
        mover: (N - num_still,) which mover each of the others belongs to, ascending.
        radii: (K,) how far each mover reaches from its middle, metres.
        movers: path of each, T_world_mover.
        ground: what all stands on.
    """

    shapes: Array
    forms: Index
    kinds: Index
    albedos: NDArray[np.float32]
    things: Index
    is_ground: NDArray[np.bool_]
    boxes: Array
    nodes: Index
    num_still: int
    mover: Index
    radii: Array
    movers: tuple[Path, ...]
    ground: Ground

    def __len__(self) -> int:
        return len(self.shapes)

    def at(self, time: float) -> Array:
        """Return (N, 14) shapes in the world at a time in seconds."""
        return self.placed(self.motions(time)[0])

    def motions(self, time: float) -> tuple[Array, Array]:
        """Return T_world_mover (K, 4, 4) and velocities (K, 3) of the movers at a time."""
        now = np.array([time])
        found = [path.at(now) for path in self.movers]
        Ts = np.array([motion.Ts_world_body[0] for motion in found]).reshape(-1, 4, 4)
        return Ts, np.array([motion.v_world_body[0] for motion in found]).reshape(-1, 3)

    def placed(self, Ts_world_mover: Array) -> Array:
        """Return (N, 14) shapes in the world, with the movers at (K, 4, 4)."""
        if not self.movers:
            return self.shapes
        shapes = self.shapes.copy()
        part, Ts = shapes[self.num_still :], Ts_world_mover[self.mover]
        for first in (0, 4, 8):
            turned = np.einsum("nij,nj->ni", Ts[:, :3, :3], part[:, first : first + 3])
            part[:, first : first + 3] = turned
            part[:, first + 3] += (turned * Ts[:, :3, 3]).sum(axis=1)
        return shapes


class SolidsBuilder:
    """Collects shapes; everything random comes from one generator."""

    def __init__(self, rng: np.random.Generator, ground: Ground) -> None:
        self.rng = rng
        self.ground = ground
        self._rows: list[Array] = []
        self._low: list[Array] = []
        self._high: list[Array] = []
        self._facts: list[tuple[int, int, float, int, bool]] = []
        self._mover: list[int] = []
        self._paths: list[Path] = []
        self._things = 0

    def thing(self) -> int:
        """Return the number of a new thing: what is given it belongs together."""
        self._things += 1
        return self._things

    def mover(self, path: Path) -> int:
        """Add a moving object and return its number, to be given to `rectangle` or `box`."""
        self._paths.append(path)
        return len(self._paths) - 1

    def rectangle(
        self, corner: Array, u: Array, v: Array, size: tuple[float, float], kind: str,
        *, thing: int = 0, albedo: float = 0.0, mover: int = -1, is_ground: bool = False,
    ) -> None:  # fmt: skip
        """Add a rectangle, seen from both sides.

        Args:
            corner: (3,) metres.
            u: (3,) direction of a side, any length.
            v: (3,) direction of the other side, square to u.
            size: extent along u and v, metres.
            kind: one of `KINDS`.
            thing: number from `thing`; 0 for one of its own.
            albedo: share of the light that is thrown back; 0 for what is usual of the kind.
            mover: number from `mover`, or -1 if it stands still.
            is_ground: whether one could drive or walk on it, or it is the kerb between the two.
        """
        u, v = u / np.sqrt(u @ u), v / np.sqrt(v @ v)
        n = np.array(
            [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
        )
        row = np.empty(14)
        for first, side in ((0, n), (4, u), (8, v)):
            row[first : first + 3], row[first + 3] = side, side @ corner
        row[12:] = size
        a, b = u * size[0], v * size[1]
        ends = np.stack([corner, corner + a, corner + b, corner + a + b])
        facts = RECTANGLE, KINDS.index(kind), albedo, thing, is_ground
        self._add(row, ends.min(axis=0), ends.max(axis=0), facts, mover)

    def box(
        self, centre: Array, size: tuple[float, float, float], kind: str, *,
        axes: Array | None = None, thing: int = 0, albedo: float = 0.0, mover: int = -1,
        bottom: bool = False,
    ) -> None:  # fmt: skip
        """Add a box, all of it one thing; as `rectangle`.

        Args:
            centre: (3,) metres.
            size: extents along its axes, metres.
            kind: one of `KINDS`.
            axes: (3, 3) columns are its axes; default those of the world.
            thing: what it is a part of. albedo: as of a rectangle. mover: as of a rectangle.
            bottom: whether it has one.
        """
        axes = np.eye(3) if axes is None else axes
        thing, half = thing or self.thing(), 0.5 * np.array(size)
        for axis, normal, right, down in FACES if bottom else FACES[:-1]:
            a, b = float(np.abs(right) @ half), float(np.abs(down) @ half)
            corner = centre + axes @ (normal * half[axis] - right * a - down * b)
            self.rectangle(
                corner, axes @ right, axes @ down, (2 * a, 2 * b), kind,
                thing=thing, albedo=albedo, mover=mover,
            )  # fmt: skip

    def pole(
        self, foot: Array, radius: float, height: float, kind: str = "pole", *,
        thing: int = 0, albedo: float = 0.0,
    ) -> None:  # fmt: skip
        """Add an upright cylinder, open at its ends, that stands with its foot (3,) somewhere."""
        row = np.zeros(14)
        row[:5] = foot[0], foot[1], radius, foot[2], foot[2] + height
        low = np.array([foot[0] - radius, foot[1] - radius, foot[2]])
        high = np.array([foot[0] + radius, foot[1] + radius, foot[2] + height])
        self._add(row, low, high, (CYLINDER, KINDS.index(kind), albedo, thing, False), -1)

    def leaves(self, centre: Array, radius: float, free_m: float, thing: int = 0) -> None:
        """Add a ball of leaves into which beams go `free_m` metres in the mean."""
        row = np.zeros(14)
        row[:5] = *centre, radius, free_m
        facts = BALL, KINDS.index("leaves"), 0.0, thing, False
        self._add(row, centre - radius, centre + radius, facts, -1)

    def build(self) -> Solids:
        """Hang what stands still in a tree and freeze it all."""
        mover = np.array(self._mover, np.int64)
        still, moving = np.flatnonzero(mover < 0), np.flatnonzero(mover >= 0)
        moving = moving[np.argsort(mover[moving], kind="stable")]
        ends = np.stack([np.array(self._low), np.array(self._high)], axis=1).reshape(-1, 2, 3)
        tree = BoxTree.of(ends[still], by_area=True)
        boxes, nodes = _paired(tree)
        rows = np.concatenate([still[tree.order], moving])
        shapes = np.array(self._rows).reshape(-1, 14)[rows]
        forms, kinds, albedos, things, is_ground = (np.array(self._facts).reshape(-1, 5)[rows]).T
        usual = np.array([ALBEDO[name] for name in KINDS])
        kinds = kinds.astype(np.int64)
        return Solids(
            shapes, forms.astype(np.int64), kinds,
            np.where(albedos > 0, albedos, usual[kinds]).astype(np.float32),
            things.astype(np.int64), is_ground.astype(np.bool_), boxes, nodes,
            len(still), mover[moving], _radii(shapes[len(still) :], mover[moving], self._paths),
            tuple(self._paths), self.ground,
        )  # fmt: skip

    def _add(
        self, row: Array, low: Array, high: Array, facts: tuple[int, int, float, int, bool],
        mover: int,
    ) -> None:  # fmt: skip
        form, kind, albedo, thing, is_ground = facts
        self._rows.append(row)
        self._low.append(low)
        self._high.append(high)
        self._facts.append((form, kind, albedo, thing or self.thing(), is_ground))
        self._mover.append(mover)


def _radii(shapes: Array, mover: Index, movers: list[Path]) -> Array:
    """Return how far the rectangles (M, 14) of each mover reach from its origin."""
    radii = np.zeros(len(movers))
    for s, t in ((0, 0), (0, 1), (1, 0), (1, 1)):
        # n, u and v are square to each other: they know how far the corner is along each.
        far = shapes[:, [3, 7, 11]] + shapes[:, [12, 12, 13]] * [0, s, t]
        np.maximum.at(radii, mover, np.linalg.norm(far, axis=1))
    return radii


def _paired(tree: BoxTree) -> tuple[Array, Index]:
    """Return the inner nodes of a tree with the boxes and the names of both children."""
    inner = np.flatnonzero(tree.nodes[:, 0] >= 0)
    if not len(inner):  # a single leaf: beside it nothing, whose box no beam meets
        nothing = np.array([np.inf] * 3 + [-np.inf] * 3)
        first = np.array([[*tree.nodes[0], -1, 0]], np.int64)
        return np.concatenate([tree.boxes[0], nothing])[None], first
    number = np.full(len(tree.nodes), -1)
    number[inner] = np.arange(len(inner))
    boxes = np.concatenate([tree.boxes[tree.nodes[inner, side]] for side in (0, 1)], axis=1)
    nodes = np.empty((len(inner), 4), np.int64)
    for side in (0, 1):
        child = tree.nodes[inner, side]
        is_inner = tree.nodes[child, 0] >= 0
        nodes[:, 2 * side] = np.where(is_inner, number[child], tree.nodes[child, 0])
        nodes[:, 2 * side + 1] = np.where(is_inner, 0, tree.nodes[child, 1])
    return boxes, nodes
