"""Worlds for a 2D laser on wheels: a plan, a way through it, scans and odometry, no images.

A robot drives a closed way in a floor plan, in its plane, and takes a scan at each frame; people
walk the same way. Nothing is rendered, so a scan costs a millisecond or two, and a world of ten
rounds of a building is there within a second. As everywhere, the seed decides it to the last byte,
and frames are made when they are asked for, in any order.

Ranges are wrong as those of the other laser (`lidar`): noise that grows with range, lost beams,
beams on an edge that return something between. The body is the middle of the wheels, the laser
stands ahead of it.

Reference: S. Thrun, W. Burgard and D. Fox, "Probabilistic robotics", 2005, ch. 6 (beam models).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.errors import ConfigError, nearest_name
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.simulation.floorplan import PLANS, Plan, make_plan
from odomap.simulation.lidar import LidarNoise
from odomap.simulation.path import Harmonics, Path, closed_route
from odomap.simulation.plancast import cast_plan
from odomap.simulation.wheels import WheelNoise, wheel_odometry
from odomap.simulation.world import START_NS

__all__ = ["LaserSpec", "LaserWorld"]

Array = NDArray[np.float64]

AHEAD_M = 0.2
"""How far ahead of the wheels the laser stands."""
NEAREST_M = 0.05
PERSON_M = (0.15, 0.3)
"""Radii of people at the height of a laser."""


@dataclass(frozen=True)
class LaserSpec:
    """What decides a world for a laser, to the last byte."""

    kind: str = "building"
    """"building" (corridor and rooms, 60 m round), "hall" (one room), "corridor" (straight, long
    and featureless) or "field" (nothing within reach)."""
    seed: int = 0
    """Which of the worlds of its kind."""
    frames: int = 0
    """How many scans there are; 0 for as many as the rounds take."""
    rounds: float = 1.0
    """How often the robot goes round, where frames do not say."""
    rate_hz: float = 10.0
    """Scans per second."""
    speed: float = 0.5
    """Mean speed in m/s."""
    noise: float = 1.0
    """Factor on all imperfections of the laser and of the wheels; 0 for ideal ones."""
    wheel_noise: float = 1.0
    """Factor on those of the wheels alone."""
    beams: int = 541
    """Of a scan."""
    fov_deg: float = 270.0
    """From the first beam to the last one."""
    range_m: float = 30.0
    """Beyond this nothing returns."""
    moving_objects: int = 0
    """How many people walk through the scene."""
    sensors: tuple[str, ...] = ("laser",)
    """A laser and wheels, always."""

    def __post_init__(self) -> None:
        if self.kind not in PLANS:
            known = ", ".join(PLANS)
            raise ConfigError(
                f"kind: '{self.kind}' is none of {known}, which have a plan for a laser"
                f"{nearest_name(self.kind, PLANS)}"
            )
        if self.sensors != ("laser",):
            raise ConfigError("sensors: 'laser' stands alone; with cameras choose lidar2d")
        for name, low in (("seed", 0), ("frames", 0), ("moving_objects", 0), ("beams", 1)):
            if getattr(self, name) < low:
                raise ConfigError(f"{name}: {getattr(self, name)} must be {low} or more")
        for name in ("rounds", "rate_hz", "speed", "range_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"{name}: {value} must be finite and above 0")
        for name in ("noise", "wheel_noise"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"{name}: {value} must be finite and not negative")
        if not 0 < self.fov_deg <= 360:
            raise ConfigError(f"fov_deg: {self.fov_deg} must be above 0 and at most 360")


class LaserWorld:
    """A floor plan driven through, with known truth.

    Attributes:
        spec: what decides it, with the number of frames.
        plan: the true walls.
        rig: the laser on its robot.
        truth: (frames) exact T_world_body, in the plan's frame.
        odometry: (frames, 4, 4) T_odom_body as the wheels say it.
    """

    def __init__(self, spec: LaserSpec) -> None:
        self.plan: Plan = make_plan(spec.kind, spec.seed)
        self._path = _drive(self.plan.way, spec)
        count = spec.frames or round(spec.rounds * spec.rate_hz / self._path.rounds_per_s) + 1
        self.spec = replace(spec, frames=count)
        self.rig = Rig(lidars=(_mount(spec),))
        self._seconds = np.arange(count) / spec.rate_hz
        stamps = START_NS + np.rint(self._seconds * 1e9).astype(np.int64)
        self.truth = Trajectory(stamps, self._path.at(self._seconds).Ts_world_body)
        wheels = WheelNoise().scaled(spec.noise * spec.wheel_noise)
        rng = np.random.default_rng([spec.seed, 29])
        self.odometry = wheel_odometry(self.truth.Ts_world_body, wheels, rng)
        self.odometry.setflags(write=False)
        self._people = _people(self.plan.way, spec)

    def __len__(self) -> int:
        return self.spec.frames

    def frame(self, index: int) -> Frame:
        """Take scan `index`.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return Frame(
            id=index,
            stamp_ns=int(self.truth.stamps_ns[index]),
            scan=self._measure(index),
            odometry=self.odometry[index],
        )

    def exact(self, index: int, *, people: bool = False) -> Array:
        """Return (beams,) true ranges at frame `index`, inf where nothing is within reach.

        Args:
            index: the frame's.
            people: whether people are met, too.
        """
        return self._cast(index, 0.0, people)[0]

    def hits(self, index: int) -> Array:
        """Return (N, 2) where the beams of frame `index` truly meet walls, in the plan's frame."""
        ranges = self.exact(index)
        met = np.isfinite(ranges)
        origin, directions = self._rays(index, 0.0)
        return np.asarray(origin + ranges[met, None] * directions[met])

    def _rays(self, index: int, off: Array | float) -> tuple[Array, Array]:
        mount = self.rig.lidars[0]
        T = self.truth.Ts_world_body[index] @ mount.T_body_lidar.matrix
        first, last, beams = mount.angles
        angles = np.arctan2(T[1, 0], T[0, 0]) + np.linspace(first, last, beams) + off
        return T[:2, 3], np.column_stack([np.cos(angles), np.sin(angles)])

    def _cast(self, index: int, off: Array | float, people: bool) -> tuple[Array, Array]:
        origin, directions = self._rays(index, off)
        discs = self.plan.pillars
        if people and self._people:
            now = self._seconds[index : index + 1]
            walkers = [(*path.at(now).Ts_world_body[0, :2, 3], r) for path, r in self._people]
            discs = np.concatenate([discs, np.array(walkers)])
        return cast_plan(self.plan.walls, discs, origin, directions, self.spec.range_m)

    def _measure(self, index: int) -> Array:
        """Return (beams,) measured ranges, NaN where a beam was lost."""
        noise = LidarNoise().scaled(self.spec.noise)
        rng = np.random.default_rng([self.spec.seed, index, 31])
        ranges, cosines = self._cast(index, 0.0, people=True)
        count = len(ranges)
        off = noise.divergence * rng.standard_normal(count)
        beside, _ = self._cast(index, off, people=True)
        weight, chance = rng.random(count), rng.random((2, count))
        met = np.isfinite(ranges)
        with np.errstate(invalid="ignore"):
            split = met & np.isfinite(beside) & (np.abs(beside - ranges) > 0.1)
        split &= chance[0] < noise.mixed
        measured = np.where(split, weight * ranges + (1 - weight) * beside, ranges)
        spread = noise.range_m * (1.0 + np.where(met, measured, 0.0) / 50.0)
        measured = measured + spread * rng.standard_normal(count)
        lost = chance[1] < noise.dropout * (1.0 + 4.0 * (cosines < 0.1))
        measured[(lost & met) | (measured < NEAREST_M)] = np.nan
        return measured


def _drive(way: Array, spec: LaserSpec) -> Path:
    """Return a planar path: an uneven speed, no sway and no tilt."""
    rng = np.random.default_rng([spec.seed, 37])
    round_m = float(np.linalg.norm(np.diff(way, axis=0, append=way[:1]), axis=1).sum())
    return Path(
        closed_route(way),
        spec.speed / round_m,
        Harmonics.random(rng, [[0.25 / round_m, 0.06 / round_m]], [0.11, 0.31]),
        _still(3),
        _still(3),
        start=float(rng.uniform()),
    )


def _still(dimensions: int) -> Harmonics:
    return Harmonics(np.zeros((dimensions, 1)), np.ones((dimensions, 1)), np.zeros((dimensions, 1)))


def _people(way: Array, spec: LaserSpec) -> list[tuple[Path, float]]:
    """Return people that walk beside the way, in either direction, and their radii."""
    rng = np.random.default_rng([spec.seed, 41])
    ahead = np.roll(way, -1, axis=0) - np.roll(way, 1, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(way))])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    round_m = float(np.linalg.norm(np.diff(way, axis=0, append=way[:1]), axis=1).sum())
    found = []
    for _ in range(spec.moving_objects):
        beside = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.55, 0.8))
        rate = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1.2)) / round_m
        still = _still(1), _still(3), _still(3)
        path = Path(closed_route(way + beside * left), rate, *still, start=float(rng.uniform()))
        found.append((path, float(rng.uniform(*PERSON_M))))
    return found


def _mount(spec: LaserSpec) -> LidarMount:
    half = np.radians(spec.fov_deg) / 2
    return LidarMount(
        "laser",
        SE3.from_parts(np.eye(3), np.array([AHEAD_M, 0.0, 0.0])),
        (NEAREST_M, spec.range_m),
        spec.rate_hz,
        "none",
        (-half, half, spec.beams),
    )
