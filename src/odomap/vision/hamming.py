"""Hamming distance of binary descriptors, in words of 64 bits, and searches by it.

The distance of two descriptors of 256 bits is the number of bits that differ,

    d(a, b) = Σ_k popcount(a_k xor b_k),   k = 1..4,

the four words counted by adding neighbouring bits, pairs and nibbles in parallel, a form that
compilers turn into the processor's own instruction. One distance takes some 2 ns.
The kernels here search circles, lines or everything; `matching` says what for.

Reference: Calonder, Lepetit, Strecha, Fua, "BRIEF: binary robust independent elementary features",
ECCV 2010; Warren, "Hacker's Delight", section 5-1.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = [
    "CELL_PX",
    "NO_DISTANCE",
    "as_words",
    "fill_cells",
    "hamming",
    "lowest_byte",
    "popcount",
    "search_all",
    "search_circles",
    "search_epipolar",
    "search_lines",
    "warm_up",
]

Words = NDArray[np.uint64]
Index = NDArray[np.int64]

NO_DISTANCE = 257
"""Distance to nothing: more bits than there are."""
CELL_PX = 16.0
"""Side of the cells of a grid of keypoints."""


def as_words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return (N, 32) uint8 descriptors as (N, 4) uint64, without a copy where possible."""
    whole = np.ascontiguousarray(descriptors, np.uint8).reshape(len(descriptors), 32)
    return np.require(whole.view(np.uint64), requirements=["C", "A"])


@kernel
def popcount(x: np.uint64) -> int:
    """How many bits of a word are set."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@kernel
def lowest_byte(word: np.uint64) -> int:
    """Index of the lowest byte that is not 0: zero bits below the lowest one, divided by 8.

    In memory it is the first, on processors that store words lowest byte first.
    """
    return popcount((word & (~word + np.uint64(1))) - np.uint64(1)) >> 3


@kernel
def hamming(a: Words, i: int, b: Words, j: int) -> int:
    """Σ_k popcount(a[i, k] xor b[j, k]) over the four words of two descriptors."""
    total = 0
    for k in range(4):
        total += popcount(a[i, k] ^ b[j, k])
    return total


@kernel
def _cells_around(at: float, radius: float, count: int) -> tuple[int, int]:
    """First and last cell, of so many in a row, that an interval touches."""
    first = int(min(max((at - radius) / CELL_PX, 0.0), count - 1.0))
    last = int(min(max((at + radius) / CELL_PX, 0.0), count - 1.0))
    return first, last


@kernel
def fill_cells(keypoints: NDArray[np.float32], cols: int, start: Index, order: Index) -> None:
    """Sort keypoints into cells of a grid, row by row; those outside go to the border's.

    order[start[c]:start[c + 1]] are the keypoints of cell c, ascending.
    """
    cells = len(start) - 1
    rows = cells // cols
    of = np.empty(len(keypoints), np.int64)
    for c in range(cells + 1):
        start[c] = 0
    for i in range(len(keypoints)):
        x, y = keypoints[i, 0] / CELL_PX, keypoints[i, 1] / CELL_PX
        col = int(min(x, cols - 1.0)) if x > 0.0 else 0
        row = int(min(y, rows - 1.0)) if y > 0.0 else 0
        of[i] = row * cols + col
        start[of[i] + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
    for i in range(len(keypoints) - 1, -1, -1):
        start[of[i] + 1] -= 1
        order[start[of[i] + 1]] = i
    for c in range(cells):
        start[c] = start[c + 1]
    start[cells] = len(keypoints)


@kernel
def search_circles(
    wanted: Words,
    guess: NDArray[np.float64],
    radius: NDArray[np.float64],
    lowest: Index,
    highest: Index,
    descriptors: Words,
    keypoints: NDArray[np.float32],
    levels: NDArray[np.uint8],
    start: Index,
    order: Index,
    cols: int,
    ratio: float,
    limit: int,
    matches: Index,
) -> None:
    """For each landmark the nearest descriptor in its circle, if clearly the nearest."""
    rows = (len(start) - 1) // cols
    owner = np.full(len(descriptors), -1, np.int64)
    distances = np.full(len(descriptors), NO_DISTANCE, np.int64)
    for m in range(len(wanted)):
        x, y, r = guess[m, 0], guess[m, 1], radius[m]
        if not (np.isfinite(x) and np.isfinite(y) and r >= 0.0):
            continue
        best, second, index, rival = NO_DISTANCE, NO_DISTANCE, -1, -1
        first_col, last_col = _cells_around(x, r, cols)
        first_row, last_row = _cells_around(y, r, rows)
        for row in range(first_row, last_row + 1):
            for k in range(start[row * cols + first_col], start[row * cols + last_col + 1]):
                n = order[k]
                dx, dy = keypoints[n, 0] - x, keypoints[n, 1] - y
                if not (dx * dx + dy * dy <= r * r):
                    continue
                if levels[n] < lowest[m] or levels[n] > highest[m]:
                    continue
                d = hamming(wanted, m, descriptors, n)
                if d < best or (d == best and n < index):
                    best, second, index, rival = d, best, n, index
                elif d < second or (d == second and n < rival):
                    second, rival = d, n
        if index < 0 or best > limit or best >= distances[index]:
            continue
        if rival >= 0 and levels[rival] == levels[index] and best >= ratio * second:
            continue
        if owner[index] >= 0:
            matches[owner[index]] = -1
        matches[m], owner[index], distances[index] = index, m, best


@kernel
def search_lines(
    first: Words,
    lines: NDArray[np.float32],
    second: Words,
    plane: NDArray[np.float32],
    limits: NDArray[np.float32],
    levels: NDArray[np.uint8],
    ratio: float,
    limit: int,
    matches: Index,
) -> None:
    """For each line the nearest descriptor of the points that pass the χ² test; both ways best."""
    number = len(second)
    near = np.zeros((number + 7) // 8 * 8, np.uint8)
    words = near.view(np.uint64)
    owner = np.full(number, -1, np.int64)
    distances = np.full(number, NO_DISTANCE, np.int64)
    us, vs = plane[0], plane[1]
    for i in range(len(first)):
        a, b, c = lines[i, 0], lines[i, 1], lines[i, 2]
        norm = a * a + b * b
        for j in range(number):
            off = a * us[j] + b * vs[j] + c
            near[j] = off * off <= limits[j] * norm
        best, second_best, index, rival = NO_DISTANCE, NO_DISTANCE, -1, -1
        for word in range(len(words)):
            rest = words[word]
            while rest != 0:
                byte = lowest_byte(rest)
                rest &= ~(np.uint64(255) << np.uint64(8 * byte))
                j = 8 * word + byte
                d = hamming(first, i, second, j)
                if d < distances[j]:
                    distances[j], owner[j] = d, i
                if d < best:
                    best, second_best, index, rival = d, best, j, index
                elif d < second_best:
                    second_best, rival = d, j
        if index < 0 or best > limit or not norm > 0.0:
            continue
        if rival >= 0 and levels[rival] == levels[index] and best >= ratio * second_best:
            continue
        matches[i] = index
    for i in range(len(first)):
        if matches[i] >= 0 and owner[matches[i]] != i:
            matches[i] = -1


@kernel
def _epipolar_lines(
    bearings: NDArray[np.float64], rows: Index, T: NDArray[np.float64], lines: NDArray[np.float32]
) -> None:
    """lines[i] = t x (R b_i), of some bearings."""
    for i in range(len(rows)):
        b = bearings[rows[i]]
        x = T[0, 0] * b[0] + T[0, 1] * b[1] + T[0, 2] * b[2]
        y = T[1, 0] * b[0] + T[1, 1] * b[1] + T[1, 2] * b[2]
        z = T[2, 0] * b[0] + T[2, 1] * b[1] + T[2, 2] * b[2]
        lines[i, 0] = T[1, 3] * z - T[2, 3] * y
        lines[i, 1] = T[2, 3] * x - T[0, 3] * z
        lines[i, 2] = T[0, 3] * y - T[1, 3] * x


@kernel
def _rows_of(words: Words, rows: Index, chosen: Words) -> None:
    """chosen[i] = words[rows[i]]."""
    for i in range(len(rows)):
        for k in range(4):
            chosen[i, k] = words[rows[i], k]


@kernel
def search_epipolar(
    first: Words,
    bearings: NDArray[np.float64],
    usable: NDArray[np.bool_],
    second: Words,
    others: NDArray[np.float64],
    levels: NDArray[np.uint8],
    free: NDArray[np.bool_],
    T: NDArray[np.float64],
    variance: NDArray[np.float64],
    gates: NDArray[np.float64],
    ratio: float,
    limit: int,
    pairs: Index,
) -> int:
    """`search_lines` between the usable features of two views; return how many pairs there are.

    T leads from the first camera to the second, variance is that of each level on the plane z = 1,
    gates are that of χ² and how many deviations the epipole is kept away from.
    """
    rows, there = np.flatnonzero(usable), np.flatnonzero(free)
    n = len(there)
    plane, limits, size = (
        np.empty((2, n), np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.uint8),
    )
    ex, ey = T[0, 3] / T[2, 3], T[1, 3] / T[2, 3]
    for j in range(n):
        b = others[there[j]]
        size[j] = levels[there[j]]
        spread = variance[size[j]]
        x, y = b[0] / b[2], b[1] / b[2]
        # Of a sideways motion the epipole is at infinity: nothing is near to it.
        apart = (x - ex) ** 2 + (y - ey) ** 2
        if not b[2] > 0.0 or apart < gates[1] ** 2 * spread:  # what is not in front fits no line
            x, y = np.nan, np.nan
        plane[0, j], plane[1, j], limits[j] = x, y, gates[0] * spread
    lines, matches = np.empty((len(rows), 3), np.float32), np.full(len(rows), -1, np.int64)
    _epipolar_lines(bearings, rows, T, lines)
    here, near = np.empty((len(rows), 4), np.uint64), np.empty((n, 4), np.uint64)
    _rows_of(first, rows, here)
    _rows_of(second, there, near)
    search_lines(here, lines, near, plane, limits, size, ratio, limit, matches)
    found = 0
    for i in range(len(rows)):
        if matches[i] >= 0:
            pairs[found, 0], pairs[found, 1] = rows[i], there[matches[i]]
            found += 1
    return found


@kernel
def search_all(first: Words, second: Words, index: Index, best: Index, other: Index) -> None:
    """min_j d(i, j), where it is, and the second smallest."""
    for i in range(len(first)):
        for j in range(len(second)):
            d = hamming(first, i, second, j)
            if d < best[i]:
                best[i], other[i], index[i] = d, best[i], j
            elif d < other[i]:
                other[i] = d


def warm_up() -> None:
    """Compile the kernels of this module."""
    words = as_words(np.zeros((1, 32), np.uint8))
    hamming(words, 0, words, 0)
    fill_cells(np.zeros((1, 2), np.float32), 1, np.zeros(2, np.int64), np.zeros(1, np.int64))
