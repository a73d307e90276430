"""Wheel odometry: where a body believes to be that counts the turns of its wheels.

From one time to the next the wheels measure how far the body went and how much it turned, both
wrongly: the wheels' size and distance are not quite those in the robot's settings, one wheel is
larger than the other, the ground is uneven, and now and then a wheel slips. With the true step
(d along the body's x, its lateral part, turn a) the measured one is

    d' = (1 + s) d + σ_d √|d| n₁,     a' = (1 + g) a + b |d| + (σ_a √|d| + σ_t √|a|) n₂

with s, g, b fixed for a robot and n white. The measured steps are put one after the other.

Reference: J. Borenstein, L. Feng, "Measurement and correction of systematic odometry errors in
mobile robots", IEEE Trans. Robotics and Automation 12(6), 1996.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse

__all__ = ["WheelNoise", "chain", "wheel_odometry"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WheelNoise:
    """How wrong wheels are: of the fixed errors standard deviations over robots."""

    scale: float = 0.015
    """Of distances."""
    turn_scale: float = 0.02
    """Of turns."""
    bend: float = 0.004
    """Turn per metre driven straight, rad/m."""
    step_m: float = 0.01
    """Per square root of a metre driven."""
    heading: float = 0.006
    """Radians per square root of a metre driven."""
    turning: float = 0.01
    """Radians per square root of a radian turned."""
    slips_per_m: float = 0.02
    """How often a wheel slips for one step."""

    def scaled(self, factor: float) -> "WheelNoise":
        """Return wheels with all imperfections times a factor."""
        return WheelNoise(**{f.name: factor * getattr(self, f.name) for f in fields(self)})


def wheel_odometry(Ts_world_body: Array, noise: WheelNoise, rng: np.random.Generator) -> Array:
    """Return what wheels say of a path.

    Args:
        Ts_world_body: (N, 4, 4) true poses, in a plane.
        noise: how wrong the wheels are.
        rng: where the errors come from.

    Returns:
        (N, 4, 4) T_odom_body; the first is the identity.
    """
    scale, gain, bend = rng.standard_normal(3) * (noise.scale, noise.turn_scale, noise.bend)
    steps = se3_inverse(Ts_world_body[:-1]) @ Ts_world_body[1:]
    turns = np.arctan2(steps[:, 1, 0], steps[:, 0, 0])
    distance = np.hypot(steps[:, 0, 3], steps[:, 1, 3])
    white = rng.standard_normal((2, len(steps)))
    stretch = scale * distance + noise.step_m * np.sqrt(distance) * white[0]
    slips = rng.random(len(steps)) < noise.slips_per_m * distance
    stretch += np.where(slips, distance * rng.uniform(-0.8, 0.8, len(steps)), 0.0)
    spread = noise.heading * np.sqrt(distance) + noise.turning * np.sqrt(np.abs(turns))
    turns = (1 + gain) * turns + bend * distance + spread * white[1]
    turns += np.where(slips, rng.normal(0, 0.02, len(steps)), 0.0) if noise.slips_per_m > 0 else 0.0
    measured = np.tile(np.eye(4), (len(steps), 1, 1))
    measured[:, 0, 0] = measured[:, 1, 1] = np.cos(turns)
    measured[:, 1, 0] = np.sin(turns)
    measured[:, 0, 1] = -measured[:, 1, 0]
    # The wheels stretch the way along itself, whatever its direction in the body.
    factor = 1 + stretch / np.maximum(distance, 1e-12)
    measured[:, :2, 3] = steps[:, :2, 3] * factor[:, None]
    return chain(measured)


def chain(steps: Array) -> Array:
    """Return (N + 1, 4, 4) poses that begin at the identity, of (N, 4, 4) steps between them."""
    poses = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    for k in range(len(steps)):
        poses[k + 1] = poses[k] @ steps[k]
    return poses
