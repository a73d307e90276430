"""One run of SLAM that closes loops, and what is said of it (`loops.py`)."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import OdomapError
from odomap.evaluation.consistency import consistency
from odomap.evaluation.match import rotation_angle
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_inverse
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Status
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.config import Config
from odomap.system.slam import Slam
from odomap.system.stages import Loop
from odomap.system.system import Result

Array = NDArray[np.float64]
Index = NDArray[np.int64]

HIDDEN = 20
"""Frames after which a keyframe is hidden from tracker and mapper where the closer is alone."""
FALSE_M, FALSE_SHARE, FALSE_DEG = 0.3, 0.05, 10.0
"""A measured loop is false if it is off by more than that, and that part of what lies between."""


class Forgetful(Map):
    """A map of which trackers and mappers know what is new only, until a loop brings back the rest.

    Args:
        memory_ns: age at which a keyframe is hidden from those that look for it.
    """

    def __init__(self, memory_ns: int) -> None:
        super().__init__()
        self._memory_ns = memory_ns

    def near(self, T_world_body: Array, radius: float, angle: float) -> Index:
        """Return keyframes around a pose, but no old ones."""
        ids = super().near(T_world_body, radius, angle)
        return ids[self._is_near_in_time(ids, self.keyframe_ids[-1])]

    def observing(self, landmark_ids: ArrayLike) -> tuple[Index, Index]:
        """Count who sees some landmarks, but for old keyframes."""
        ids, counts = super().observing(landmark_ids)
        kept = self._is_near_in_time(ids, self.keyframe_ids[-1])
        return ids[kept], counts[kept]

    def covisible(self, keyframe_id: int) -> tuple[Index, Index]:
        """Count what a keyframe sees together with others of its time."""
        ids, counts = super().covisible(keyframe_id)
        kept = self._is_near_in_time(ids, keyframe_id)
        return ids[kept], counts[kept]

    def _is_near_in_time(self, ids: Index, keyframe_id: int) -> NDArray[np.bool_]:
        if len(self.edges().i):
            return np.ones(len(ids), np.bool_)
        now = self.keyframe(int(keyframe_id)).stamp_ns
        apart = [abs(self.keyframe(k).stamp_ns - now) for k in ids.tolist()]
        return np.array(apart, np.int64) <= self._memory_ns


@dataclass(frozen=True)
class Case:
    """What a run came to.

    Attributes:
        name: of the run.
        frames, lost: how many there were, and how many could not be placed.
        path_m: true length of the path.
        ate_m: RMSE of the absolute error.
        end_m, end_deg: error of the last pose seen from the first.
        nees: of all keyframes, per degree of freedom, in the frame of the first.
        keyframes: in the map at the end.
        loops: accepted.
        false: of them those that are not where the truth says.
        reused: keyframes that share landmarks with ones of an earlier visit, loop or none.
        said: of each false loop how far it is off, and why candidates were refused.
    """

    name: str
    frames: int
    lost: int
    path_m: float
    ate_m: float
    end_m: float
    end_deg: float
    nees: float
    keyframes: int
    loops: int
    false: int
    reused: int
    said: list[str] = field(default_factory=list)

    @property
    def percent(self) -> float:
        """Return the error in percent of the path."""
        return 100.0 * self.ate_m / self.path_m


HEADER = (
    f"{'':26}{'frames':>7}{'lost':>5}{'path':>8}{'ATE, m':>9}{'%':>7}{'end, m':>9}{'deg':>7}"
    f"{'NEES':>7}{'kf':>5}{'loops':>6}{'false':>6}{'refused':>8}{'tied':>6}"
)


def cells(case: Case) -> str:
    """Return a line of the table."""
    return (
        f"{case.name:26}{case.frames:7d}{case.lost:5d}{case.path_m:8.1f}{case.ate_m:9.4f}"
        f"{case.percent:7.3f}{case.end_m:9.4f}{case.end_deg:7.3f}{case.nees:7.2f}"
        f"{case.keyframes:5d}{case.loops:6d}{case.false:6d}{len(case.said) - case.false:8d}"
        f"{case.reused:6d}"
    )


def closing(config: Config, is_enabled: bool = True) -> Config:
    """Return a configuration that closes loops, or does not."""
    return replace(config, closing=replace(config.closing, enabled=is_enabled))


def play(
    name: str,
    frames: Iterable[Frame],
    rig: Rig,
    truth: Trajectory,
    config: Config,
    rhythm: str = "lockstep",
    map: Map | None = None,
) -> tuple[Case, Result]:
    """Play frames to SLAM and judge what comes of it."""
    system, loops = Slam(rig, config, rhythm, map=map), list[Loop]()
    system.worker.on_loop.append(loops.append)
    statuses = [system.track(frame).status for frame in frames]
    result = system.finish()
    return judged(name, statuses, result, loops, truth), result


def judged(
    name: str, statuses: list[Status], result: Result, loops: list[Loop], truth: Trajectory
) -> Case:
    """Say what a run came to."""
    true = result.truth(truth)
    error = ate(result.trajectory, true, "se3" if result.is_metric else "sim3")
    end_m, end_deg = end_error(result.trajectory, true, error.scale)
    try:
        nees = consistency(result.keyframes, true).per_dof if result.is_metric else np.nan
    except OdomapError:
        nees = np.nan
    accepted = [loop for loop in loops if loop.is_accepted]
    false = [said for loop in accepted if (said := falsehood(loop, result, true, error.scale))]
    return Case(
        name,
        len(statuses),
        statuses.count(Status.LOST),
        truth.path_length,
        error.rmse,
        end_m,
        end_deg,
        nees,
        result.map.num_keyframes,
        len(accepted),
        len(false),
        num_reused(result.map),
        false + [loop.reason for loop in loops if not loop.is_accepted],
    )


def end_error(path: Trajectory, truth: Trajectory, scale: float) -> tuple[float, float]:
    """Return how far the last pose is off as seen from the first, metres and degrees."""
    ours, theirs = path.associate(truth)
    Ts, true = path.Ts_world_body[ours[[0, -1]]], truth.Ts_world_body[theirs[[0, -1]]]
    return off(se3_inverse(Ts[0]) @ Ts[1], se3_inverse(true[0]) @ true[1], scale)


def off(T: Array, true: Array, scale: float) -> tuple[float, float]:
    """Return how far a relative pose is off, metres and degrees."""
    angle = rotation_angle((true[:3, :3].T @ T[:3, :3])[None])[0]
    return float(np.linalg.norm(scale * T[:3, 3] - true[:3, 3])), float(np.degrees(angle))


def falsehood(loop: Loop, result: Result, truth: Trajectory, scale: float) -> str:
    """Say how far a loop is from where the truth says, if that is too far; else nothing."""
    ends = [result.map.keyframe(k).stamp_ns for k in (loop.matched_id, loop.keyframe_id)]
    there, here = truth.Ts_world_body[[int(np.abs(truth.stamps_ns - e).argmin()) for e in ends]]
    true = se3_inverse(there) @ here
    of_matched = scale * result.map.scale(loop.matched_id)
    metres, degrees = off(np.asarray(loop.T_matched_keyframe), true, of_matched)
    if metres <= FALSE_M + FALSE_SHARE * np.linalg.norm(true[:3, 3]) and degrees <= FALSE_DEG:
        return ""
    return (
        f"FALSE: {loop.matched_id} and {loop.keyframe_id}, {loop.num_inliers} inliers: "
        f"{metres:.3f} m and {degrees:.2f}° off"
    )


def num_reused(map: Map) -> int:
    """Return how many keyframes share landmarks with one from half the map ago."""
    ids = map.keyframe_ids
    far = len(ids) // 2
    shared = [np.searchsorted(ids, map.covisible(k)[0]) for k in ids.tolist()]
    return sum(bool((np.asarray(row) <= n - far).any()) for n, row in enumerate(shared))
