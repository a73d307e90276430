"""Motion in a plane inside space: what moves on a floor has three unknowns, its poses have six.

A planar pose is (x, y, θ): metres, and a heading in radians. In space it stands at height 0 and
turns about z; of its covariance, tangent (translation, rotation), the entries x, y and θ are those
of the plane. How far a floor is from a plane is a small variance of the other three.

    a ⊕ b = (t_a + R(θ_a) t_b, θ_a + θ_b),        cov(a ⊕ b) = Ad(b⁻¹) Σ_a Ad(b⁻¹)ᵀ + Σ_b

Reference: R. Smith, M. Self, P. Cheeseman, "Estimating uncertain spatial relationships in
robotics", Autonomous Robot Vehicles, Springer 1990.
"""

import math

import numpy as np
from numpy.typing import NDArray

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
    if T.ndim == 2:
        return np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])
    return np.stack([T[..., 0, 3], T[..., 1, 3], np.arctan2(T[..., 1, 0], T[..., 0, 0])], axis=-1)


def from_plane(x: Array) -> Array:
    """Return poses (..., 4, 4) of (..., 3) x, y, heading."""
    if np.ndim(x) == 1:
        t_x, t_y, angle = x.tolist()
        c, s = math.cos(angle), math.sin(angle)
        zero = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        return np.array([c, -s, 0.0, t_x, s, c, 0.0, t_y, *zero]).reshape(4, 4)
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
    (x, y, angle), (b_x, b_y, turn) = a.tolist(), b.tolist()
    c, s = math.cos(angle), math.sin(angle)
    return np.array([x + c * b_x - s * b_y, y + s * b_x + c * b_y, _wrapped(angle + turn)])


def between_planar(a: Array, b: Array) -> Array:
    """Return b as seen from a, (3,): a ⊕ it is b."""
    (x, y, angle), (b_x, b_y, b_angle) = a.tolist(), b.tolist()
    c, s, d_x, d_y = math.cos(angle), math.sin(angle), b_x - x, b_y - y
    return np.array([c * d_x + s * d_y, -s * d_x + c * d_y, _wrapped(b_angle - angle)])


def transform_planar(x: Array, points: Array) -> Array:
    """Return points (N, 2) given in a pose (3,) as seen from where that is given."""
    t_x, t_y, angle = x.tolist()
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + (t_x, t_y))


def moved_covariance(covariance: Array, motion: Array) -> Array:
    """Return how sure (3, 3) a pose is after an exact motion (3,) of its own."""
    x, y, angle = motion.tolist()
    c, s = math.cos(angle), math.sin(angle)
    Ad = np.array([[c, s, s * x - c * y], [-s, c, c * x + s * y], [0.0, 0.0, 1.0]])
    return np.asarray(Ad @ covariance @ Ad.T)


def lift_covariance(covariance: Array) -> Array:
    """Return (..., 6, 6) of covariances (..., 3, 3) of planar poses."""
    return _lifted(covariance, OFF_PLANE**2)


def lift_information(information: Array) -> Array:
    """Return (..., 6, 6) of information matrices (..., 3, 3) of planar poses."""
    return _lifted(information, OFF_PLANE**-2)


def _lifted(matrix: Array, off_plane: float) -> Array:
    lifted = np.zeros((*np.shape(matrix)[:-2], 6, 6))
    lifted[..., 2, 2] = lifted[..., 3, 3] = lifted[..., 4, 4] = off_plane
    lifted[..., :2, :2], lifted[..., 5, 5] = matrix[..., :2, :2], matrix[..., 2, 2]
    lifted[..., :2, 5], lifted[..., 5, :2] = matrix[..., :2, 2], matrix[..., 2, :2]
    return lifted


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
