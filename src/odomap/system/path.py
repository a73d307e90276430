"""The path: frames as they hang from keyframes.

A frame is stored as its pose relative to a keyframe, T_keyframe_body, never in the world. When
keyframes move, the frames hang along; the final path is read off when it is asked for. A frame is
in the units of its keyframe, and is stretched with it where a loop corrects the scale. In units of
the world its covariance is that of its keyframe, carried over, plus that of the relative pose:

    Σ_frame = Ad(T_body_keyframe) Σ_keyframe Ad(T_body_keyframe)ᵀ + Σ_relative.

Reference: Barfoot, Furgale, "Associating Uncertainty With Three-Dimensional Poses", T-RO 2014.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint, se3_inverse, se3_log
from odomap.geometry.trajectory import Trajectory
from odomap.maps.map import Map
from odomap.maps.states import stretched

__all__ = ["ASTRAY", "Path", "Placed"]

Array = NDArray[np.float64]

ASTRAY = 5.0
"""Standard deviations of where a body unseen may be beyond which it has not moved by itself."""
LEAP = 3.0
"""Times the fastest that a body has moved so far, from which on it leaps."""
SIGMAS = 5.0
"""Standard deviations of a frame's place relative to its keyframe that it must be as well."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A frame that hangs from a keyframe, in the units of that keyframe.

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
        self._live: list[tuple[int, Array, Array]] = []
        self._relative = np.zeros((6, 6))
        self._fastest, self._units = np.zeros(2), 1.0

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, place: int) -> Placed:
        return self._frames[place]

    @property
    def last(self) -> Placed:
        """The last frame placed."""
        return self._frames[-1]

    def hang(
        self, stamp_ns: int, keyframe_id: int, T_world_body: Array, covariance: Array
    ) -> Placed:
        """Return a frame as it hangs from a keyframe.

        Args:
            stamp_ns: its time.
            keyframe_id: the keyframe.
            T_world_body: (4, 4) where it is.
            covariance: (6, 6) of it relative to the keyframe, in units of the world.
        """
        T_keyframe_body = self._map.relative(keyframe_id, T_world_body)
        by = 1.0 / self._map.scale(keyframe_id)
        return Placed(stamp_ns, keyframe_id, T_keyframe_body, stretched(covariance, by))

    def append(self, frame: Placed) -> tuple[Array, Array]:
        """Add a frame; return its pose (4, 4) and covariance (6, 6) in the world as known now."""
        self._measure_speeds_by(frame)
        self._frames.append(frame)
        self._relative = stretched(frame.covariance, self._units)
        T_world_body, covariance = self._pose(frame), self.covariance(frame)
        self._live.append((frame.stamp_ns, T_world_body, covariance))
        speed = np.linalg.norm(self.velocity().reshape(2, 3), axis=1)
        self._fastest = np.maximum(self._fastest, speed)
        return T_world_body, covariance

    def replace_last(self, frame: Placed) -> None:
        """Hang the last frame from another keyframe: the one it has become."""
        self.replace(len(self) - 1, frame)

    def replace(self, place: int, frame: Placed) -> None:
        """Hang one of the frames anew."""
        if place == len(self) - 1:
            self._measure_speeds_by(frame)
        self._frames[place] = frame

    def append_late(self, frame: Placed) -> None:
        """Add a frame that could not be placed when it came; it is no part of the live path."""
        self._measure_speeds_by(frame)
        self._frames.append(frame)

    def last_pose(self) -> Array:
        """Return the last frame's T_world_body (4, 4) as known now; identity if there is none."""
        return self._pose(self._frames[-1]) if self._frames else np.eye(4)

    def is_leap(self, T_expected: Array, T_found: Array, covariance: Array) -> bool:
        """Say whether a pose (4, 4) lies further from where it was expected than a body can move.

        Further, that is, than it would at `LEAP` times its highest speed so far, and than a pose
        relative to its keyframe, whose covariance (6, 6) is given, is unsure by.
        """
        if len(self._frames) < 3:
            return False
        step = (
            1e-9 * (self._frames[-1].stamp_ns - self._frames[-2].stamp_ns) * self._highest_speed()
        )
        sigma = np.sqrt(np.diag(covariance).reshape(2, 3).max(axis=1))
        apart = _lengths(T_expected, T_found)
        return bool((apart > np.maximum(LEAP * step, SIGMAS * sigma)).any())

    def correction(self) -> str:
        """Say in a sentence if the map has been corrected so that the last pose leapt; else ""."""
        if not self._live or self._live[-1][0] != self.last.stamp_ns:
            return ""
        then, now = self._live[-1][1], self._pose(self.last)
        if not self.is_leap(then, now, self._relative):
            return ""
        return f"the map was corrected: the last pose moved by {_lengths(then, now)[0]:.2g}"

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
        scale, T_keyframe_body = self._map.scale(frame.keyframe_id), frame.T_keyframe_body.copy()
        T_keyframe_body[:3, 3] *= scale
        Ad = se3_adjoint(se3_inverse(T_keyframe_body))
        carried = Ad @ self._map.covariance(frame.keyframe_id) @ Ad.T
        return np.asarray(carried + stretched(frame.covariance, scale))

    def gap_covariance(self, stamp_ns: int) -> Array:
        """Return how unsure the last pose (6, 6) is by now: a metre and half a radian a second."""
        if not len(self):
            return np.zeros((6, 6))
        gap = (stamp_ns - self.last.stamp_ns) * 1e-9
        unseen = (np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]) + np.abs(self.velocity())) * gap
        return np.asarray(self.last_covariance() + np.diag(unseen**2))

    def trajectory(self) -> Trajectory:
        """Return T_world_body of all frames as known now, with covariances."""
        return _trajectory([(f.stamp_ns, self._pose(f), self.covariance(f)) for f in self._frames])

    def keyframes(self) -> Trajectory:
        """Return the keyframes among the frames, those that hang from themselves, as known now."""
        keyframes = [
            f
            for f in self._frames
            if self._map.is_keyframe_alive(f.keyframe_id)
            and self._map.keyframe(f.keyframe_id).stamp_ns == f.stamp_ns
        ]
        rows = [(f.stamp_ns, self._pose(f), self.covariance(f)) for f in keyframes]
        return _trajectory(rows)

    def trajectory_live(self) -> Trajectory:
        """Return the frames placed at once, as they were then."""
        return _trajectory(self._live)

    def _measure_speeds_by(self, frame: Placed) -> None:
        """Let the units of a frame's keyframe be those that speeds so far are stretched with."""
        self._fastest, self._units = self._highest_speed(), self._map.scale(frame.keyframe_id)

    def _highest_speed(self) -> Array:
        """Return the fastest (2,) so far, a length and an angle per second, in units as of now."""
        if not self._frames:
            return self._fastest
        now = self._map.scale(self._frames[-1].keyframe_id)
        return self._fastest * (now / self._units, 1.0)

    def _pose(self, frame: Placed) -> Array:
        return self._map.place(frame.keyframe_id, frame.T_keyframe_body)


def _lengths(T_from: Array, T_to: Array) -> Array:
    """Return how far apart two poses are: a length, and an angle in radians."""
    return np.asarray(np.linalg.norm(se3_log(se3_inverse(T_from) @ T_to).reshape(2, 3), axis=1))


def _trajectory(rows: list[tuple[int, Array, Array]]) -> Trajectory:
    stamps = np.array([stamp for stamp, _, _ in rows], np.int64)
    Ts = np.array([T for _, T, _ in rows]).reshape(-1, 4, 4)
    covariances = np.array([c for _, _, c in rows]).reshape(-1, 6, 6)
    order = np.argsort(stamps, kind="stable")  # clocks of old logs jump back
    return Trajectory(stamps[order], Ts[order], covariances[order])
