"""Alignment of two cameras: one place, seen twice, some of its points matched wrongly.

The problem: two cameras have each a map of the same points, in a frame and, of a single camera, at
a scale of its own, and each sees some of them. Three pairs of points give the similarity from one
to the other in closed form (Horn); RANSAC finds one that most pairs agree with in both images; and
Levenberg-Marquardt minimises, over what both have seen,

    Σ ρ(|x - π(S⁻¹ q)|² / σ_x²) + ρ(|y - π(S p)|² / σ_y²),      S = (R, t, s),

and the errors of log depth where s is sought: of two cameras in one place they alone tell it.

The covariance does not believe σ alone. Where points were mapped from the very pixels they are
compared with, the two halves of a pair are one measurement told twice; and points have errors of
their own. What the gradients of the pairs, g_i, scatter tells both: Σ = H⁻¹ (Σ g_i g_iᵀ) H⁻¹, never
less than H⁻¹, and nowhere surer than on average. Samples come from the caller's seed. O(samples N).

Reference: S. Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", PAMI 13(4), 1991; H. White, "Maximum likelihood estimation of misspecified models",
Econometrica 50(1), 1982 (the covariance).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.ransac import check_search, draw_samples
from odomap.geometry.so3 import Array

__all__ = ["Alignment", "PairSights", "refine_alignment", "solve_alignment"]

Bools = NDArray[np.bool_]

LEAST_DEPTH = 1e-3
"""Relative error of depths that are believed no better, at the median of them."""


@dataclass(frozen=True, eq=False)
class PairSights:
    """What two cameras know and see of N points.

    Attributes:
        p: (N, 3) in the first camera, in its units.
        x: (N, 2) where the first camera sees them, on the plane z = 1.
        wx: (N,) inverse variance of x; 0 where the first does not see it or the second does not
            know it.
        q: (N, 3) in the second camera, in its units.
        y: (N, 2) where the second camera sees them.
        wy: (N,) inverse variance of y; 0 where the second does not see it or the first does not
            know it.
    """

    p: Array
    x: Array
    wx: Array
    q: Array
    y: Array
    wy: Array

    def __len__(self) -> int:
        return len(self.p)

    def at(self, rows: NDArray[np.int64] | Bools) -> "PairSights":
        """Return some of them."""
        return PairSights(
            *(np.ascontiguousarray(a[rows]) for a in (self.p, self.x, self.wx)),
            *(np.ascontiguousarray(a[rows]) for a in (self.q, self.y, self.wy)),
        )


@dataclass(frozen=True, eq=False)
class Alignment:
    """The similarity from the first camera to the second, q = s R p + t.

    Attributes:
        T_second_first: (4, 4) R and t, in units of the second.
        scale: units of the second per unit of the first.
        inliers: (N,) bool, pairs that agree in all images they are seen in.
        covariance: (7, 7) of the tangent of Sim(3), right update: translation in units of the
            first, rotation, log of the scale (zeros where it is known); infinite if not determined.
        converged: whether there is an alignment to rely on.
    """

    T_second_first: Array
    scale: float
    inliers: Bools
    covariance: Array
    converged: bool

    @property
    def num_inliers(self) -> int:
        """How many pairs agree."""
        return int(np.count_nonzero(self.inliers))


def solve_alignment(
    sights: PairSights,
    with_scale: bool,
    seed: int,
    gate: float = 9.21,
    confidence: float = 0.999,
    max_iterations: int = 300,
) -> Alignment:
    """Find the similarity that most pairs agree with, from nothing; not refined.

    Args:
        sights: pairs that both cameras know.
        with_scale: whether the scale is sought; else it is 1.
        seed: of the samples.
        gate: largest squared error of an inlier, in variances.
        confidence: probability of a clean sample at which the search stops.
        max_iterations: samples at most.

    Returns:
        The alignment; `converged` is false if no sample gave one with four inliers, and the
        covariance is infinite.

    Raises:
        InputError: a gate or confidence outside its range, or arrays that do not fit together.
    """
    from odomap.geometry.alignransac_kernels import search_alignment

    check_search(gate, confidence)
    _check(sights)
    n = len(sights)
    R, t, inliers = np.eye(3), np.zeros(3), np.zeros(n, np.bool_)
    scale = 0.0
    if n >= 3:
        samples = draw_samples(n, 3, max_iterations, np.random.default_rng(seed))
        scale, _ = search_alignment(
            *(samples, sights.p, sights.x, sights.wx, sights.q, sights.y, sights.wy),
            *(gate, confidence, with_scale, R, t, inliers),
        )
    found = scale > 0 and int(inliers.sum()) >= 4
    if not found:
        inliers[:] = False
    return Alignment(_pose(R, t), scale or 1.0, inliers, np.full((7, 7), np.inf), found)


def refine_alignment(
    sights: PairSights,
    start: Alignment,
    with_scale: bool,
    gate: float = 9.21,
    huber: float = 2.5,
    max_iterations: int = 30,
) -> Alignment:
    """Minimise the errors in both images from a good start, then without what is far off.

    Args:
        sights: pairs, also those that one side alone knows or sees.
        start: from `solve_alignment`, or from here.
        with_scale: whether the scale is sought; else it stays.
        gate: largest squared error of an inlier, in variances.
        huber: standard deviations beyond which errors count less.
        max_iterations: steps of each of the two rounds.

    Returns:
        The alignment, and which pairs agree with it.
    """
    from odomap.geometry.alignransac_kernels import refine_alignment_into, score_alignment

    _check(sights)
    R = np.array(start.T_second_first[:3, :3], order="C")
    t, scale = np.array(start.T_second_first[:3, 3]), float(start.scale)
    H, M, inliers = np.zeros((7, 7)), np.zeros((7, 7)), np.zeros(len(sights), np.bool_)
    converged, used = False, sights
    # A gate four times as wide at first lets back in what a poor start put outside.
    for allowed in (4.0 * gate, gate):
        score_alignment(R, t, scale, *_columns(sights), allowed, inliers)
        used = sights.at(inliers)
        scale, _, converged = refine_alignment_into(
            *(R, t, scale, *_columns(used), _depth_weights(used, R, t, scale, with_scale)),
            *(huber, with_scale, max_iterations, H, M),
        )
    score_alignment(R, t, scale, *_columns(sights), gate, inliers)
    covariance = _covariance(H, M, scale, with_scale, len(used)) if converged else None
    if covariance is None:
        covariance, converged = np.full((7, 7), np.inf), False
    return Alignment(_pose(R, t), scale, inliers, covariance, converged)


def _depth_weights(s: PairSights, R: Array, t: Array, scale: float, with_scale: bool) -> Array:
    """Return (N,) inverse variances of log depths: errors grow with depth, by as much as they do.

    Where the scale is known depths are left out: pixels say more.
    """
    weights = np.zeros(len(s))
    rows = np.flatnonzero((s.wx > 0) & (s.wy > 0))
    if not with_scale or len(rows) < 3:
        return weights
    depth, other = s.q[rows, 2], scale * (s.p[rows] @ R[2]) + t[2]
    rows, depth, other = (a[(depth > 0) & (other > 0)] for a in (rows, depth, other))
    if len(rows) >= 3:
        off = np.log(other / depth) / depth
        sigma = 1.4826 * np.median(np.abs(off - np.median(off)))
        weights[rows] = 1.0 / (max(float(sigma), LEAST_DEPTH / np.median(depth)) * depth) ** 2
    return weights


def _columns(s: PairSights) -> tuple[Array, Array, Array, Array, Array, Array]:
    return s.p, s.x, s.wx, s.q, s.y, s.wy


def _pose(R: Array, t: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def _covariance(H: Array, M: Array, scale: float, with_scale: bool, n: int) -> Array | None:
    """Return the covariance from curvature and scatter of the gradients; None if not determined."""
    d = 7 if with_scale else 6
    # In the kernel the translation is in units of the second; that of Sim(3) is in the first's.
    unit = np.ones(d)
    unit[:3] = scale
    H, M = unit[:, None] * H[:d, :d] * unit, unit[:, None] * M[:d, :d] * unit
    size = np.sqrt(np.diag(H))
    if n <= d or not np.all(size > 0):
        return None
    try:
        L = np.linalg.cholesky(H / np.outer(size, size))
    except np.linalg.LinAlgError:
        return None
    if np.min(np.diag(L)) < 1e-6:
        return None
    root = np.linalg.inv(L) / size  # rootᵀ root = H⁻¹
    w, U = np.linalg.eigh(root @ M @ root.T)
    # Residuals of d fitted numbers are smaller than the errors.
    w = w * (2.0 * n / (2.0 * n - d))
    w = np.maximum(w, max(float(w.mean()), 1.0))
    half = (U * np.sqrt(w)).T @ root
    covariance = np.zeros((7, 7))
    covariance[:d, :d] = half.T @ half
    return covariance


def _check(s: PairSights) -> None:
    shapes = tuple(a.shape for a in _columns(s))
    n = len(s.p)
    if shapes != ((n, 3), (n, 2), (n,), (n, 3), (n, 2), (n,)):
        raise InputError(f"sights: have shapes {shapes}, give (N, 3), (N, 2), (N,) twice")
    for name, weight, needed in (("x", s.wx, (s.x, s.q)), ("y", s.wy, (s.y, s.p))):
        rows = weight > 0
        if not np.all(np.isfinite(weight)) or not all(np.isfinite(a[rows]).all() for a in needed):
            raise InputError(f"sights: w{name} is above 0 where something is not finite")
