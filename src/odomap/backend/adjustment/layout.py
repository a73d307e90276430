"""Which unknown stands where in the normal equations of a bundle adjustment.

What is left when the points are eliminated is a symmetric matrix of blocks: one per view that
moves (6 rows), one per lens that is free (one row per number). A lens that no two views share is
put beside its view's pose, a block of 6 + P rows, as in BAL's 9. Scalars that are held (the
gauge, numbers of a lens that are known) keep their rows, with the identity in them.

A point touches few blocks; each touch is an *incidence*, with a 3-row slab V that elimination
leaves there. Two blocks share a block of the reduced matrix if some point touches both.
Observations come sorted by point, incidences of a point by block, so that every sum has one order.
O(N).

Reference: B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999, section 6.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.problem import Adjustment, num_parameters
from odomap.backend.sparse.blocks import MAX_BLOCK
from odomap.kernels import kernel

__all__ = ["Blocks", "Incidences", "Layout", "Seen", "count_free", "lay_out", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

POSE = 6


class Blocks(NamedTuple):
    """Blocks of the reduced system.

    pose (K,) the block of each view and lens (L,) of each lens, -1 if held; lens_row (L,) where in
    its block a lens begins; size (B,), row (B + 1,) of the first scalar, at (B + 1,) of the first
    number of each diagonal block; is_held (n,) scalars.
    """

    pose: Index
    lens: Index
    lens_row: Index
    size: Index
    row: Index
    at: Index
    is_held: Mask


class Seen(NamedTuple):
    """Observations sorted by point: those of point m are start[m] to start[m + 1].

    of_view (N,), pixels (N, 2), weight (N,), the incidences of the pose and of the lens, -1 for
    none, inverse_depth (N,) and depth_weight (N,), zero where depth was not measured.
    """

    start: Index
    of_view: Index
    pixels: Array
    weight: Array
    pose: Index
    lens: Index
    inverse_depth: Array
    depth_weight: Array


class Incidences(NamedTuple):
    """Blocks that points touch: those of point m are start[m] to start[m + 1], sorted by block.

    block (I,), point (I,), at (I + 1,) where the slab V (3, size) of each begins; by_block (I,)
    incidences sorted by block, those of block b at block_start[b] to block_start[b + 1].
    """

    start: Index
    block: Index
    point: Index
    at: Index
    by_block: Index
    block_start: Index


@dataclass(frozen=True)
class Layout:
    """All of it.

    order (N,) and point_order (M,) say which observations and points of the problem those laid out
    are: points that the same views see are near each other.
    """

    order: Index
    point_order: Index
    seen: Seen
    blocks: Blocks
    incidences: Incidences
    is_free_point: Mask
    is_joined: bool


def lay_out(problem: Adjustment, is_held_view: Mask | None = None) -> Layout:
    """Lay a problem out.

    Args:
        problem: what is to be solved.
        is_held_view: (K, 6) bool, tangent coordinates of views to hold besides those it holds.

    Returns:
        Where everything stands.
    """
    blocks, is_joined = _blocks(problem, is_held_view)
    n, m = problem.num_observations, problem.num_points
    point_order, rank = _by_first_view(problem)
    by_view, _ = _sorted_by(problem.view, problem.num_views)
    by_point, start = _sorted_by(rank[problem.point[by_view]], m)
    order = by_view[by_point]
    view = problem.view[order]
    is_free_point = ~problem.is_fixed_point[point_order] & (np.diff(start) > 0)
    pixels, weights, (pose, lens) = problem.pixels[order], problem.weights[order], _no_indices(n, n)
    seen = Seen(start, view, pixels, weights, pose, lens, *_depths(problem, order))
    touched, point = _no_indices(2 * n, 2 * n)
    first = np.zeros(m + 1, np.int64)
    marks = np.full((2, len(blocks.size)), -1)
    count = _touch(seen, blocks, problem.lens, is_free_point, marks, first, touched, point)
    touched, point = touched[:count].copy(), point[:count].copy()
    by_block, block_start = _sorted_by(touched, len(blocks.size))
    slabs = _starts(3 * blocks.size[touched])
    incidences = Incidences(first, touched, point, slabs, by_block, block_start)
    return Layout(order, point_order, seen, blocks, incidences, is_free_point, is_joined)


def count_free(problem: Adjustment) -> int:
    """Return how many scalars of views and lenses are free."""
    blocks, _ = _blocks(problem, None)
    return int(np.count_nonzero(~blocks.is_held))


def _depths(problem: Adjustment, order: Index) -> tuple[Array, Array]:
    """Return measured inverse depths (N,) and their weights, zero where there is none."""
    if problem.inverse_depths is None or problem.depth_weights is None:
        return np.zeros(len(order)), np.zeros(len(order))
    has_depth = problem.has_depth[order]
    depths, deep = problem.inverse_depths[order], problem.depth_weights[order]
    return np.where(has_depth, depths, 0.0), np.where(has_depth, deep, 0.0)


def _by_first_view(problem: Adjustment) -> tuple[Index, Index]:
    """Return points sorted by the first view that saw them, and the place of each."""
    first = np.full(problem.num_points, problem.num_views - 1)
    _lowest(problem.point, problem.view, first)
    order, _ = _sorted_by(first, problem.num_views)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return order, rank


def _blocks(problem: Adjustment, is_held_view: Mask | None) -> tuple[Blocks, bool]:
    """Number the blocks: views first, then lenses that have one to themselves."""
    moves = _moving(problem, is_held_view)
    is_still = ~moves
    free, width = _free_numbers(problem)
    is_free, lens = np.asarray(free.any(axis=1)), problem.lens
    is_shared = np.bincount(lens, minlength=len(free)) > 1
    is_joined = bool(
        is_free.any()
        and not (is_free & is_shared).any()
        and POSE + width[is_free].max() <= MAX_BLOCK
    )
    beside = np.asarray(is_free[lens] & is_joined)
    has_block = np.asarray(moves.any(axis=1) | beside)
    pose = np.where(has_block, np.cumsum(has_block) - 1, -1)
    size = (POSE + np.where(beside, width[lens], 0))[has_block]
    of_lens = np.full(len(free), -1)
    if is_joined:
        of_lens[lens[beside]] = pose[beside]
    else:
        of_lens[is_free] = len(size) + np.arange(int(is_free.sum()))
        size = np.concatenate([size, width[is_free]])
    row = _starts(size)
    lens_row = np.full(len(free), POSE if is_joined else 0)
    is_held = np.ones(row[-1], np.bool_)
    for i in np.flatnonzero(has_block):
        is_held[row[pose[i]] : row[pose[i]] + POSE] = is_still[i]
    for i in np.flatnonzero(is_free):
        at = row[of_lens[i]] + lens_row[i]
        is_held[at : at + width[i]] = ~free[i, : width[i]]
    return Blocks(pose, of_lens, lens_row, size, row, _starts(size * size), is_held), is_joined


def _moving(problem: Adjustment, is_held_view: Mask | None) -> Mask:
    """Return (K, 6) which coordinates of the views move: not those of a view that sees nothing."""
    sees = np.bincount(problem.view, minlength=problem.num_views) > 0
    moves: Mask = np.repeat((sees & ~problem.is_fixed_view)[:, None], POSE, axis=1)
    return moves if is_held_view is None else np.asarray(moves & ~is_held_view)


def _free_numbers(problem: Adjustment) -> tuple[Mask, Index]:
    """Return (L, P) which numbers of the lenses move, and (L,) how many numbers each has."""
    columns = problem.intrinsics.shape[1]
    width = np.array([num_parameters(name, columns) for name in problem.models], np.int64)
    looks = np.bincount(problem.lens[problem.view], minlength=len(width)) > 0
    free = problem.is_free_intrinsic & (np.arange(columns) < width[:, None]) & looks[:, None]
    return np.asarray(free), width


def _starts(lengths: Index) -> Index:
    """Return where pieces of these lengths begin, and after them where the last one ends."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths, dtype=np.int64)])


def _no_indices(*lengths: int) -> tuple[Index, ...]:
    return tuple(np.full(length, -1) for length in lengths)


def _sorted_by(key: Index, count: int) -> tuple[Index, Index]:
    """Return the stable order of keys below `count`, and where each key's items begin in it."""
    order, start = np.empty(len(key), np.int64), np.zeros(count + 1, np.int64)
    _counting_sort(key, order, start)
    return order, start


@kernel
def _counting_sort(key: Index, order: Index, start: Index) -> None:
    """start[k + 1] - start[k] = how many keys are k; order (N,) lists them, k = 0 first."""
    for i in range(len(key)):
        start[key[i] + 1] += 1
    for k in range(1, len(start)):
        start[k] += start[k - 1]
    for i in range(len(key)):
        order[start[key[i]]] = i
        start[key[i]] += 1
    for k in range(len(start) - 1, 0, -1):
        start[k] = start[k - 1]
    start[0] = 0


@kernel
def _lowest(point: Index, view: Index, first: Index) -> None:
    """first[m] = the lowest view that saw point m."""
    for o in range(len(point)):
        first[point[o]] = min(first[point[o]], view[o])


@kernel
def _touch(
    seen: Seen,
    blocks: Blocks,
    lens: Index,
    is_free_point: Mask,
    marks: Index,
    first: Index,
    touched: Index,
    point: Index,
) -> int:
    """List the blocks each point touches, in order, and write which of them each sight touches.

    marks (2, B): the last point that touched a block, and as which incidence.
    """
    count = 0
    for m in range(len(is_free_point)):
        first[m] = count
        if not is_free_point[m]:
            continue
        # Poses first, which are in order as the sights are; then lenses, of higher numbers.
        for is_lens in range(2):
            begin = count
            for o in range(seen.start[m], seen.start[m + 1]):
                i = seen.of_view[o]
                b = blocks.lens[lens[i]] if is_lens else blocks.pose[i]
                if b >= 0 and marks[0, b] != m:
                    marks[0, b] = m
                    at = count
                    while at > begin and touched[at - 1] > b:
                        touched[at] = touched[at - 1]
                        at -= 1
                    touched[at], point[count] = b, m
                    count += 1
            for at in range(begin, count):
                marks[1, touched[at]] = at
        for o in range(seen.start[m], seen.start[m + 1]):
            b, c = blocks.pose[seen.of_view[o]], blocks.lens[lens[seen.of_view[o]]]
            seen.pose[o] = marks[1, b] if b >= 0 else -1
            seen.lens[o] = marks[1, c] if c >= 0 else -1
    first[len(is_free_point)] = count
    return count


def warm_up() -> None:
    """Compile the kernels of this module."""
    T, point, once = np.tile(np.eye(4), (2, 1, 1)), np.array([[0.0, 0, 1]]), np.zeros(2, np.int64)
    lay_out(Adjustment(T, point, np.arange(2), once, np.zeros((2, 2)), np.ones((1, 4))))
