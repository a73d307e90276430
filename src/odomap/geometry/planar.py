"""Motion in a plane inside space: what moves on a floor has three unknowns, its poses have six.

A planar pose is (x, y, θ): metres, and a heading in radians. In space it stands at height 0 and
turns about z; of its covariance, tangent (translation, rotation), the entries x, y and θ are those
of the plane. How far a floor is from a plane is a small variance of the other three.

    a ⊕ b = (t_a + R(θ_a) t_b, θ_a + θ_b),        cov(a ⊕ b) = Ad(b⁻¹) Σ_a Ad(b⁻¹)ᵀ + Σ_b

Reference: R. Smith, M. Self, P. Cheeseman, "Estimating uncertain spatial relationships in
robotics", Autonomous Robot Vehicles, Springer 1990.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.se2 import se2_adjoint, se2_inverse

__all__ = [
    "between_planar",
    "compose_planar",
    "from_plane",
    "lift_covariance",
    "lift_information",
    "moved_covariance",
    "planar_matrix",
    "to_plane",
    "transform_planar",
]

Array = NDArray[np.float64]

IN_PLANE = np.array([0, 1, 5])
"""Where x, y and heading are in a tangent (translation, rotation)."""
OFF_PLANE = 1e-3
"""Standard deviation of what leaves the plane: metres, radians."""


def to_plane(T: Array) -> Array:
    """Return (..., 3) x, y, heading of poses (..., 4, 4)."""
    return np.stack([T[..., 0, 3], T[..., 1, 3], np.arctan2(T[..., 1, 0], T[..., 0, 0])], axis=-1)


def from_plane(x: Array) -> Array:
    """Return poses (..., 4, 4) of (..., 3) x, y, heading."""
    T = np.zeros((*np.shape(x)[:-1], 4, 4))
    T[..., 0, 0] = T[..., 1, 1] = np.cos(x[..., 2])
    T[..., 1, 0] = np.sin(x[..., 2])
    T[..., 0, 1] = -T[..., 1, 0]
    T[..., :2, 3] = x[..., :2]
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    return T


def planar_matrix(x: Array) -> Array:
    """Return (..., 3, 3) matrices of SE(2) of (..., 3) x, y, heading."""
    return from_plane(x)[..., [[0], [1], [3]], [[0, 1, 3]]]


def compose_planar(a: Array, b: Array) -> Array:
    """Return a ⊕ b: (3,) b, given in a, as seen from where a is given."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], _wrapped(a[2] + b[2])])


def between_planar(a: Array, b: Array) -> Array:
    """Return b as seen from a, (3,): a ⊕ it is b."""
    c, s, d = np.cos(a[2]), np.sin(a[2]), b[:2] - a[:2]
    return np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], _wrapped(b[2] - a[2])])


def transform_planar(x: Array, points: Array) -> Array:
    """Return points (N, 2) given in a pose (3,) as seen from where that is given."""
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + x[:2])


def moved_covariance(covariance: Array, motion: Array) -> Array:
    """Return how sure (3, 3) a pose is after an exact motion (3,) of its own."""
    Ad = se2_adjoint(se2_inverse(planar_matrix(motion)))
    return np.asarray(Ad @ covariance @ Ad.T)


def lift_covariance(covariance: Array) -> Array:
    """Return (..., 6, 6) of covariances (..., 3, 3) of planar poses."""
    return _lifted(covariance, OFF_PLANE**2)


def lift_information(information: Array) -> Array:
    """Return (..., 6, 6) of information matrices (..., 3, 3) of planar poses."""
    return _lifted(information, OFF_PLANE**-2)


def _lifted(matrix: Array, off_plane: float) -> Array:
    lifted = np.zeros((*np.shape(matrix)[:-2], 6, 6))
    lifted[..., [2, 3, 4], [2, 3, 4]] = off_plane
    lifted[..., IN_PLANE[:, None], IN_PLANE] = matrix
    return lifted


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
