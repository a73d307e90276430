"""Paths that are known exactly: pose, velocity, acceleration and angular rate at any time.

A carrier (a hand, a car) follows a closed route p(σ), a periodic spline of degree five through way
points, with the phase σ(t) running at an uneven speed, and sways about it:

    x(t) = p(σ(t)) + Σ aₖ sin(ωₖ t + φₖ),     ẋ = p′σ̇ + …,     ẍ = p″σ̇² + p′σ̈ + …

Its heading is that of the route, atan2(p′_y, p′_x), plus sinusoids; pitch and roll are sinusoids,
and of what climbs with the road the pitch is that of the route, too: R = Rz(ψ) Ry(θ) Rx(φ). Since
everything is a spline or a sine, all derivatives are analytic, so that an IMU made from them
integrates back to the path to the last digit of the integrator.

Cost: O(1) per time, vectorised over times.

Paper: J. Rehder et al., "Extending kalibr", ICRA 2016 (splines as exact motion models of IMUs).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

__all__ = ["Harmonics", "Motion", "Path", "closed_route", "hand_held", "vehicle"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Harmonics:
    """A sum of sinusoids in D dimensions.

    Attributes:
        amplitude: (D, K), in the unit of the result.
        omega: (D, K) angular frequencies, rad/s.
        phase: (D, K), radians.
    """

    amplitude: Array
    omega: Array
    phase: Array

    @classmethod
    def random(
        cls, rng: np.random.Generator, amplitudes: list[list[float]], hertz: list[float]
    ) -> "Harmonics":
        """Draw phases, and frequencies within 15 % of those given.

        Args:
            rng: where the numbers come from.
            amplitudes: D lists of K amplitudes.
            hertz: K frequencies.
        """
        amplitude = np.array(amplitudes, float)
        omega = 2 * np.pi * np.array(hertz) * rng.uniform(0.85, 1.15, amplitude.shape)
        return cls(amplitude, omega, rng.uniform(0, 2 * np.pi, amplitude.shape))

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return value, first and second derivative, each (N, D), at times (N,) in seconds."""
        angle = self.omega * times[:, None, None] + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        return (
            (self.amplitude * sine).sum(-1),
            (self.amplitude * self.omega * cosine).sum(-1),
            -(self.amplitude * self.omega**2 * sine).sum(-1),
        )


@dataclass(frozen=True)
class Motion:
    """State of a body along its path.

    Attributes:
        Ts_world_body: (N, 4, 4).
        v_world_body: (N, 3) velocity in the world, m/s.
        a_world_body: (N, 3) acceleration in the world without gravity, m/s².
        omega_body: (N, 3) angular rate in the body, rad/s.
    """

    Ts_world_body: Array
    v_world_body: Array
    a_world_body: Array
    omega_body: Array


@dataclass(frozen=True)
class Path:
    """A closed route travelled again and again, with sway.

    Attributes:
        route: periodic spline of the phase, one round per unit, three coordinates.
        rounds_per_s: mean rate of the phase.
        unevenness: one-dimensional, added to the phase.
        sway: three-dimensional, added to the position, metres.
        tilt: three-dimensional, added to yaw, pitch and roll, radians.
        R_carrier_body: (3, 3); the carrier has x forward, y left and z up.
        start: phase at time 0.
        climbs: whether it pitches up and down with the route.
    """

    route: BSpline
    rounds_per_s: float
    unevenness: Harmonics
    sway: Harmonics
    tilt: Harmonics
    R_carrier_body: Array = field(default_factory=lambda: np.eye(3))
    start: float = 0.0
    climbs: bool = False

    def at(self, times: Array) -> Motion:
        """Return the exact motion at times (N,) in seconds."""
        t = np.atleast_1d(np.asarray(times, np.float64))
        shift, shift_dot, shift_dot2 = (x[:, 0:1] for x in self.unevenness.at(t))
        phase = (self.start + self.rounds_per_s * t[:, None] + shift)[:, 0]
        rate, rate_dot = self.rounds_per_s + shift_dot, shift_dot2
        p, p1, p2 = (np.asarray(self.route(phase % 1.0, nu)) for nu in range(3))
        sway, sway_dot, sway_dot2 = self.sway.at(t)
        tilt, tilt_dot, _ = self.tilt.at(t)
        angles, rates = tilt.copy(), tilt_dot.copy()
        angles[:, 0] += np.arctan2(p1[:, 1], p1[:, 0])
        turning = (p1[:, 0] * p2[:, 1] - p1[:, 1] * p2[:, 0]) / (p1[:, 0] ** 2 + p1[:, 1] ** 2)
        rates[:, 0] += turning * rate[:, 0]
        if self.climbs:
            # θ = -atan(p′_z / g) with g = |p′_xy|: positive pitch is nose down.
            g = np.hypot(p1[:, 0], p1[:, 1])
            faster = (p1[:, 0] * p2[:, 0] + p1[:, 1] * p2[:, 1]) / g
            climbing = (p2[:, 2] * g - p1[:, 2] * faster) / (g**2 + p1[:, 2] ** 2)
            angles[:, 1] -= np.arctan2(p1[:, 2], g)
            rates[:, 1] -= climbing * rate[:, 0]
        Ts = np.tile(np.eye(4), (len(t), 1, 1))
        Ts[:, :3, :3] = _rotation(angles) @ self.R_carrier_body
        Ts[:, :3, 3] = p + sway
        return Motion(
            Ts,
            p1 * rate + sway_dot,
            p2 * rate**2 + p1 * rate_dot + sway_dot2,
            _body_rates(angles, rates) @ self.R_carrier_body,
        )


def _rotation(angles: Array) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll) of (N, 3) yaw, pitch, roll."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles).T, np.sin(angles).T
    return np.stack(
        [
            np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], -1),
            np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], -1),
            np.stack([-sp, cp * sr, cp * cr], -1),
        ],
        -2,
    )


def _body_rates(angles: Array, rates: Array) -> Array:
    """Angular rate in the carrier from the rates of yaw, pitch and roll."""
    (_, cp, cr), (_, sp, sr) = np.cos(angles).T, np.sin(angles).T
    yaw, pitch, roll = rates.T
    return np.stack([roll - yaw * sp, pitch * cr + yaw * cp * sr, yaw * cp * cr - pitch * sr], -1)


def closed_route(points: Array) -> BSpline:
    """Return the periodic quintic spline of phase 0 to 1 through way points (N, 3), N at least 6.

    The phase advances with the distance between the points, so that the speed is nearly even.
    """
    closed = np.vstack([points, points[:1]])
    steps = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    knots = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return make_interp_spline(knots, closed, k=5, bc_type="periodic")


def hand_held(points: Array, speed: float, rng: np.random.Generator, R_carrier_body: Array) -> Path:
    """Walk a route with a device in the hand: steps, tremor, looking around.

    Args:
        points: (N, 3) way points of the closed route, metres.
        speed: mean speed along it, m/s.
        rng: where the numbers come from.
        R_carrier_body: (3, 3) axes of the body in the carrier.
    """
    round_m = float(np.linalg.norm(np.diff(points, axis=0, append=points[:1]), axis=1).sum())
    hertz = [0.13, 0.37, 0.9, 1.9, 4.1]
    sway = [[0.06, 0.03, 0.008, 0.004, 0.0007]] * 2 + [[0.08, 0.04, 0.008, 0.008, 0.0007]]
    tilt = [
        [0.22, 0.08, 0.02, 0.006, 0.0015],
        [0.08, 0.06, 0.02, 0.006, 0.0015],
        [0.08, 0.05, 0.02, 0.006, 0.0015],
    ]
    return Path(
        closed_route(points),
        speed / round_m,
        Harmonics.random(rng, [[0.25 / round_m, 0.06 / round_m]], [0.11, 0.31]),
        Harmonics.random(rng, sway, hertz),
        Harmonics.random(rng, tilt, hertz),
        R_carrier_body,
        float(rng.uniform()),
    )


def vehicle(
    points: Array, speed: float, rng: np.random.Generator, R_carrier_body: Array, *,
    start: float | None = None, climbs: bool = False,
) -> Path:  # fmt: skip
    """Drive a route on springs: gentle roll and pitch, road shake, uneven speed.

    Args:
        points: (N, 3) way points of the closed route at the height of the body, metres.
        speed: mean speed along it, m/s.
        rng: where the numbers come from.
        R_carrier_body: (3, 3) axes of the body in the carrier.
        start: phase at time 0; default a random one.
        climbs: whether it pitches up and down with the route.
    """
    round_m = float(np.linalg.norm(np.diff(points, axis=0, append=points[:1]), axis=1).sum())
    hertz = [0.05, 0.17, 1.1, 2.7]
    return Path(
        closed_route(points),
        speed / round_m,
        Harmonics.random(rng, [[5.0 / round_m, 0.8 / round_m]], [0.03, 0.11]),
        Harmonics.random(
            rng, [[0.10, 0.03, 0.003, 0.001]] * 2 + [[0.03, 0.02, 0.01, 0.004]], hertz
        ),
        Harmonics.random(
            rng,
            [
                [0.010, 0.006, 0.0015, 0.0004],
                [0.008, 0.008, 0.006, 0.0015],
                [0.012, 0.010, 0.005, 0.0015],
            ],
            hertz,
        ),
        R_carrier_body,
        float(rng.uniform()) if start is None else start,
        climbs,
    )
