"""Pairs of poses: which pose of an estimate belongs to which pose of its reference.

Every metric compares poses taken at the same time, so that the first question is which belong
together, and the most common failure is that none do: two clocks, seconds for nanoseconds, the
wrong file. Here that failure becomes one sentence.

Every pose of the estimate proposes the nearest one of the reference; proposals are taken closest
first, each pose used once, none farther apart than `max_dt_s`. This is `Trajectory.associate`, but
in float seconds: where a stamp lies halfway between two others, or exactly `max_dt_s` away, the
last bit decides, and published numbers were all made that way. O(N log N).

Reference: J. Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.lie import so3_log
from odomap.geometry.trajectory import Trajectory

__all__ = ["Matched", "match", "rotation_angle", "seconds"]


@dataclass(frozen=True, eq=False)
class Matched:
    """Poses of an estimate and of its reference at the same times.

    Attributes:
        stamps_ns: (N,) stamps of the estimate, int64 nanoseconds.
        Ts_estimate: (N, 4, 4) T_world_body of the estimate, in its own world.
        Ts_reference: (N, 4, 4) T_world_body of the reference, in its own world.
        covariances: (N, 6, 6) of the estimate, or None.
    """

    stamps_ns: NDArray[np.int64]
    Ts_estimate: NDArray[np.float64]
    Ts_reference: NDArray[np.float64]
    covariances: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)


def match(
    estimate: Trajectory, reference: Trajectory, max_dt_s: float = 0.02, at_least: int = 3
) -> Matched:
    """Pair the poses of two trajectories by time.

    Args:
        estimate: trajectory to judge.
        reference: trajectory to judge it by.
        max_dt_s: largest difference of stamps within a pair, seconds.
        at_least: how many pairs the caller needs.

    Raises:
        InputError: a trajectory is empty or not finite, or too few poses match in time.
    """
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        _check(name, trajectory)
    i, j = _associate(seconds(estimate.stamps_ns), seconds(reference.stamps_ns), max_dt_s)
    if len(i) < at_least:
        raise InputError(_too_few(estimate, reference, len(i), max_dt_s, at_least))
    cov = None if estimate.covariances is None else estimate.covariances[i]
    return Matched(
        estimate.stamps_ns[i], estimate.Ts_world_body[i], reference.Ts_world_body[j], cov
    )


def _associate(
    ours: NDArray[np.float64], theirs: NDArray[np.float64], max_dt_s: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    right = np.clip(np.searchsorted(theirs, ours), 1, max(len(theirs) - 1, 1))
    left, right = right - 1, np.minimum(right, len(theirs) - 1)
    nearest = np.where(np.abs(theirs[right] - ours) < np.abs(theirs[left] - ours), right, left)
    distance = np.abs(theirs[nearest] - ours)
    order = np.argsort(distance, kind="stable")
    order = order[distance[order] <= max_dt_s]
    # The first proposal for a pose of the reference is the closest one: it wins.
    _, winners = np.unique(nearest[order], return_index=True)
    rows = np.sort(order[winners])
    return rows, nearest[rows]


def _check(name: str, trajectory: Trajectory) -> None:
    if len(trajectory) == 0:
        raise InputError(f"{name}: no poses")
    finite = np.isfinite(trajectory.Ts_world_body).all(axis=(1, 2))
    if not finite.all():
        row = int(np.argmin(finite))
        raise InputError(f"{name}: pose {row} is not finite (NaN or infinite): remove it")


def _too_few(
    estimate: Trajectory, reference: Trajectory, found: int, max_dt_s: float, at_least: int
) -> str:
    spans = f"estimate spans {_span(estimate)}, reference spans {_span(reference)}"
    gap = max(
        int(reference.stamps_ns[0] - estimate.stamps_ns[-1]),
        int(estimate.stamps_ns[0] - reference.stamps_ns[-1]),
    )
    if gap > max_dt_s * 1e9:
        return f"no overlap in time: {spans}: different clocks?"
    return (
        f"only {found} poses match in time within {max_dt_s:g} s, {at_least} needed ({spans}): "
        "raise the largest time difference, or check the stamps"
    )


def _span(trajectory: Trajectory) -> str:
    first, last = trajectory.stamps_ns[[0, -1]].tolist()
    return f"{first / 1e9:.3f} to {last / 1e9:.3f} s"


def seconds(stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Convert stamps to seconds, each the float nearest to the exact decimal.

    Other evaluators parse decimal seconds, and rules such as "the first pose at least one second
    later" turn on the last bit; `stamps_ns * 1e-9` rounds twice and would pick other pairs.
    """
    return np.array([ns / 1_000_000_000 for ns in stamps_ns.tolist()], dtype=np.float64)


def rotation_angle(Rs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles of rotations (..., 3, 3), radians in [0, π]."""
    angles: NDArray[np.float64] = np.linalg.norm(so3_log(Rs), axis=-1)
    return angles
