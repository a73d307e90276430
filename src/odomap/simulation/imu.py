"""What an inertial measurement unit says along a path.

    gyro = ω + b_g + n_g,      accel = Rᵀ (a - g) + b_a + n_a,      g = (0, 0, -9.81)

with white noise of density σ, σ/√Δt per sample, and biases that walk, b ← b + σ_w √Δt n. The
walk of a whole recording is drawn once from the seed: any stretch of it is the same in any order.

Cost: O(1) per sample.

Paper: C. Forster et al., "On-manifold preintegration for real-time visual-inertial odometry",
T-RO 2017.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.sensors.frame import ImuSamples
from odomap.sensors.rig import ImuMount
from odomap.simulation.path import Path

__all__ = ["GRAVITY", "imu_samples"]

GRAVITY = np.array([0.0, 0.0, -9.81])


def imu_samples(
    path: Path, stamps_ns: NDArray[np.int64], mount: ImuMount, seed: int, start_ns: int
) -> ImuSamples:
    """Measure along a path; the IMU is the body.

    Args:
        path: of the body.
        stamps_ns: (N,) increasing; path time 0 is at `start_ns`.
        mount: rate and noise densities.
        seed: which noise; the samples of a recording are to be drawn in one call.
        start_ns: stamp of the path's beginning.

    Returns:
        The samples.
    """
    motion = path.at(np.asarray(stamps_ns - start_ns, np.float64) * 1e-9)
    R = motion.Ts_world_body[:, :3, :3]
    accel = np.einsum("nji,nj->ni", R, motion.a_world_body - GRAVITY)
    rng = np.random.default_rng([seed, 5])
    step = 1.0 / mount.rate_hz
    noise = rng.standard_normal((4, len(stamps_ns), 3))
    gyro = motion.omega_body + mount.gyro_noise / np.sqrt(step) * noise[0]
    gyro += _walk(noise[1], mount.gyro_walk * np.sqrt(step), rng, 150.0 * mount.gyro_walk)
    accel += mount.accel_noise / np.sqrt(step) * noise[2]
    accel += _walk(noise[3], mount.accel_walk * np.sqrt(step), rng, 10.0 * mount.accel_walk)
    return ImuSamples(stamps_ns, gyro, accel)


def _walk(
    noise: NDArray[np.float64], step: float, rng: np.random.Generator, at_start: float
) -> NDArray[np.float64]:
    """Return the bias: a random start, then a random walk."""
    walk: NDArray[np.float64] = at_start * rng.standard_normal(3) + np.cumsum(noise * step, axis=0)
    return walk
