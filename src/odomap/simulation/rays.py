"""Rays against rectangles: the nearest hit, through a tree of bounding boxes.

A ray o + t d meets the plane of a rectangle with corner c and unit sides u, v at

    t = n·(c - o) / n·d,   n = u × v,   and hits it where 0 <= u·(x - c) <= a, 0 <= v·(x - c) <= b

The rectangles hang in a binary tree split at the median of their centres along the longest axis; a
ray visits the boxes it enters before its best hit so far, nearer child first. LiDAR beams, shadows
and the sky light use it; cameras, whose rays are a grid, are rasterised instead (`render`).

Trees for many more rays are split by surface area: a ray that enters a box enters a part of it in
proportion to its area A, so that the split with the least A₁ n₁ + A₂ n₂ is the quickest. It takes a
few times as long to build, and half as many boxes are entered.

Cost: O(log N) per ray, O(N log N) to build.

Papers: T. L. Kay and J. T. Kajiya, "Ray tracing complex scenes", SIGGRAPH 1986; J. D. MacDonald, K.
S. Booth, "Heuristics for ray tracing using space subdivision", The Visual Computer 6(3), 1990.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["BoxTree", "cast_kernel", "warm_up"]

Array = NDArray[np.float64]
LEAF = 4
DEPTH = 64


@dataclass(frozen=True)
class BoxTree:
    """Bounding boxes over rectangles.

    Attributes:
        boxes: (M, 6) lowest and highest corner of each node.
        nodes: (M, 2) int64: inner nodes hold their children, leaves -1 - first and a count.
        order: (N,) int64 rectangles in the order the leaves list them.
    """

    boxes: Array
    nodes: NDArray[np.int64]
    order: NDArray[np.int64]

    @classmethod
    def of(cls, corners: Array, *, by_area: bool = False) -> "BoxTree":
        """Build over rectangles given by their corners (N, 4, 3), or by any points they span.

        Args:
            corners: (N, K, 3) metres.
            by_area: whether to split by surface area instead of at the median.
        """
        low, high = corners.min(1) - 1e-9, corners.max(1) + 1e-9
        centre = 0.5 * (low + high)
        boxes: list[Array] = []
        nodes: list[list[int]] = []
        order: list[int] = []
        todo = [(np.arange(len(corners)), -1, 0)]
        while todo:
            members, parent, side = todo.pop()
            if parent >= 0:
                nodes[parent][side] = len(nodes)
            lo = low[members].min(0) if len(members) else np.zeros(3)
            hi = high[members].max(0) if len(members) else np.zeros(3)
            boxes.append(np.concatenate([lo, hi]))
            if len(members) <= LEAF:
                nodes.append([-1 - len(order), len(members)])
                order.extend(members.tolist())
                continue
            if by_area:
                ranked, half = _by_area(members, low, high)
            else:
                axis = int(np.argmax(np.ptp(centre[members], axis=0)))
                ranked = members[np.argsort(centre[members, axis], kind="stable")]
                half = len(ranked) // 2
            todo += [(ranked[half:], len(nodes), 1), (ranked[:half], len(nodes), 0)]
            nodes.append([0, 0])
        return cls(np.array(boxes), np.array(nodes, np.int64), np.array(order, np.int64))


def _by_area(members: NDArray[np.int64], low: Array, high: Array) -> tuple[NDArray[np.int64], int]:
    """Return members in order along an axis, and how many of them go first: least A₁ n₁ + A₂ n₂."""
    least, best, half = np.inf, members, len(members) // 2
    count = np.arange(1, len(members))
    for axis in range(3):
        ranked = members[np.argsort(low[members, axis] + high[members, axis], kind="stable")]
        lo, hi = low[ranked], high[ranked]
        first = np.maximum.accumulate(hi) - np.minimum.accumulate(lo)
        last = np.maximum.accumulate(hi[::-1]) - np.minimum.accumulate(lo[::-1])
        areas = [
            e[:, 0] * e[:, 1] + e[:, 1] * e[:, 2] + e[:, 2] * e[:, 0]
            for e in (first[:-1], last[::-1][1:])
        ]
        cost = areas[0] * count + areas[1] * count[::-1]
        at = int(cost.argmin())
        if cost[at] < least:
            least, best, half = float(cost[at]), ranked, at + 1
    return best, half


@kernel
def _meet(frame: Array, face: Array, o: Array, d: Array, shift: Array, best: float) -> float:
    """Return t = n·(c + shift - o) / n·d if the rectangle is hit at 1e-6 < t < best, else best."""
    ux, uy, uz, vx, vy, vz = frame[3], frame[4], frame[5], frame[6], frame[7], frame[8]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    cx = frame[0] + shift[0] - o[0]
    cy = frame[1] + shift[1] - o[1]
    cz = frame[2] + shift[2] - o[2]
    t: float = (nx * cx + ny * cy + nz * cz) / (nx * d[0] + ny * d[1] + nz * d[2])
    if not (t > 1e-6 and t < best):
        return best
    px, py, pz = t * d[0] - cx, t * d[1] - cy, t * d[2] - cz
    s = ux * px + uy * py + uz * pz
    if s < 0.0 or s > face[0]:
        return best
    s = vx * px + vy * py + vz * pz
    if s < 0.0 or s > face[1]:
        return best
    return t


@kernel
def _enter(box: Array, o: Array, d: Array, best: float) -> float:
    """Return where the ray enters the box (slab test), or a value >= best where it does not."""
    near, far = 0.0, best
    for k in range(3):
        a, b = (box[k] - o[k]) / d[k], (box[k + 3] - o[k]) / d[k]
        if a > b:
            a, b = b, a
        if a > near:
            near = a
        if b < far:
            far = b
    if near <= far:
        return near
    return best


@kernel
def cast_kernel(
    origins: Array,
    directions: Array,
    times: Array,
    farthest: float,
    frames: Array,
    faces: Array,
    boxes: Array,
    nodes: NDArray[np.int64],
    order: NDArray[np.int64],
    movers: NDArray[np.int64],
    velocities: Array,
    distance: Array,
    hit: NDArray[np.int64],
) -> None:
    """Write the nearest t > 0 of every ray o + t d, t <= farthest, and whom it hits (-1: nobody).

    Rectangles in `movers` are outside the tree and shifted by velocity * time of the ray.
    """
    stack = np.empty(DEPTH, np.int64)
    still = np.zeros(3)
    shift = np.zeros(3)
    for r in range(origins.shape[0]):
        o, d = origins[r], directions[r]
        best, who = farthest, -1
        stack[0] = 0
        top = 1
        while top > 0:
            top -= 1
            node = stack[top]
            if _enter(boxes[node], o, d, best) >= best:
                continue
            if nodes[node, 0] < 0:
                first = -1 - nodes[node, 0]
                for k in range(first, first + nodes[node, 1]):
                    t = _meet(frames[order[k]], faces[order[k]], o, d, still, best)
                    if t < best:
                        best, who = t, order[k]
                continue
            a, b = nodes[node, 0], nodes[node, 1]
            if _enter(boxes[a], o, d, best) < _enter(boxes[b], o, d, best):
                a, b = b, a
            stack[top] = a
            stack[top + 1] = b
            top += 2
        for k in range(movers.shape[0]):
            for axis in range(3):
                shift[axis] = velocities[k, axis] * times[r]
            t = _meet(frames[movers[k]], faces[movers[k]], o, d, shift, best)
            if t < best:
                best, who = t, movers[k]
        distance[r] = best
        hit[r] = who


def warm_up() -> None:
    """Compile the kernels."""
    frames = np.array([[0.0, 0, 1, 1, 0, 0, 0, 1, 0]])
    corners = np.array([[[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]])
    tree = BoxTree.of(corners)
    cast_kernel(
        np.full((1, 3), 0.5),
        np.array([[1e-9, 1e-9, 1.0]]),
        np.zeros(1),
        10.0,
        frames,
        np.ones((1, 8)),
        tree.boxes,
        tree.nodes,
        tree.order,
        np.zeros(0, np.int64),
        np.zeros((0, 3)),
        np.empty(1),
        np.empty(1, np.int64),
    )
