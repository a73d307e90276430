"""Global alignment: candidates for the motion between two clouds, from no guess at all.

In space: descriptors (`descriptors`) say which points may be the same. Three such pairs give a
motion in closed form, if their distances agree in both clouds; of tens of thousands of samples,
those that most other pairs agree with are candidates.

In the plane: for each heading, as fine as moves the farthest point by a cell, the source's points
are correlated with the target's on a grid, at all shifts at once by the Fourier transform,

    score(s) = Σ_p target(R(θ) p + s) = F⁻¹( F(target) · conj F(source) )

which no local maximum can mislead. The highest of all are candidates.

Candidates are aligned and judged by `registration`: the one after which most points meet is it, and
where another meets as many, that is said. Samples come from a seed.

Cost: a quarter of a second for 6,000 points in space, 0.1 s for 400 in the plane.

Reference: R. B. Rusu, N. Blodow, M. Beetz, "Fast point feature histograms (FPFH) for 3D
registration", ICRA 2009; E. B. Olson, "Real-time correlative scan matching", ICRA 2009.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.horn_kernels import horn_into
from odomap.geometry.ransac import draw_samples
from odomap.geometry.so3 import so3_log
from odomap.kernels import kernel
from odomap.lidar.descriptors import describe
from odomap.lidar.voxels import into_cells

__all__ = ["candidates", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Motions = list[tuple[Array, Array]]

MOST = 6
"""Candidates that are tried."""
SAMPLES = 60_000
COARSER = 2.0
"""Side of the voxels that are described, or cells that are correlated, in those of the clouds."""
AROUND = 6.0
"""How far descriptors look, in the coarser voxels."""
LENGTHS = 0.85
"""How alike distances between three points must be in both clouds."""
LARGEST_GRID = 1024
MOST_HEADINGS = 720


def candidates(
    source: tuple[Array, Array],
    target: tuple[Array, Array],
    spacing: float,
    planar: bool,
    seed: int,
) -> Motions:
    """Return motions R, t of the source that may be right, the most likely first.

    Args:
        source: points (N, 3) and normals (N, 3).
        target: likewise.
        spacing: how far points are apart.
        planar: whether x, y and θ alone are free.
        seed: of the samples.
    """
    if planar:
        return _by_correlation(source[0], target[0], COARSER * spacing)
    return _by_descriptors(source, target, COARSER * spacing, seed)


# ---- in space ----


def _thinned(points: Array, normals: Array, size: float) -> tuple[Array, Array]:
    """Return one point with a normal per voxel: the first."""
    good = np.flatnonzero(normals.any(axis=1))
    cells = into_cells(points[good], size)
    rows = good[np.unique(cells.cell_of, return_index=True)[1]]
    return np.ascontiguousarray(points[rows]), np.ascontiguousarray(normals[rows])


def _by_descriptors(
    source: tuple[Array, Array], target: tuple[Array, Array], size: float, seed: int
) -> Motions:
    p, m = _thinned(*source, size)
    q, n = _thinned(*target, size)
    if len(p) < 3 or len(q) < 3:
        return []
    i, j = _matches(describe(p, m, AROUND * size), describe(q, n, AROUND * size))
    if len(i) < 3:
        return []
    p, q = np.ascontiguousarray(p[i]), np.ascontiguousarray(q[j])
    samples = draw_samples(len(p), 3, SAMPLES, np.random.default_rng(seed))
    scores = np.zeros(len(samples))
    _score_kernel(samples, p, q, LENGTHS, 4.0 * size, size * size, scores)
    found: Motions = []
    for row in np.argsort(-scores, kind="stable")[:200]:
        if scores[row] <= 0.0 or len(found) == MOST:
            break
        R, t = np.empty((3, 3)), np.empty(3)
        horn_into(p, q, samples[row], False, R, t, np.empty((4, 4)), np.empty((4, 4)))
        if not any(_are_alike(R, t, *other, 2.0 * size) for other in found):
            found.append((R, t))
    return found


def _matches(a: Array, b: Array) -> tuple[Index, Index]:
    """Return pairs of rows that are each other's nearest; if these are few, the nearest of each."""
    squares = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2.0 * (a @ b.T)
    best, back = np.argmin(squares, axis=1), np.argmin(squares, axis=0)
    rows = np.arange(len(a))
    mutual = back[best] == rows
    if mutual.sum() < 30:
        mutual[:] = True
    return rows[mutual], best[mutual]


def _are_alike(R: Array, t: Array, R2: Array, t2: Array, size: float) -> bool:
    return bool(np.linalg.norm(t - t2) < size and np.linalg.norm(so3_log(R.T @ R2)) < 0.2)


@kernel
def _score_kernel(
    samples: Index, p: Array, q: Array, alike: float, least: float, gate: float, scores: Array
) -> None:
    """Σ max(0, 1 - |q - R p - t|² / g) of the motion of each sample; 0 if lengths differ."""
    R, t, A, V = np.empty((3, 3)), np.empty(3), np.empty((4, 4)), np.empty((4, 4))
    for s in range(samples.shape[0]):
        good = True
        for a in range(3):
            i, j = samples[s, a], samples[s, (a + 1) % 3]
            d, e = 0.0, 0.0
            for c in range(3):
                d += (p[i, c] - p[j, c]) ** 2
                e += (q[i, c] - q[j, c]) ** 2
            d, e = np.sqrt(d), np.sqrt(e)
            good = good and d >= least and d >= alike * e and e >= alike * d
        if not good or not horn_into(p, q, samples[s], False, R, t, A, V) > 0.0:
            continue
        for k in range(p.shape[0]):
            r2 = 0.0
            for a in range(3):
                r = q[k, a] - t[a]
                for c in range(3):
                    r -= R[a, c] * p[k, c]
                r2 += r * r
            if r2 < gate:
                scores[s] += 1.0 - r2 / gate


# ---- in the plane ----


def _by_correlation(p: Array, q: Array, size: float) -> Motions:
    from scipy import fft

    reach = float(np.linalg.norm(p[:, :2], axis=1).max())
    low, high = q[:, :2].min(axis=0) - reach, q[:, :2].max(axis=0) + reach
    size = max(size, float((high - low).max()) / (LARGEST_GRID - 4))
    shape = tuple(fft.next_fast_len(int(n) + 4) for n in np.ceil((high - low) / size))
    field = _counted(q[:, :2] - low, size, shape) > 0.0
    spectrum = fft.rfft2(_blurred(field.astype(np.float64)))
    headings = min(int(np.ceil(2.0 * np.pi * reach / size)), MOST_HEADINGS)
    best: list[tuple[float, float, Array]] = []
    for theta in 2.0 * np.pi * np.arange(headings) / headings:
        c, s = np.cos(theta), np.sin(theta)
        turned = p[:, :2] @ np.array([[c, s], [-s, c]]) + reach
        mine = np.minimum(_counted(turned, size, shape), 1.0)
        score = fft.irfft2(spectrum * np.conj(fft.rfft2(mine)), shape)
        at = int(np.argmax(score))
        cell = np.array(np.unravel_index(at, shape), np.float64)
        cell = np.where(cell > np.array(shape) / 2, cell - shape, cell)
        best.append((float(score.flat[at]), float(theta), cell * size + low + reach))
    best.sort(key=lambda entry: -entry[0])
    found: Motions = []
    for _, theta, shift in best:
        c, s = np.cos(theta), np.sin(theta)
        R, t = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([*shift, 0.0])
        if len(found) < MOST and not any(_are_alike(R, t, *o, 4.0 * size) for o in found):
            found.append((R, t))
    return found


def _counted(points: Array, size: float, shape: tuple[int, ...]) -> Array:
    """Return how many points (N, 2) fall into each cell of a grid that wraps around."""
    cells = np.floor(points / size).astype(np.int64) % np.array(shape)
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    return np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float64)


def _blurred(field: Array) -> Array:
    """Return a grid with half of each cell in the four beside it: those are nearly as good."""
    beside = [np.roll(field, step, axis) for axis in (0, 1) for step in (-1, 1)]
    return np.asarray(np.maximum(field, 0.5 * np.maximum.reduce(beside)))


def warm_up() -> None:
    """Compile the kernels of this file."""
    p = np.eye(3)
    _score_kernel(np.arange(3)[None], p, p, 0.5, 0.1, 1.0, np.zeros(1))
