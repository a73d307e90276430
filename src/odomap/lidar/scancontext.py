"""Scan Context: what a place looks like from above, whichever way the LiDAR was turned.

A sweep is seen from above in rings and sectors around the sensor; each bin holds the height of the
highest point in it, which a wall keeps from near and from far, however many points it gets,

    S[r, s] = max z  of points with  ⌊R |p_xy| / reach⌋ = r,  ⌊S (atan2(y, x) + π) / 2π⌋ = s.

Turning the sensor shifts the columns. Two places are compared at every shift n, by the mean cosine
of columns that are in both; the best shift says by how much one is turned in the other,

    d(A, B) = min over n of  1 - mean over s of  a_s · b_(s+n),      a_s = A_s / |A_s|.

The paper finds the few that are compared by how full their rings are. Here the key is the amplitude
of each ring's spectrum, which a shift leaves as it is as well: since Σ_s a_s · b_(s+n) is a sum of
products of spectra, with phases, no shift gets above the product of the two keys. Of places beside
each other it brings up nine in ten where that of the paper brought up two.

Whoever drives on the other side of a road sees all of it shifted. So a place is looked for as it
would look from some metres to either side, too (`beside`), which needs no more room in the index.

Cost: 60 ns a point for a description, 5 µs for a comparison; the index is asked by one product.

Reference: G. Kim, A. Kim, "Scan Context: egocentric spatial descriptor for place recognition within
3D point cloud map", IROS 2018; copies to the sides: G. Kim, S. Choi, A. Kim, T-RO 38(3), 2022.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["Alike", "Context", "Contexts", "Layout", "compare", "describe", "leveled"]

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]

LOWEST = 0.05
"""Share of the points below which heights begin: a few lie below the ground by mistake."""
BELOW = 0.3
"""How far below those heights begin, metres: no bin with points in it is empty."""
FULL = 1e-3
"""Least height of a bin with points in it."""
COMMON = 0.5
"""Least share of the columns of the fuller of two places that counts as common to both."""


@dataclass(frozen=True)
class Layout:
    """How the world around a sensor is cut into bins.

    Attributes:
        rings: around it, of the same width.
        sectors: in a turn.
        reach: how far the outermost ring goes, metres.
    """

    rings: int = 20
    sectors: int = 36
    reach: float = 60.0


@dataclass(frozen=True, eq=False)
class Context:
    """How a place looks.

    Attributes:
        columns: (rings, sectors) float32, each column of length 1, or 0 where nothing was seen.
        key: (rings * (sectors // 2 + 1),) float32 that turning leaves as it is.
        beside: how far to the left of the sensor it is that it looks so, metres.
    """

    columns: Single
    key: Single
    beside: float = 0.0


@dataclass(frozen=True)
class Alike:
    """A place that looks like another.

    Attributes:
        id: of the one that was entered.
        distance: 0 for the same, 1 for nothing in common.
        yaw: by how much what was asked for is turned in it about z, radians.
        beside: how far to the left of the sensor asked for the two coincide, metres.
    """

    id: int
    distance: float
    yaw: float
    beside: float

    @property
    def T_place_sensor(self) -> Array:
        """(4, 4) where the sensor seems to be, both level."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        T = np.eye(4)
        T[:2, :2] = [[c, -s], [s, c]]
        T[:2, 3] = s * self.beside, -c * self.beside
        return T


def leveled(up: Array) -> Array:
    """Return R (3, 3) that turns a direction (3,) to +z by the shortest way."""
    u = np.asarray(up, np.float64) / np.linalg.norm(up)
    x, y, z = u
    if z < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    f = 1.0 / (1.0 + z)
    return np.array([
        [1.0 - f * x * x, -f * x * y, -x],
        [-f * x * y, 1.0 - f * y * y, -y],
        [x, y, z],
    ])  # fmt: skip


def describe(points: Array, layout: Layout, beside: float = 0.0) -> Context:
    """Describe what a sensor saw.

    Args:
        points: (N, 3) seen from it, z up (`leveled`).
        layout: of the bins.
        beside: describe it as from so far to the left of the sensor, metres.
    """
    points = np.ascontiguousarray(points, np.float64)
    heights = np.zeros((layout.rings, layout.sectors), np.float32)
    if len(points):
        lowest = int(LOWEST * len(points))
        floor = float(np.partition(points[:, 2], lowest)[lowest]) - BELOW
        _highest(points, beside, layout.reach, floor, heights)
    length = np.linalg.norm(heights, axis=0)
    columns = np.asarray(heights / np.where(length > 0.0, length, 1.0), np.float32)
    spectrum = np.abs(np.fft.rfft(columns, axis=1))
    spectrum[:, 1 : (layout.sectors + 1) // 2] *= np.sqrt(2.0)  # those that come as pairs
    key = np.asarray(spectrum.ravel() / np.sqrt(layout.sectors), np.float32)
    return Context(columns, key, beside)


def compare(one: Context, other: Context) -> tuple[float, float]:
    """Compare two places at every turn.

    Returns:
        Their distance, 0 to 1, and by how much the one is turned in the other about z, radians.
    """
    found = np.empty((1, 2))
    _compare(one.columns, other.columns[None], np.zeros(1, np.int64), found)
    return float(found[0, 0]), _yaw(found[0, 1], one.columns.shape[1])


class Contexts:
    """Places that were described, to be found again.

    Args:
        layout: of their bins.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        width = layout.rings * (layout.sectors // 2 + 1)
        self._columns = np.zeros((0, layout.rings, layout.sectors), np.float32)
        self._keys, self._ids = np.zeros((0, width), np.float32), np.zeros(0, np.int64)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def ids(self) -> Index:
        """(N,) of those entered, in the order they came."""
        return self._ids[: self._count]

    def enter(self, id: int, context: Context) -> None:
        """Enter a place."""
        n = self._count
        if n == len(self._ids):  # room for half as many again
            more = n // 2 + 16
            self._columns, self._keys, self._ids = (
                np.concatenate([old, np.zeros((more, *old.shape[1:]), old.dtype)])
                for old in (self._columns, self._keys, self._ids)
            )
        self._columns[n], self._keys[n], self._ids[n] = context.columns, context.key, id
        self._count += 1

    def keep(self, ids: Index) -> None:
        """Forget all places but those of some ids."""
        rows = np.flatnonzero(np.isin(self.ids, ids))
        if len(rows) < self._count:
            self._columns, self._keys = self._columns[rows], self._keys[rows]
            self._ids, self._count = self._ids[rows], len(rows)

    def search(
        self, looks: Sequence[Context], allowed: Index | None = None, most: int = 40
    ) -> list[Alike]:
        """Find the places that look like one.

        Args:
            looks: how it looks, from where the sensor is and from beside.
            allowed: (n,) ids among which to search; all by default.
            most: places that are compared with each look.

        Returns:
            The places compared, each by the look that is most like it, most alike first.
        """
        rows = (
            np.arange(self._count) if allowed is None else np.isin(self.ids, allowed).nonzero()[0]
        )
        best: dict[int, Alike] = {}
        keys = self._keys[rows]
        for look in looks if len(rows) else ():
            likely = keys @ look.key
            chosen = np.argsort(-likely, kind="stable")[:most]
            found = np.empty((len(chosen), 2))
            _compare(look.columns, self._columns, rows[chosen], found)
            for row, (distance, shift) in zip(rows[chosen].tolist(), found.tolist(), strict=True):
                id = int(self._ids[row])
                if id not in best or distance < best[id].distance:
                    yaw = _yaw(shift, self.layout.sectors)
                    best[id] = Alike(id, distance, yaw, look.beside)
        return sorted(best.values(), key=lambda alike: (alike.distance, alike.id))


def _yaw(shift: float, sectors: int) -> float:
    """Return the turn of a shift of columns, -π to π."""
    return float((shift / sectors * 2.0 * np.pi + np.pi) % (2.0 * np.pi) - np.pi)


@kernel
def _highest(points: Array, beside: float, reach: float, floor: float, out: Single) -> None:
    """out[r, s] = max (z - floor), at least `FULL`, of points in a bin seen from (0, beside)."""
    rings, sectors = out.shape
    for n in range(points.shape[0]):
        x, y = points[n, 0], points[n, 1] - beside
        ring = int(np.sqrt(x * x + y * y) / reach * rings)
        if ring >= rings:
            continue
        sector = int((np.arctan2(y, x) + np.pi) / (2.0 * np.pi) * sectors)
        sector = min(sector, sectors - 1)
        height = np.float32(max(points[n, 2] - floor, FULL))
        if height > out[ring, sector]:
            out[ring, sector] = height


@kernel
def _compare(one: Single, others: Single, rows: Index, found: Array) -> None:
    """found[i] = (d, n) of a place and another: 1 - mean over s of a_s · b_(s+n), at its least."""
    rings, sectors = one.shape
    products = np.empty((sectors, sectors), np.float32)
    seen, known = np.empty(sectors, np.bool_), np.empty(sectors, np.bool_)
    for s in range(sectors):
        seen[s] = np.any(one[:, s] > 0.0)
    for i in range(rows.shape[0]):
        other = others[rows[i]]
        for s in range(sectors):
            known[s] = np.any(other[:, s] > 0.0)
            for c in range(sectors):
                products[s, c] = 0.0
        for s in range(sectors):
            for r in range(rings):
                a = one[r, s]
                if a != 0.0:
                    for c in range(sectors):
                        products[s, c] += a * other[r, c]
        least = COMMON * max(float(np.sum(seen)), float(np.sum(known)), 1.0)
        found[i, 0], found[i, 1] = 1.0, 0.0
        for n in range(sectors):
            total, count = 0.0, 0
            for s in range(sectors):
                c = s + n if s + n < sectors else s + n - sectors
                if seen[s] and known[c]:
                    total += products[s, c]
                    count += 1
            distance = 1.0 - total / max(float(count), least)
            if distance < found[i, 0]:
                found[i, 0], found[i, 1] = distance, n


def warm_up() -> None:
    """Compile the kernels of this file."""
    look = describe(np.ones((1, 3)), Layout(2, 4, 10.0))
    compare(look, look)
