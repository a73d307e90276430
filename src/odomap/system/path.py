"""The path: frames as they hang from keyframes.

A frame is stored as its pose relative to a keyframe, T_keyframe_body, never in the world. When
keyframes move, the frames hang along; the final path is read off when it is asked for. A frame is
in the units of its keyframe, and is stretched with it where a loop corrects the scale. In units of
the world its covariance is that of its keyframe, carried over, plus that of the relative pose:

    Σ_frame = Ad(T_body_keyframe) Σ_keyframe Ad(T_body_keyframe)ᵀ + Σ_relative.

Frames are rows of numbers (`pathrows`); only the last one is kept as it was given.

Reference: Barfoot, Furgale, "Associating Uncertainty With Three-Dimensional Poses", T-RO 2014.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint, se3_inverse, se3_log
from odomap.geometry.lie_kernels import se3_log_into
from odomap.geometry.trajectory import Trajectory
from odomap.maps.map import Map
from odomap.maps.states import compose, stretched
from odomap.system.pathrows import PathRows

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
        self._frames, self._live = PathRows(), PathRows()
        self._last: Placed | None = None
        self._T_live = np.eye(4)
        self._relative = np.zeros((6, 6))
        self._fastest, self._units = np.zeros(2), 1.0
        # The last frame as known when the map was of this version.
        self._T_last, self._scale_last, self._version = np.eye(4), 1.0, -1

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, place: int) -> Placed:
        return Placed(*self._frames[place])

    @property
    def last(self) -> Placed:
        """The last frame placed."""
        if self._last is None:
            raise IndexError("the path has no frame yet")
        return self._last

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
        before = self._known_last()[0]
        self._measure_speeds_by(frame)
        self._add(frame)
        T_world_body, scale = self._known_last()
        self._relative = stretched(frame.covariance, scale)
        covariance = self.covariance(frame)
        self._live.append(frame.stamp_ns, -1, T_world_body, covariance)
        self._T_live = T_world_body
        seconds = self._last_seconds()
        if seconds > 0.0:
            self._fastest = np.maximum(self._fastest, _lengths(before, T_world_body) / seconds)
        return T_world_body, covariance

    def replace_last(self, frame: Placed) -> None:
        """Hang the last frame from another keyframe: the one it has become."""
        self.replace(len(self) - 1, frame)

    def replace(self, place: int, frame: Placed) -> None:
        """Hang one of the frames anew."""
        if place == len(self) - 1:
            self._measure_speeds_by(frame)
            self._last = frame
        self._frames.replace(place, *_numbers(frame))
        self._version = -1

    def append_late(self, frame: Placed) -> None:
        """Add a frame that could not be placed when it came; it is no part of the live path."""
        self._measure_speeds_by(frame)
        self._add(frame)

    def last_pose(self) -> Array:
        """Return the last frame's T_world_body (4, 4) as known now; identity if there is none."""
        return self._known_last()[0].copy()

    def is_leap(self, T_expected: Array, T_found: Array, covariance: Array) -> bool:
        """Say whether a pose (4, 4) lies further from where it was expected than a body can move.

        Further, that is, than it would at `LEAP` times its highest speed so far, and than a pose
        relative to its keyframe, whose covariance (6, 6) is given, is unsure by.
        """
        if len(self._frames) < 3:
            return False
        step = 1e-9 * self._last_step_ns() * self._highest_speed()
        sigma = np.sqrt(np.diag(covariance).reshape(2, 3).max(axis=1))
        apart = _lengths(T_expected, T_found)
        return bool((apart > np.maximum(LEAP * step, SIGMAS * sigma)).any())

    def correction(self) -> str:
        """Say in a sentence if the map has been corrected so that the last pose leapt; else ""."""
        if not len(self._live) or self._live.stamp_ns(-1) != self.last.stamp_ns:
            return ""
        then, now = self._T_live, self._known_last()[0]
        if now is then or not self.is_leap(then, now, self._relative):
            return ""
        return f"the map was corrected: the last pose moved by {_lengths(then, now)[0]:.2g}"

    def last_covariance(self) -> Array:
        """Return the last frame's covariance (6, 6) as known now; zero before there is one."""
        return np.zeros((6, 6)) if self._last is None else self.covariance(self._last)

    def velocity(self) -> Array:
        """Return the twist (6,) between the last two frames, per second; zero if they are apart."""
        seconds = self._last_seconds()
        if seconds <= 0.0:
            return np.zeros(6)
        T_before, T_last = self._pose(self[-2]), self._known_last()[0]
        return np.asarray(se3_log(se3_inverse(T_before) @ T_last) / seconds)

    def covariance(self, frame: Placed) -> Array:
        """Return the covariance (6, 6) in the world of a frame that hangs from a keyframe."""
        scale, sure = self._map.scale(frame.keyframe_id), self._map.covariance(frame.keyframe_id)
        return _in_world(sure, scale, frame.T_keyframe_body, frame.covariance)

    def gap_covariance(self, stamp_ns: int) -> Array:
        """Return how unsure the last pose (6, 6) is by now: a metre and half a radian a second."""
        if not len(self):
            return np.zeros((6, 6))
        gap = (stamp_ns - self.last.stamp_ns) * 1e-9
        unseen = (np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]) + np.abs(self.velocity())) * gap
        return np.asarray(self.last_covariance() + np.diag(unseen**2))

    def trajectory(self) -> Trajectory:
        """Return T_world_body of all frames as known now, with covariances."""
        return self._known(np.ones(len(self), bool))

    def keyframes(self) -> Trajectory:
        """Return the keyframes among the frames, those that hang from themselves, as known now."""
        ids = self._frames.keyframe_ids
        distinct, places = np.unique(ids, return_inverse=True)
        stamps_ns = [self._stamp_ns_of(k) for k in distinct.tolist()]
        is_itself = np.array([at is not None for at in stamps_ns], bool)[places]
        of_keyframe = np.array([at or 0 for at in stamps_ns], np.int64)[places]
        return self._known(is_itself & (of_keyframe == self._frames.stamps_ns))

    def trajectory_live(self) -> Trajectory:
        """Return the frames placed at once, as they were then."""
        return _trajectory(self._live.stamps_ns, *self._live.matrices())

    def _add(self, frame: Placed) -> None:
        self._frames.append(*_numbers(frame))
        self._last, self._version = frame, -1

    def _measure_speeds_by(self, frame: Placed) -> None:
        """Let the units of a frame's keyframe be those that speeds so far are stretched with."""
        self._fastest, self._units = self._highest_speed(), self._map.scale(frame.keyframe_id)

    def _highest_speed(self) -> Array:
        """Return the fastest (2,) so far, a length and an angle per second, in units as of now."""
        if self._last is None:
            return self._fastest
        return self._fastest * (self._known_last()[1] / self._units, 1.0)

    def _last_seconds(self) -> float:
        """Return the time between the last two frames; 0 if they are apart, or in no order."""
        if len(self._frames) < 2:
            return 0.0
        seconds = self._last_step_ns() * 1e-9
        return seconds if 0.0 < seconds <= 1.0 else 0.0

    def _last_step_ns(self) -> int:
        return self._frames.stamp_ns(-1) - self._frames.stamp_ns(-2)

    def _stamp_ns_of(self, keyframe_id: int) -> int | None:
        """Return the time of a keyframe; None if it is gone."""
        if not self._map.is_keyframe_alive(keyframe_id):
            return None
        return self._map.keyframe(keyframe_id).stamp_ns

    def _pose(self, frame: Placed) -> Array:
        return self._map.place(frame.keyframe_id, frame.T_keyframe_body)

    def _known_last(self) -> tuple[Array, float]:
        """Return where (4, 4) the last frame is and the scale of its keyframe, as known now.

        The same array as before where the map has not changed.
        """
        version = self._map.version
        if self._last is not None and self._version != version:
            self._T_last = self._pose(self._last)
            self._scale_last = self._map.scale(self._last.keyframe_id)
            self._version = version
        return self._T_last, self._scale_last

    def _known(self, rows: NDArray[np.bool_]) -> Trajectory:
        """Return where some of the frames are, (N,) whether they are asked for, as known now."""
        stamps_ns, ids = self._frames.stamps_ns[rows], self._frames.keyframe_ids[rows]
        Ts, relative = self._frames.matrices(rows)
        if not len(ids):
            return _trajectory(stamps_ns, Ts, relative)
        with self._map.lock:
            placements, sure = self._map.placements(ids), self._map.covariances(ids)
        covariances = _in_world(sure, placements[1], Ts, relative)
        Ts_world_body, _ = compose(placements, (Ts, np.ones(len(ids))))
        return _trajectory(stamps_ns, Ts_world_body, covariances)


def _numbers(frame: Placed) -> tuple[int, int, Array, Array]:
    return frame.stamp_ns, frame.keyframe_id, frame.T_keyframe_body, frame.covariance


def _in_world(
    of_keyframe: Array, scale: Array | float, T_keyframe_body: Array, relative: Array
) -> Array:
    """Return covariances (..., 6, 6) in the world of frames that hang from keyframes."""
    T = T_keyframe_body.copy()
    T[..., :3, 3] *= np.asarray(scale)[..., None]
    Ad = se3_adjoint(se3_inverse(T))
    return np.asarray(Ad @ of_keyframe @ np.swapaxes(Ad, -1, -2) + stretched(relative, scale))


def _lengths(T_from: Array, T_to: Array) -> Array:
    """Return how far apart two poses are: a length, and an angle in radians."""
    R_t, twist = T_from[:3, :3].T, np.empty(6)
    se3_log_into(R_t @ T_to[:3, :3], R_t @ (T_to[:3, 3] - T_from[:3, 3]), twist)
    xi = twist.tolist()
    return np.array([math.hypot(*xi[:3]), math.hypot(*xi[3:])])


def _trajectory(stamps_ns: NDArray[np.int64], Ts: Array, covariances: Array) -> Trajectory:
    order = np.argsort(stamps_ns, kind="stable")  # clocks of old logs jump back
    # One that jumps back may say the same twice, of which the first is kept.
    order = order[np.diff(stamps_ns[order], prepend=stamps_ns[order][:1] - 1) > 0]
    return Trajectory(stamps_ns[order], Ts[order], covariances[order])
