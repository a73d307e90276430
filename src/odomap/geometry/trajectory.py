"""Trajectories: where the body was, and when.

The problem: two recordings of one path never share their clock ticks. Between poses the body is
taken to move along the geodesic of SE(3), at constant twist,

    T(t) = T₀ exp(α log(T₀⁻¹ T₁)),   α = (t - t₀) / (t₁ - t₀)

and two paths are associated greedily: every stamp proposes the nearest one of the other path (the
earlier on a tie); proposals are taken in order of distance, each stamp once, none farther than
`max_dt_s`. Stamps are integer nanoseconds, so no join depends on rounding. All operations are
O(N log N) or less, on arrays.

Reference: J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A benchmark for the
evaluation of RGB-D SLAM systems", IROS 2012 (association).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.geometry import lie
from odomap.geometry.pose import SE3, Sim3
from odomap.geometry.so3 import Array

__all__ = ["Trajectory"]

_TOLERANCE = 1e-5
"""How far RᵀR may be from I in poses given from outside (files round to 6 digits)."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Poses over time, in order.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing, nanoseconds.
        Ts_world_body: (N, 4, 4), metres.
        covariances: (N, 6, 6) of each pose, tangent (translation, rotation), right update; or None.

    Raises:
        InputError: wrong shapes, not finite, stamps out of order, or not rotations.

    Example:
        >>> path = Trajectory.of_poses([0, 1000], [SE3.identity(), SE3.exp([1, 0, 0, 0, 0, 0])])
        >>> path.interpolate([500]).positions
        array([[0.5, 0. , 0. ]])
    """

    stamps_ns: NDArray[np.int64]
    Ts_world_body: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        stamps = _stamps(self.stamps_ns)
        back = np.flatnonzero(np.diff(stamps) <= 0)
        if len(back):
            i = int(back[0])
            pair = f"{stamps[i]} then {stamps[i + 1]}"
            raise InputError(
                f"stamps_ns: row {i + 1} does not increase ({pair}); sort, drop doubles"
            )
        poses = _poses(self.Ts_world_body, len(stamps))
        covariances = self.covariances
        if covariances is not None:
            covariances = np.array(covariances, dtype=np.float64)
            if covariances.shape != (len(stamps), 6, 6):
                shape = covariances.shape
                raise InputError(f"covariances: have shape {shape}, give ({len(stamps)}, 6, 6)")
            covariances.setflags(write=False)
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "Ts_world_body", poses)
        object.__setattr__(self, "covariances", covariances)

    @classmethod
    def of_poses(cls, stamps_ns: ArrayLike, poses: Sequence[SE3]) -> "Trajectory":
        """Return the trajectory of a list of poses.

        Args:
            stamps_ns: (N,) integer nanoseconds.
            poses: N values of T_world_body.

        Returns:
            The trajectory.
        """
        stack = np.stack([p.matrix for p in poses]) if len(poses) else np.empty((0, 4, 4))
        return cls(_stamps(stamps_ns), stack)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectory):
            return NotImplemented
        mine, theirs = self.covariances, other.covariances
        same = mine is theirs or (
            mine is not None and theirs is not None and np.array_equal(mine, theirs)
        )
        return (
            same
            and np.array_equal(self.stamps_ns, other.stamps_ns)
            and np.array_equal(self.Ts_world_body, other.Ts_world_body)
        )

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[object, ...]:
        return Trajectory, (self.stamps_ns, self.Ts_world_body, self.covariances)

    def __repr__(self) -> str:
        if not len(self):
            return "Trajectory(empty)"
        return f"Trajectory({len(self)} poses, {self.duration_s:.3f} s, {self.path_length:.3f} m)"

    @property
    def stamps(self) -> Array:
        """(N,) seconds, for people and plots."""
        return np.asarray(self.stamps_ns * 1e-9)

    @property
    def positions(self) -> Array:
        """(N, 3) metres, read-only."""
        return self.Ts_world_body[:, :3, 3]

    @property
    def path_length(self) -> float:
        """Length of the polyline through the positions, metres."""
        return float(np.sum(np.linalg.norm(np.diff(self.positions, axis=0), axis=1)))

    @property
    def duration_s(self) -> float:
        """Seconds from the first pose to the last."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9 if len(self) else 0.0

    def pose(self, index: int) -> SE3:
        """Return one pose T_world_body as a value."""
        return SE3(self.Ts_world_body[index])

    def interpolate(self, stamps_ns: ArrayLike) -> "Trajectory":
        """Return the poses at other times, along geodesics of SE(3).

        Covariances are blended linearly between the neighbours.

        Args:
            stamps_ns: (M,) integer nanoseconds, strictly increasing, within the trajectory's span.

        Returns:
            A trajectory of M poses.

        Raises:
            InputError: a stamp lies before the first or after the last pose.
        """
        wanted = _stamps(stamps_ns)
        if len(wanted) == 0:
            return self._rows(np.empty(0, dtype=np.int64))
        if len(self) == 0:
            raise InputError("stamps_ns: the trajectory is empty, nothing to interpolate")
        first, last = int(self.stamps_ns[0]), int(self.stamps_ns[-1])
        outside = wanted[(wanted < first) | (wanted > last)]
        if len(outside):
            raise InputError(
                f"stamps_ns: {outside[0]} lies outside {first} to {last}, cut with `between` first"
            )
        right = np.clip(np.searchsorted(self.stamps_ns, wanted), 1, max(len(self) - 1, 1))
        left, right = right - 1, np.minimum(right, len(self) - 1)
        gap = np.maximum(self.stamps_ns[right] - self.stamps_ns[left], 1)
        alpha = (wanted - self.stamps_ns[left]) / gap
        start = self.Ts_world_body[left]
        twist = lie.se3_log(lie.se3_inverse(start) @ self.Ts_world_body[right])
        poses = start @ lie.se3_exp(alpha[:, None] * twist)
        blended = None
        if self.covariances is not None:
            a = alpha[:, None, None]
            blended = (1.0 - a) * self.covariances[left] + a * self.covariances[right]
        return Trajectory(wanted, poses, blended)

    def associate(
        self, other: "Trajectory", max_dt_s: float = 0.02
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pair poses of two trajectories by time, greedily, each pose at most once.

        Args:
            other: the other trajectory.
            max_dt_s: largest difference of stamps, seconds.

        Returns:
            Row numbers in this and in the other trajectory, (M,) each, increasing in this one.
        """
        if not max_dt_s >= 0:
            raise InputError(f"max_dt_s: is {max_dt_s}, give seconds, 0 or more")
        empty = np.empty(0, dtype=np.int64)
        if len(self) == 0 or len(other) == 0:
            return empty, empty
        ours, theirs = self.stamps_ns, other.stamps_ns
        right = np.clip(np.searchsorted(theirs, ours), 1, max(len(theirs) - 1, 1))
        left, right = right - 1, np.minimum(right, len(theirs) - 1)
        nearest = np.where(np.abs(theirs[right] - ours) < np.abs(theirs[left] - ours), right, left)
        distance = np.abs(theirs[nearest] - ours)
        order = np.argsort(distance, kind="stable")
        order = order[distance[order] <= round(max_dt_s * 1e9)]
        # The first proposal for a row of the other path is the closest one: it wins.
        _, winners = np.unique(nearest[order], return_index=True)
        rows = np.sort(order[winners])
        return rows.astype(np.int64), nearest[rows].astype(np.int64)

    def resample(self, rate_hz: float) -> "Trajectory":
        """Return the trajectory at a steady rate, from its first pose on.

        Args:
            rate_hz: poses per second.

        Returns:
            The interpolated trajectory.
        """
        if not (np.isfinite(rate_hz) and rate_hz > 0):
            raise InputError(f"rate_hz: is {rate_hz}, must be above 0")
        if len(self) == 0:
            return self
        span = int(self.stamps_ns[-1] - self.stamps_ns[0])
        ticks = np.arange(int(span * 1e-9 * rate_hz) + 2, dtype=np.float64)
        offsets = np.rint(ticks * (1e9 / rate_hz)).astype(np.int64)
        return self.interpolate(self.stamps_ns[0] + offsets[offsets <= span])

    def transformed(self, T_target_world: SE3 | Sim3) -> "Trajectory":
        """Return the same path in another world frame.

        Args:
            T_target_world: maps this world to the new one; a Sim3 also scales the path.

        Returns:
            The trajectory of T_target_body; covariances live in the body and only change scale.
        """
        R, t = T_target_world.R, T_target_world.t
        scale = T_target_world.scale if isinstance(T_target_world, Sim3) else 1.0
        poses = self.Ts_world_body.copy()
        poses[:, :3, :3] = R @ self.Ts_world_body[:, :3, :3]
        poses[:, :3, 3] = scale * (self.positions @ R.T) + t
        covariances = self.covariances
        if covariances is not None:
            size = np.array([scale, scale, scale, 1.0, 1.0, 1.0])
            covariances = covariances * np.outer(size, size)
        return Trajectory(self.stamps_ns, poses, covariances)

    def between(self, first_ns: int, last_ns: int) -> "Trajectory":
        """Return the poses with stamps from `first_ns` to `last_ns`, both included."""
        keep = (self.stamps_ns >= first_ns) & (self.stamps_ns <= last_ns)
        return self._rows(np.flatnonzero(keep))

    def rows(self, indices: ArrayLike) -> "Trajectory":
        """Return the poses of some rows.

        Args:
            indices: (M,) increasing row numbers.

        Returns:
            The shorter trajectory.
        """
        return self._rows(np.asarray(indices))

    def _rows(self, indices: NDArray[np.int64]) -> "Trajectory":
        covariances = None if self.covariances is None else self.covariances[indices]
        return Trajectory(self.stamps_ns[indices], self.Ts_world_body[indices], covariances)


def _stamps(values: ArrayLike) -> NDArray[np.int64]:
    """Return a read-only int64 copy, refusing floats: seconds are not nanoseconds."""
    given = np.asarray(values)
    if given.ndim != 1:
        raise InputError(f"stamps_ns: have shape {given.shape}, give (N,)")
    if given.size and given.dtype.kind not in "iu":
        raise InputError(f"stamps_ns: are {given.dtype}, give integer nanoseconds")
    stamps = given.astype(np.int64)
    stamps.setflags(write=False)
    return stamps


def _poses(values: ArrayLike, count: int) -> Array:
    """Return a read-only copy of (count, 4, 4) poses, their rotations made exact."""
    poses = np.array(values, dtype=np.float64)
    if poses.shape != (count, 4, 4):
        raise InputError(f"Ts_world_body: have shape {poses.shape}, give ({count}, 4, 4)")
    finite = np.all(np.isfinite(poses), axis=(1, 2))
    if not np.all(finite):
        raise InputError(f"Ts_world_body: row {int(np.argmin(finite))} has NaN or infinite entries")
    if np.any(np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]) > 1e-9):
        raise InputError("Ts_world_body: last rows must be 0 0 0 1")
    R = poses[:, :3, :3]
    gram = np.swapaxes(R, 1, 2) @ R
    error = np.max(np.abs(gram - np.eye(3)), axis=(1, 2))
    bad = (error > _TOLERANCE) | (np.linalg.det(R) < 0)
    if np.any(bad):
        i = int(np.argmax(bad))
        raise InputError(f"Ts_world_body: row {i} is not a rotation (off by {error[i]:.1e})")
    rough = error > 4e-15
    if np.any(rough):
        poses[rough, :3, :3] = lie.orthonormalize(R[rough])
    poses.setflags(write=False)
    return poses
