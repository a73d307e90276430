"""Faults of cameras in a simulated room, and a judge of what a system claims while they last.

A fault is a recording, disturbed. The judge holds every estimate against the truth: it must be
finite; if it claims a pose, that pose must be right within 2 % of the way (and of all turns) and
four standard deviations of what it claims, and must not be reached by a leap; if it claims none, it
must say why.

Poses are aligned once, on the frames before the fault; those of a single camera again after each
new start, which says that its scale is new.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from odomap.geometry.lie import se3_exp, se3_inverse, so3_log
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Status
from odomap.sensors.rig import Rig
from odomap.simulation.path import Motion
from odomap.simulation.world import World, WorldSpec
from odomap.sources.disturb import (
    blank,
    blur,
    cover,
    drop,
    duplicate,
    exposure_jumps,
    freeze,
    kill_right,
    moving_object,
    overexpose,
)

SPEC = WorldSpec(
    kind="room",
    seed=3,
    frames=40,
    rate_hz=12.0,
    resolution=(320, 200),
    sensors=("stereo", "depth"),
)
"""What befalls a pair or a camera with depth."""
ALONE = replace(SPEC, resolution=(480, 300), sensors=("mono",))
"""What befalls a single camera: it sees more finely, else it has not started when faults begin."""
FIRST = 14
"""No fault begins before this frame."""
SHARE_OF_WAY = 0.02
SIGMAS = 4.0
LEAST = np.array([0.01, 0.01])
"""How far off a pose may be in any case, metres and radians."""
LEAP = 3.0
"""How many times faster than it ever is the body may seem between two frames."""


class Kept:
    """Frames of a world, rendered once: a source that can be read in any order."""

    def __init__(self, world):
        self.name, self.rig, self.truth = "room", world.rig, world.truth
        self.skipped, self.stamps_ns = [], world.truth.stamps_ns
        self._frames = [world.frame(k) for k in range(len(world))]
        for frame in self._frames:
            for array in frame.arrays():
                array.flags.writeable = False

    def __len__(self):
        return len(self._frames)

    def __iter__(self):
        return iter(self._frames)

    def frame(self, index):
        return self._frames[index]


class TurningWorld(World):
    """A world whose camera stops for a while, and turns on the spot."""

    def __init__(self, spec, first_s=1.3, last_s=2.3, angle=0.5):
        super().__init__(spec)
        self._path = _Turning(self._path, self._T_imu_body, first_s, last_s, angle)
        self.truth = Trajectory(self._stamps, self._at(self._stamps))


@dataclass(frozen=True)
class _Turning:
    """A path on which the body's place and pose stand still from first to last, but for a turn."""

    path: object
    T_imu_body: np.ndarray
    first: float
    last: float
    angle: float

    def at(self, times):
        t = np.atleast_1d(np.asarray(times, float))
        along = np.where(t < self.first, t, np.maximum(self.first, t - self.last + self.first))
        motion = self.path.at(along)
        share = np.clip((t - self.first) / (self.last - self.first), 0, 1)
        turn = self.angle * share**2 * (3 - 2 * share)
        # About the camera's vertical axis, through its centre.
        turns = se3_exp(np.stack([0 * t, 0 * t, 0 * t, 0 * t, turn, 0 * t], axis=1))
        Ts_world_body = motion.Ts_world_body @ self.T_imu_body @ turns
        return Motion(
            Ts_world_body @ se3_inverse(self.T_imu_body),
            motion.v_world_body,
            motion.a_world_body,
            motion.omega_body,
        )


def carrying(source, sensors):
    """Return a recording with the rig of one kind of system: stereo, mono or rgbd."""
    rig = source.rig
    cameras = rig.cameras[: 2 if sensors == "stereo" else 1]
    depth = rig.depth if sensors == "rgbd" else None
    return _Carrying(source, Rig(cameras=cameras, depth=depth))


class _Carrying:
    """A recording of which a part of the sensors is looked at."""

    def __init__(self, source, rig):
        self.name, self.rig, self.truth = source.name, rig, source.truth
        self.skipped, self.stamps_ns = [], source.stamps_ns
        self._source = source

    def __len__(self):
        return len(self._source)

    def __iter__(self):
        return map(self.frame, range(len(self)))

    def frame(self, index):
        frame = self._source.frame(index)
        depth = frame.depth if self.rig.depth is not None else None
        return replace(frame, images=frame.images[: len(self.rig.cameras)], depth=depth)


FAULTS = {
    "none": lambda s: s,
    "blank": lambda s: blank(s, range(18, 22)),
    "over-exposed": lambda s: overexpose(s, range(18, 22)),
    "frozen": lambda s: freeze(s, range(18, 21)),
    "frozen for long": lambda s: freeze(s, range(18, 27)),
    "duplicated": lambda s: duplicate(s, range(14, 36, 4)),
    "same stamp twice": lambda s: duplicate(s, range(14, 36, 4), same_stamp=True),
    "every third dropped": lambda s: drop(s, range(14, 40, 3)),
    "exposure jumps": lambda s: exposure_jumps(s, 4, (1.0, 1.0, 1.0, 1.0, 1.8, 0.5)),
    "hand over the lens": lambda s: cover(s, range(16, 27)),
    "object crossing": lambda s: moving_object(s, range(14, 32)),
    "object lingering": lambda s: moving_object(s, range(14, 32), crossing=0.25),
    "object coming along": lambda s: moving_object(s, range(14, 32), crossing=0.0),
    "blur": lambda s: blur(s, range(18, 22), 12.0, 20.0),
}
"""What befalls any camera: recording to disturbed recording."""
PAIR_FAULTS = {
    "exposure of one jumps": lambda s: exposure_jumps(
        s, 4, (1.0, 1.0, 1.0, 1.0, 1.8, 0.5), cameras=[1]
    ),
    "hand over the right": lambda s: cover(s, range(16, 27), cameras=[1]),
    "right missing": lambda s: kill_right(s, 20),
    "right black": lambda s: kill_right(s, 20, "black"),
    "right frozen": lambda s: kill_right(s, 20, "frozen"),
}
"""What befalls a stereo pair only."""
TURN = "pure rotation"
"""A fault of the path, not of the camera: it has a world of its own."""


def faults_of(sensors):
    """Return the names of the faults that a kind of system can have."""
    return [*FAULTS, TURN, *(PAIR_FAULTS if sensors == "stereo" else ())]


class Recordings:
    """What the faults befall, rendered once."""

    def __init__(self, seed=SPEC.seed):
        self._seed, self._rendered = seed, {}

    def disturbed(self, sensors, fault):
        """Return the recording for a kind of system (stereo, mono, rgbd) with a fault."""
        spec = replace(ALONE if sensors == "mono" else SPEC, seed=self._seed)
        kind = TurningWorld if fault == TURN else World
        if (spec, kind) not in self._rendered:
            self._rendered[spec, kind] = Kept(kind(spec))
        source = carrying(self._rendered[spec, kind], sensors)
        return source if fault == TURN else (FAULTS | PAIR_FAULTS)[fault](source)


@dataclass(frozen=True)
class Judgement:
    """What came of a run.

    Attributes:
        wrong: what breaks a rule, one sentence each.
        num_lost: frames without a pose, since the first that has one.
        largest_m: largest error of a pose that was claimed, metres.
        largest_deg: the same of its direction.
        num_leaps: steps between frames that no body makes.
        is_tracking: whether the last frames have poses.
    """

    wrong: list[str]
    num_lost: int
    largest_m: float
    largest_deg: float
    num_leaps: int
    is_tracking: bool


def judge(source, estimates, is_metric=True):
    """Hold the estimates of a run over a disturbed recording against its truth."""
    stamps, at = np.unique([e.stamp_ns for e in estimates], return_inverse=True)
    true = source.truth.interpolate(stamps).Ts_world_body[at]
    way = np.zeros((len(true), 2))
    way[1:] = np.cumsum([_size(se3_inverse(a) @ b) for a, b in pairwise(true)], axis=0)
    fastest = _fastest(source.truth)
    wrong = [line for e in estimates for line in _malformed(e)]
    largest, leaps = np.zeros(2), []
    for part in _parts(estimates, is_metric):
        scale, T = _aligned(part, estimates, true, is_metric)
        for k in part:
            e = estimates[k]
            error = _size(se3_inverse(true[k]) @ T @ _scaled(e, scale))
            largest = np.maximum(largest, error)
            allowed = SIGMAS * _sigmas(e, scale) + LEAST + SHARE_OF_WAY * way[k]
            if np.any(error > allowed):
                wrong.append(f"{_name(e)}: off by {_spoken(error)}, allowed {_spoken(allowed)}")
        for a, b in pairwise(part):
            before, e = estimates[a], estimates[b]
            if b == a + 1 and e.status is Status.TRACKING:
                step = _size(se3_inverse(_scaled(before, scale)) @ _scaled(e, scale))
                seconds = (e.stamp_ns - before.stamp_ns) * 1e-9
                if np.any(step > LEAP * fastest * seconds + 0.02):
                    leaps.append(f"{_name(e)}: leaps by {_spoken(step)}")
    placed = [_is_placed(e) for e in estimates]
    return Judgement(
        wrong + leaps,
        placed[placed.index(True) :].count(False) if any(placed) else len(placed),
        float(largest[0]),
        float(np.degrees(largest[1])),
        len(leaps),
        all(placed[-4:]),
    )


def _fastest(truth):
    """Return the largest speed and rate of turning of a path."""
    seconds = np.diff(truth.stamps_ns) * 1e-9
    steps = se3_inverse(truth.Ts_world_body[:-1]) @ truth.Ts_world_body[1:]
    return np.max([_size(step) / dt for step, dt in zip(steps, seconds, strict=True)], axis=0)


def _size(T):
    """Return length and angle of a motion."""
    return np.array([np.linalg.norm(T[:3, 3]), np.linalg.norm(so3_log(T[:3, :3]))])


def _name(e):
    return f"frame {e.frame_id} ({e.status})"


def _spoken(size):
    return f"{size[0]:.3f} m and {np.degrees(size[1]):.2f}°"


def _malformed(e):
    """Say what is wrong with an estimate whatever the truth."""
    name = _name(e)
    poses = e.T_world_body.matrix, e.T_keyframe_body.matrix
    if not all(np.isfinite(x).all() for x in (*poses, e.covariance)):
        yield f"{name}: not finite"
        return
    largest = np.abs(e.covariance).max()
    if np.abs(e.covariance - e.covariance.T).max() > 1e-9 * largest:
        yield f"{name}: the covariance is not symmetric"
    elif np.linalg.eigvalsh(e.covariance).min() < -1e-9 * largest:
        yield f"{name}: the covariance is negative"
    if e.status in (Status.LOST, Status.INITIALIZING) and not e.reason:
        yield f"{name}: no reason"


def _is_placed(e):
    return e.status in (Status.TRACKING, Status.RECOVERED)


def _parts(estimates, is_metric):
    """Return the rows of the frames that claim a pose, apart where a scale ends."""
    parts = [[]]
    for k, e in enumerate(estimates):
        if e.status is Status.INITIALIZING and not is_metric and parts[-1]:
            parts.append([])
        elif _is_placed(e):
            parts[-1].append(k)
    return [part for part in parts if part]


def _aligned(part, estimates, true, is_metric):
    """Return scale and T_true_ours, from a part's frames before the fault, or its first ones."""
    rows = [k for k in part if estimates[k].frame_id < FIRST] or part[:10]
    ours = np.array([estimates[k].T_world_body.matrix for k in rows])
    U, _, Vt = np.linalg.svd(np.sum(true[rows, :3, :3] @ np.swapaxes(ours[:, :3, :3], 1, 2), 0))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    a, b = ours[:, :3, 3] @ R.T, true[rows, :3, 3]
    a_mid, b_mid = a.mean(0), b.mean(0)
    scale = (
        1.0 if is_metric else float(np.sum((a - a_mid) * (b - b_mid)) / np.sum((a - a_mid) ** 2))
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, b_mid - scale * a_mid
    return scale, T


def _scaled(e, scale):
    T = np.array(e.T_world_body.matrix)
    T[:3, 3] *= scale
    return T


def _sigmas(e, scale):
    variances = np.maximum(np.nan_to_num(np.diag(e.covariance)), 0)
    return np.sqrt([scale**2 * variances[:3].sum(), variances[3:].sum()])
