"""The path: frames as they hang from keyframes.

A frame is stored as its pose relative to a keyframe, T_keyframe_body, never in the world. When
keyframes move, the frames hang along; the final path is read off when it is asked for. The
covariance of a frame is that of its keyframe, carried over, plus that of the relative pose:

    Σ_frame = Ad(T_body_keyframe) Σ_keyframe Ad(T_body_keyframe)ᵀ + Σ_relative.

Reference: Barfoot, Furgale, "Associating Uncertainty With Three-Dimensional Poses", T-RO 2014.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint, se3_inverse, se3_log
from odomap.geometry.trajectory import Trajectory
from odomap.maps.map import Map

__all__ = ["Path", "Placed"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Placed:
    """A frame that hangs from a keyframe.

    Attributes:
        stamp_ns: its time.
        keyframe_id: the keyframe.
        T_keyframe_body: (4, 4).
        covariance: (6, 6) of T_keyframe_body.
    """

    stamp_ns: int
    keyframe_id: int
    T_keyframe_body: Array
    covariance: Array


class Path:
    """The frames placed so far in one map."""

    def __init__(self, map: Map) -> None:
        self._map = map
        self._frames: list[Placed] = []
        self._live: list[tuple[Array, Array]] = []

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def last(self) -> Placed:
        """The last frame placed."""
        return self._frames[-1]

    def append(self, frame: Placed) -> tuple[Array, Array]:
        """Add a frame; return its pose (4, 4) and covariance (6, 6) in the world as known now."""
        self._frames.append(frame)
        self._live.append((self._pose(frame), self.covariance(frame)))
        return self._live[-1]

    def last_pose(self) -> Array:
        """Return the last frame's T_world_body (4, 4) as known now; identity if there is none."""
        return self._pose(self._frames[-1]) if self._frames else np.eye(4)

    def last_covariance(self) -> Array:
        """Return the last frame's covariance (6, 6) as known now; zero before there is one."""
        return self.covariance(self._frames[-1]) if self._frames else np.zeros((6, 6))

    def velocity(self) -> Array:
        """Return the twist (6,) between the last two frames, per second; zero if they are apart."""
        if len(self._frames) < 2:
            return np.zeros(6)
        before, last = self._frames[-2:]
        dt = (last.stamp_ns - before.stamp_ns) * 1e-9
        if not 0.0 < dt <= 1.0:
            return np.zeros(6)
        return np.asarray(se3_log(se3_inverse(self._pose(before)) @ self._pose(last)) / dt)

    def covariance(self, frame: Placed) -> Array:
        """Return the covariance (6, 6) in the world of a frame that hangs from a keyframe."""
        Ad = se3_adjoint(se3_inverse(frame.T_keyframe_body))
        return np.asarray(Ad @ self._map.covariance(frame.keyframe_id) @ Ad.T + frame.covariance)

    def trajectory(self) -> Trajectory:
        """Return T_world_body of all frames as known now, with covariances."""
        poses = [self._pose(frame) for frame in self._frames]
        covariances = [self.covariance(frame) for frame in self._frames]
        return self._trajectory(poses, covariances)

    def trajectory_live(self) -> Trajectory:
        """Return the same frames as they were when added."""
        return self._trajectory([T for T, _ in self._live], [c for _, c in self._live])

    def _trajectory(self, poses: list[Array], covariances: list[Array]) -> Trajectory:
        stamps = np.array([frame.stamp_ns for frame in self._frames], np.int64)
        Ts = np.array(poses).reshape(-1, 4, 4)
        return Trajectory(stamps, Ts, np.array(covariances).reshape(-1, 6, 6))

    def _pose(self, frame: Placed) -> Array:
        return self._map.place(frame.keyframe_id, frame.T_keyframe_body)
