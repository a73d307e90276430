"""Depth bias: what all measured inverse depths are off by together, learnt on the way.

A pair calibrated to a fraction of a pixel measures all disparities wrong by nearly the same, and
with them the size of the world: 0.2 px at a disparity of 10 are two percent of the way. How far it
may be off the rig says; but the images say it too, since points that come nearer must grow in
disparity as their parallax over the way demands. Of the bias as an offset and two slopes,

    δ(x, y) = b₀ + b₁ x + b₂ y,      added to inverse depth at x, y of the normalised image,

every window of keyframes knows the gradient −k and curvature H of its cost with all else following
(`backend.bundle`). Windows overlap, so each counts for the share of what is new in it; together
with the rig's own standard deviations as a prior, b is the mean of a Gaussian in information form:

    Λ ← Λ + f H,   Λ b ← Λ b + f (H b + k).

A map that others made does not say with which bias; but its landmarks lie where depths say, less
that bias, so that a robust fit to what both differ by finds it again.

Reference: Thrun, Burgard, Fox, "Probabilistic Robotics", MIT Press 2005, section 3.5 (the
information filter); Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999, section 9.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import BundleSolution

__all__ = ["DepthBias", "bias_at"]

Array = NDArray[np.float64]

HUBER = 1.5
"""Standard deviations beyond which a depth counts less for the bias that a map is found to have."""
FITS = 10
"""Rounds of weighting them."""


class DepthBias:
    """The bias of measured inverse depths, as known so far.

    Args:
        sigmas: (3,) standard deviations that the rig admits: offset and slopes in x and y, 1/m.
            One of zero is certain, and never learnt.

    Attributes:
        value: (3,) the bias, 1/m.
    """

    def __init__(self, sigmas: Array) -> None:
        self._learns = sigmas > 0
        self._information = np.diag(1.0 / np.where(self._learns, sigmas, 1.0) ** 2)
        self._vector = np.zeros(3)
        self.value = np.zeros(3)

    def learn(self, solution: BundleSolution, share: float) -> None:
        """Take in what a window says, if it has been solved to the end.

        Args:
            solution: of the window, with this bias removed.
            share: part of its observations that no window before has had.
        """
        if solution.reason != "converged":
            return  # away from the minimum the gradient is also that of everything else
        keep = np.outer(self._learns, self._learns)
        H = np.where(keep, solution.disparity_curvature, 0.0)
        k = np.where(self._learns, solution.disparity_gradient, 0.0)
        weight = share / max(solution.variance_factor, 1.0)
        self._information += weight * H
        self._vector += weight * (H @ self.value + k)
        self.value = np.where(self._learns, np.linalg.solve(self._information, self._vector), 0.0)

    def fitted(self, off: Array, bearings: Array, sigma: float) -> Array:
        """Return the bias (3,) that a map was made with, which no file keeps.

        Landmarks of a map that was solved with a bias b lie where its depths say, less b.

        Args:
            off: (N,) measured inverse depths less those of the landmarks, 1/m.
            bearings: (N, 3) rays along which they were measured.
            sigma: standard deviation of a measured inverse depth, 1/m.
        """
        A = np.stack([np.ones(len(off)), *(bearings[:, :2] / bearings[:, 2:]).T], axis=1)
        value = np.zeros(3)
        for _ in range(FITS):
            error = np.abs(off - A @ value) / sigma
            weighted = A * (np.minimum(1.0, HUBER / np.maximum(error, HUBER)) / sigma**2)[:, None]
            information = np.where(np.outer(self._learns, self._learns), weighted.T @ A, 0.0)
            found = np.linalg.solve(information + self._information, weighted.T @ off)
            value = np.where(self._learns, found, 0.0)
        return value


def bias_at(bias: Array, bearings: Array) -> Array:
    """Return the bias (N,) of inverse depths measured along rays (N, 3) of the camera."""
    x, y = bearings[:, 0] / bearings[:, 2], bearings[:, 1] / bearings[:, 2]
    return np.asarray(bias[0] + bias[1] * x + bias[2] * y)
