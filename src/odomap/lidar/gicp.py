"""Generalised ICP: a point stands for a piece of surface, and pairs of pieces are laid together.

The problem: point-to-plane trusts the target's normals and forgets the source's. Let each point be
drawn from a disc that lies in its surface, of unit size along it and thin (ε) across,

    C = I - (1 - ε) n nᵀ ,      e = q - T p  ~  N(0, C_q + R C_p Rᵀ)

Then Σ eᵀ M e with M = (C_q + R C_p Rᵀ)⁻¹ slides where both surfaces agree that it may, counts a
pair on surfaces that do not agree like a pair of points, and is symmetric in both clouds. In the
paper ε is 10⁻³ everywhere; here that is the least, and the thickness seen around a point counts,
together with ten points' worth of the mean thickness λ̄ of the cloud, since few points are flat by
chance: four far ones, with a lever of 40 m, turned a real cloud by a degree,

    ε = (n λ₀ + 10 λ̄) / (n size²)

With n' = √(1-ε) n, m' = √(1-ε) R n_p and k = n'ᵀm' the inverse has a closed form (Woodbury's),

    M = ½ I + ½/d ((2 - |m'|²) n'n'ᵀ + (2 - |n'|²) m'm'ᵀ + k (n'm'ᵀ + m'n'ᵀ)),
    d = (2 - |n'|²)(2 - |m'|²) - k²

so that no matrix is stored. A point without a normal has n' = 0. M is held during a step.

Cost: 40 ns per pair beside the search for it.

Reference: A. Segal, D. Haehnel, S. Thrun, "Generalized-ICP", RSS 2009.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["EPSILON", "disc_metric_into", "discs", "sure_normals", "warm_up"]

Array = NDArray[np.float64]

EPSILON = 1e-3
"""Least thickness of a disc, as a share of its size, squared."""
PRIOR = 10.0
"""Points' worth of the mean thickness that counts beside what is seen around a point."""


def discs(normals: Array, spreads: Array, size: float) -> Array:
    """Return normals (N, 3) scaled by √(1 - ε), of points whose surface was looked at.

    Args:
        normals: (N, 3) unit, or zero where there is none.
        spreads: (N, 5) number of points around each, and the eigenvalues of their covariance.
        size: of a disc, metres.
    """
    count, thickness = np.maximum(spreads[:, 0], 1.0), spreads[:, 1]
    known = spreads[:, 0] > 0.0
    mean = float(thickness[known].mean()) if known.any() else 0.0
    epsilon = np.clip((thickness + PRIOR * mean / count) / (size * size), EPSILON, 1.0)
    return np.asarray(normals * np.sqrt(1.0 - epsilon)[:, None])


def sure_normals(normals: Array, scaled: Array) -> Array:
    """Return normals (N, 3) scaled to count as their discs do: by √(10⁻³ / ε) of `discs`' ε."""
    epsilon = np.maximum(1.0 - np.sum(scaled * scaled, axis=1), EPSILON)
    return np.asarray(normals * np.sqrt(EPSILON / epsilon)[:, None])


@kernel
def disc_metric_into(
    nx: float, ny: float, nz: float, mx: float, my: float, mz: float, M: Array
) -> None:
    """M (xx, xy, xz, yy, yz, zz) = (2 I - n' n'ᵀ - m' m'ᵀ)⁻¹."""
    a = 2.0 - nx * nx - ny * ny - nz * nz
    b = 2.0 - mx * mx - my * my - mz * mz
    k = nx * mx + ny * my + nz * mz
    s = 0.5 / (a * b - k * k)
    a, b, k = s * a, s * b, s * k
    M[0] = 0.5 + b * nx * nx + a * mx * mx + 2.0 * k * nx * mx
    M[1] = b * nx * ny + a * mx * my + k * (nx * my + ny * mx)
    M[2] = b * nx * nz + a * mx * mz + k * (nx * mz + nz * mx)
    M[3] = 0.5 + b * ny * ny + a * my * my + 2.0 * k * ny * my
    M[4] = b * ny * nz + a * my * mz + k * (ny * mz + nz * my)
    M[5] = 0.5 + b * nz * nz + a * mz * mz + 2.0 * k * nz * mz


def warm_up() -> None:
    """Compile the kernels of this file."""
    disc_metric_into(0.0, 0.0, 1.0, 0.0, 0.0, 1.0, np.empty(6))
