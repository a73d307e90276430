"""3D LiDARs: where the beams of a sweep go and when, and what they say of what they met.

A rotating LiDAR has beams above each other, spread between two elevations, that turn once a sweep.
A solid-state one looks ahead only: two prisms that turn at rates ω₁, ω₂ bend its beams,

    (azimuth, elevation) = α (cos ω₁t + cos ω₂t, sin ω₁t + sin ω₂t) / 2,

a rosette of 70 x 77 degrees that never repeats, since the rates have no ratio; its beams are lines
a little above each other, and a line of points follows the curve, not a ring.

What is measured is wrong as lasers are: noise n ~ N(0, σ(1 + r/50 m)), beams lost at random and
more often at grazing incidence, and beams that touch a second surface beside the first return a
range between both. A beam of half width β does so in mixed · min(1, 0.4 β/δ) of all cases where the
next beam, δ away, meets another surface. The intensity is that of a dull surface, albedo · cosine
of the incidence, times 255.

Cost: 30 ns a beam.

Paper: J. Lin, F. Zhang, "Loam livox: a fast, robust, high-precision LiDAR odometry and mapping
package for LiDARs of small FoV", ICRA 2020 (the pattern).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.sensors.sweep import Sweep
from odomap.simulation.lidar import LidarNoise

__all__ = ["Scanner", "measure", "warm_up"]

Array = NDArray[np.float64]
F32 = NDArray[np.float32]
Ids = NDArray[np.int32]

ELEVATIONS = ((16, -15.0, 15.0), (32, -30.0, 10.0), (64, -24.8, 2.0), (1024, -25.0, 15.0))
"""Lowest and highest beam in degrees of a rotating LiDAR of up to so many beams: as a VLP-16, an
HDL-32, an HDL-64 and a VLS-128 have them."""
HALF_VIEW = np.radians([35.2, 33.6])
"""Half the field of view of a solid-state LiDAR without its fan of lines, across and up."""
FAN = np.radians(10.0)
"""How far its lowest line is from its highest one."""
TURNS_HZ = (121.57, -77.73)
"""Of its prisms: those of a Livox Mid-40."""


@dataclass(frozen=True)
class Scanner:
    """A pattern.

    Attributes:
        pattern: "rotating" or "solid_state".
        beams: above each other.
        columns: steps of a sweep; all beams leave in each.
        period: of a sweep, seconds.
        view: lowest and highest beam of a rotating one, radians.
    """

    pattern: str
    beams: int
    columns: int
    period: float
    view: tuple[float, float] = (0.0, 0.0)

    @property
    def delays(self) -> Array:
        """Return (columns,) when the steps are, seconds since the sweep began."""
        return self.period * np.arange(self.columns) / self.columns

    def directions(self, time: float) -> Array:
        """Return (columns, beams, 3) of a sweep that begins at a time, in the LiDAR's frame."""
        if self.pattern == "rotating":
            azimuth = np.pi - 2 * np.pi * np.arange(self.columns) / self.columns
            azimuth = np.broadcast_to(azimuth[:, None], (self.columns, self.beams))
            elevation = np.broadcast_to(self.elevations, azimuth.shape)
        else:
            first, second = (2 * np.pi * hz * (time + self.delays) for hz in TURNS_HZ)
            across = HALF_VIEW[0] * (np.cos(first) + np.cos(second)) / 2
            up = HALF_VIEW[1] * (np.sin(first) + np.sin(second)) / 2
            fan = FAN * (np.arange(self.beams) / max(self.beams - 1, 1) - 0.5)
            azimuth = np.broadcast_to(across[:, None], (self.columns, self.beams))
            elevation = up[:, None] + fan
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=2)

    @property
    def elevations(self) -> Array:
        """Return (beams,) of a rotating one, the lowest first, radians."""
        low, high = self.view
        if self.view == (0.0, 0.0):
            low, high = next(np.radians(v) for n, *v in ELEVATIONS if self.beams <= n)
        return np.linspace(low, high, self.beams) if self.beams > 1 else np.zeros(1)


@dataclass(frozen=True)
class Measured:
    """What a sweep says.

    Attributes:
        sweep: what returned, in the order it came.
        rows: (N,) of each point among all beams, step · beams + beam.
    """

    sweep: Sweep
    rows: NDArray[np.int64]


def measure(
    directions: Array, delays: Array, rays: Array, distance: Array, hit: Ids, albedos: F32,
    normals: Array, nearest: float, noise: LidarNoise, rng: np.random.Generator,
) -> Measured:  # fmt: skip
    """Measure a sweep.

    Args:
        directions: (S, B, 3) of the beams in the LiDAR.
        delays: (S,) of the steps, seconds.
        rays: (S, 3, 3) rotations R_world_lidar of the steps.
        distance: (S, B) true ones, metres.
        hit: (S, B) which surface was met; below 0 and the same for none, or the ground.
        albedos: (S, B) of what was met; 0 where nothing was.
        normals: (S, B, 3) of what was met, in the world; NaN where it has none.
        nearest: what is nearer does not return, metres.
        noise: how wrong it is.
        rng: where the noise comes from.
    """
    steps, beams = distance.shape
    gauss = rng.standard_normal((steps, beams), np.float32)
    chances = rng.random((2, steps, beams), np.float32)
    points, intensities = np.empty((steps * beams, 3)), np.empty(steps * beams, np.float32)
    rows = np.empty(steps * beams, np.int64)
    wrong = np.array([noise.range_m, noise.dropout, noise.mixed, noise.divergence, nearest])
    count = _measure_kernel(
        directions, rays, distance, hit, albedos, normals, gauss, chances, wrong,
        points, intensities, rows,
    )  # fmt: skip
    rows = rows[:count].copy()
    step = rows // beams
    return Measured(
        Sweep(
            points[:count].copy(),
            delays[step],
            intensities[:count].copy(),
            (rows - step * beams).astype(np.int16),
        ),
        rows,
    )


@kernel
def _measure_kernel(
    directions: Array, rays: Array, distance: Array, hit: Ids, albedos: F32, normals: Array,
    gauss: F32, chances: F32, noise: Array, points: Array, intensities: F32,
    rows: NDArray[np.int64],
) -> int:  # fmt: skip
    """Write what returns: r d with r = r₀ + σ(1 + r₀/50) n, 255 · albedo · cosine, and its row.

    noise: σ, share lost, share mixed, half width of a beam, nearest range. Returns how many.
    """
    count, most = 0, 4.0 * noise[2]
    steps, beams = distance.shape
    for s in range(steps):
        for b in range(beams):
            if albedos[s, b] <= 0.0:
                continue
            r = distance[s, b]
            x, y, z = directions[s, b, 0], directions[s, b, 1], directions[s, b, 2]
            cosine = 0.0
            for axis in range(3):
                along = rays[s, axis, 0] * x + rays[s, axis, 1] * y + rays[s, axis, 2] * z
                cosine -= normals[s, b, axis] * along
            if np.isnan(cosine):  # leaves hang at all angles
                cosine = 0.5
            lost = noise[1] * (5.0 if cosine < 0.1 else 1.0)
            if chances[0, s, b] < lost:
                continue
            chance = chances[1, s, b]
            for side in range(4 if chance < most else 0):
                u = s + (1 if side == 0 else -1 if side == 1 else 0)
                c = b + (1 if side == 2 else -1 if side == 3 else 0)
                if u < 0 or c < 0 or u >= steps or c >= beams or hit[u, c] == hit[s, b]:
                    continue
                if albedos[u, c] <= 0.0 or abs(distance[u, c] - distance[s, b]) < 0.1:
                    continue
                square = 0.0
                for axis in range(3):
                    square += (directions[s, b, axis] - directions[u, c, axis]) ** 2
                touches = noise[2] * min(1.0, 0.4 * noise[3] / max(np.sqrt(square), 1e-9))
                if 0.0 <= chance < touches:
                    weight = chance / touches
                    r = weight * r + (1.0 - weight) * distance[u, c]
                chance -= touches
            r += noise[0] * (1.0 + r / 50.0) * gauss[s, b]
            if r < noise[4]:
                continue
            points[count, 0], points[count, 1], points[count, 2] = r * x, r * y, r * z
            intensities[count] = 255.0 * albedos[s, b] * max(cosine, 0.0)
            rows[count] = s * beams + b
            count += 1
    return count


def warm_up() -> None:
    """Compile the kernels of this file."""
    one, beam = np.ones((1, 1)), np.array([[[1.0, 0.0, 0.0]]])
    measure(
        beam, np.zeros(1), np.eye(3)[None], one, one.astype(np.int32), one.astype(np.float32),
        -beam, 0.1, LidarNoise(), np.random.default_rng(0),
    )  # fmt: skip
