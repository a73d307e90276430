"""Homographies: the motions between two views that a plane allows.

The problem: points on a plane nᵀ x = d move by x₂ ∝ H x₁ with

    H = R + t nᵀ / d,

up to a factor, which is such that the middle singular value is 1. Two directions in the plane keep
their length under H; they, their images and their cross products are two right-handed frames, and
the rotation takes one to the other. There are two such pairs, and a sign each: four motions. Those
that put points behind a camera are wrong; two may remain, and only a third view tells them apart.

O(1), one eigenvalue decomposition of 3x3.

Reference: Y. Ma, S. Soatto, J. Košecká, S. Sastry, "An Invitation to 3-D Vision", Springer 2004,
section 5.3.3.
"""

import numpy as np
from numpy.typing import ArrayLike

from odomap.errors import InputError
from odomap.geometry.lie import orthonormalize
from odomap.geometry.pose import SE3
from odomap.geometry.so3 import Array, tail_shape

__all__ = ["motions_of_homography"]

_FLAT = 1e-12
"""Ratio of squared singular values below which a matrix maps all to a line or a point."""
_STILL = 1e-6
"""Difference of the squared singular values below which the camera only turned."""


def motions_of_homography(H: ArrayLike) -> list[SE3]:
    """Return the four motions a homography stands for.

    Args:
        H: (3, 3) maps the plane z = 1 of the first view to that of the second, any factor.

    Returns:
        Four T_second_first, the translation in units of the plane's distance from the first camera;
        none if the camera only turned, which says nothing about the plane, or if H has rank one.

    Raises:
        InputError: H is not (3, 3).
    """
    given = tail_shape(H, (3, 3), "H")
    if given.ndim != 2:
        raise InputError(f"H: has shape {given.shape}, give shape (3, 3)")
    values, V = np.linalg.eigh(given.T @ given)
    if not values[1] > _FLAT * values[2]:
        return []
    scaled: Array = given * np.sign(np.linalg.det(given)) / np.sqrt(values[1])
    low, _, high = values / values[1]
    if high - low < _STILL:
        return []
    if np.linalg.det(V) < 0:
        V = -V
    v3, v2, v1 = V[:, 0], V[:, 1], V[:, 2]
    a, b = np.sqrt(max(1.0 - low, 0.0)), np.sqrt(max(high - 1.0, 0.0))
    motions = []
    for u in ((a * v1 + b * v3) / np.sqrt(high - low), (a * v1 - b * v3) / np.sqrt(high - low)):
        before = np.stack([v2, u, np.cross(v2, u)], axis=1)
        after = np.stack([scaled @ v2, scaled @ u, np.cross(scaled @ v2, scaled @ u)], axis=1)
        R = orthonormalize(after @ before.T)
        normal: Array = np.cross(v2, u)
        t = (scaled - R) @ normal
        motions += [SE3.from_parts(R, t), SE3.from_parts(R, -t)]
    return motions
