"""RANSAC: a model from data of which an unknown part is wrong.

The problem: one false match spoils a least squares fit, but a fit to the fewest points that
determine the model is free of them with probability pᵏ (p the share of inliers, k the sample size).
So draw samples, fit, and keep the model with the least truncated cost Σ min(r², τ²) (MSAC). After

    n = log(1 - confidence) / log(1 - pᵏ)

samples the best is a clean one with the wanted confidence; p is taken from the best model so far.
Each new best model is polished on its inliers before it is compared (local optimisation), since a
minimal fit carries the noise of its few points. The samples come from the caller's seed through a
generator of its own, so the same call gives the same answer on any thread. O(n · (fit + N)).

Reference: O. Chum, J. Matas, J. Kittler, "Locally optimized RANSAC", DAGM 2003.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, log, log1p
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.so3 import Array

__all__ = ["RansacResult", "check_search", "draw_samples", "ransac", "samples_needed"]

M = TypeVar("M")
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class RansacResult(Generic[M]):
    """The best model found.

    Attributes:
        model: the model, or None if no sample gave one with enough inliers.
        inliers: (N,) bool, residual within the threshold.
        iterations: samples drawn.
        cost: Σ min(r², τ²) of the model.
    """

    model: M | None
    inliers: NDArray[np.bool_]
    iterations: int
    cost: float

    @property
    def num_inliers(self) -> int:
        """How many data agree with the model."""
        return int(np.count_nonzero(self.inliers))


def draw_samples(n: int, sample_size: int, count: int, generator: np.random.Generator) -> Rows:
    """Draw samples without repetition inside a sample.

    Args:
        n: number of data, at least `sample_size`.
        sample_size: rows per sample.
        count: how many samples.
        generator: source of randomness.

    Returns:
        (count, sample_size) int64 row numbers.
    """
    if n < 2 * sample_size:
        return np.argsort(generator.random((count, n)), axis=1)[:, :sample_size].astype(np.int64)
    drawn = generator.integers(0, n, size=(count, sample_size), dtype=np.int64)
    while True:
        ordered = np.sort(drawn, axis=1)
        again = np.flatnonzero(np.any(ordered[:, 1:] == ordered[:, :-1], axis=1))
        if len(again) == 0:
            return drawn
        drawn[again] = generator.integers(0, n, size=(len(again), sample_size), dtype=np.int64)


def samples_needed(inlier_share: float, sample_size: int, confidence: float, limit: int) -> int:
    """Return how many samples make a clean one likely.

    Args:
        inlier_share: part of the data that agrees, 0 to 1.
        sample_size: rows per sample.
        confidence: wanted probability of at least one clean sample.
        limit: largest answer.

    Returns:
        Number of samples, 1 to `limit`.
    """
    clean = inlier_share**sample_size
    if clean >= 1.0:
        return 1
    if clean < 1e-12:
        return limit
    return max(1, min(limit, ceil(log(1.0 - confidence) / log1p(-clean))))


def ransac(
    n: int,
    sample_size: int,
    fit: Callable[[Rows], Sequence[M]],
    residual: Callable[[M], Array],
    threshold: float,
    seed: int,
    confidence: float = 0.999,
    max_iterations: int = 1000,
    *,
    polish: Callable[[M, Rows], M | None] | None = None,
    batch: int = 32,
    min_inliers: int = 0,
) -> RansacResult[M]:
    """Find the model that most of the data agrees with.

    Args:
        n: number of data.
        sample_size: rows that determine a model.
        fit: samples (B, sample_size) of row numbers → the models they give, any number.
        residual: model → (n,) distances in the unit of `threshold`, NaN where undefined.
        threshold: largest distance of an inlier.
        seed: of the samples.
        confidence: probability of having drawn a clean sample at which to stop.
        max_iterations: samples at most.
        polish: (model, rows of its inliers) → a better model, or None.
        batch: samples handed to `fit` at a time.
        min_inliers: fewer mean no model; at least `sample_size` + 1.

    Returns:
        The best model, its inliers, and the number of samples drawn.

    Raises:
        InputError: a threshold or confidence outside its range.
    """
    check_search(threshold, confidence)
    best: M | None = None
    best_cost, best_inliers, drawn = np.inf, np.zeros(n, dtype=np.bool_), 0
    if n < sample_size:
        return RansacResult(None, best_inliers, 0, np.inf)
    generator, needed = np.random.default_rng(seed), max_iterations
    while drawn < needed:
        samples = draw_samples(n, sample_size, min(batch, needed - drawn), generator)
        drawn += len(samples)
        leaders: list[M] = []
        for model in fit(samples):
            cost, inliers = _score(residual(model), threshold)
            if cost < best_cost:
                leaders, best, best_cost, best_inliers = [model], model, cost, inliers
        for leader in leaders:
            if polish is not None:
                better = _polished(
                    leader, best_cost, best_inliers, polish, residual, threshold, sample_size
                )
                best, best_cost, best_inliers = better
            share = np.count_nonzero(best_inliers) / n
            needed = samples_needed(share, sample_size, confidence, max_iterations)
    if np.count_nonzero(best_inliers) < max(min_inliers, min(sample_size + 1, n)):
        return RansacResult(None, np.zeros(n, dtype=np.bool_), drawn, np.inf)
    return RansacResult(best, best_inliers, drawn, best_cost)


def check_search(threshold: float, confidence: float) -> None:
    """Raise InputError unless the threshold is above 0 and the confidence between 0 and 1."""
    if not threshold > 0:
        raise InputError(f"threshold: is {threshold}, must be above 0")
    if not 0 < confidence < 1:
        raise InputError(f"confidence: is {confidence}, must lie between 0 and 1")


def _score(residuals: Array, threshold: float) -> tuple[float, NDArray[np.bool_]]:
    inliers = residuals <= threshold
    r2 = np.where(inliers, residuals * residuals, threshold * threshold)
    return float(np.sum(r2)), inliers


def _polished(
    model: M,
    cost: float,
    inliers: NDArray[np.bool_],
    polish: Callable[[M, Rows], M | None],
    residual: Callable[[M], Array],
    threshold: float,
    sample_size: int,
) -> tuple[M, float, NDArray[np.bool_]]:
    """Refit to the inliers while that lowers the cost, four times at most."""
    for _ in range(4):
        rows = np.flatnonzero(inliers)
        if len(rows) <= sample_size:
            break
        better = polish(model, rows)
        if better is None:
            break
        new_cost, new_inliers = _score(residual(better), threshold)
        if not new_cost < cost:
            break
        model, cost, inliers = better, new_cost, new_inliers
    return model, cost, inliers
