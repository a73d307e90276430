"""Relations: true relative poses between two moments, checked by hand.

Where no ground truth of the whole path exists, people have matched pairs of scans by hand: the
robot was here at t₁ and there at t₂. An estimate is judged by how well it repeats each relation:

    E = T̂(t₁)⁻¹ T̂(t₂)  compared in the plane with  (x, y, yaw)

Relations across a loop measure the map, those between neighbours the odometry. O(M log N).

Reference: R. Kümmerle et al., "On Measuring the Accuracy of SLAM Algorithms", Autonomous Robots
27(4), 2009 (the Freiburg relations).
"""

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.evaluation.match import seconds
from odomap.geometry.lie import se3_inverse
from odomap.geometry.trajectory import Trajectory

__all__ = ["Relations", "RelationsResult", "read_relations", "relations"]

SLACK_S = 1.0
"""A relation counts when both its times lie within the trajectory, give or take this."""


@dataclass(frozen=True, eq=False)
class Relations:
    """Relative poses in the plane between pairs of times.

    Attributes:
        stamps_ns: (M, 2) the two times of each, int64 nanoseconds.
        increments: (M, 3) x, y in metres and yaw in radians of the second pose in the first.
    """

    stamps_ns: NDArray[np.int64]
    increments: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, eq=False)
class RelationsResult:
    """How well a trajectory repeats hand-verified relations.

    Attributes:
        relations: how many lie within the trajectory's time.
        trans_mean: mean of the translation errors, metres.
        trans_std: their standard deviation, metres.
        rot_mean_deg: mean of the absolute heading errors, degrees.
        rot_std_deg: their standard deviation, degrees.
        trans_errors: (M,) translation errors, metres.
        rot_errors_deg: (M,) absolute heading errors, degrees.
    """

    relations: int
    trans_mean: float
    trans_std: float
    rot_mean_deg: float
    rot_std_deg: float
    trans_errors: NDArray[np.float64]
    rot_errors_deg: NDArray[np.float64]

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by name, units in the names."""
        return {
            "relations": self.relations,
            "trans_mean_m": self.trans_mean,
            "trans_std_m": self.trans_std,
            "rot_mean_deg": self.rot_mean_deg,
            "rot_std_deg": self.rot_std_deg,
        }


def read_relations(path: str | Path) -> Relations:
    """Read a relations file: rows of `t1 t2 x y z roll pitch yaw`, seconds, metres, radians.

    Raises:
        InputError: the file cannot be read, has no relations, or a row is not eight numbers.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from error
    rows = [(n, text.split("#")[0].split()) for n, text in enumerate(lines, 1)]
    parsed = [_row(path, n, words) for n, words in rows if words]
    if not parsed:
        raise InputError(f"{path}: no relations")
    stamps, increments = zip(*parsed)
    return Relations(np.array(stamps, np.int64), np.array(increments, np.float64))


def _row(
    path: str | Path, line: int, words: list[str]
) -> tuple[tuple[int, int], tuple[float, float, float]]:
    if len(words) < 8:
        raise InputError(f"{path}: line {line}: expected 8 numbers, got {len(words)}")
    try:
        # Exact decimals: float seconds lose 0.2 µs at today's epoch.
        first, second = (int(Decimal(w).scaleb(9).to_integral_value()) for w in words[:2])
        numbers = [float(w) for w in words[2:8]]
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise InputError(f"{path}: line {line}: not a number ({error})") from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: line {line}: NaN or infinite: remove the row")
    return (first, second), (numbers[0], numbers[1], numbers[5])


def relations(estimate: Trajectory, reference: Relations) -> RelationsResult:
    """Compare a trajectory with relations; each time takes the nearest pose.

    Args:
        estimate: trajectory to judge, moving in its x-y plane.
        reference: the relations, as `read_relations` gives them.

    Raises:
        InputError: no relation lies within the trajectory's time, or a pose is not finite.
    """
    if len(estimate) == 0 or not np.isfinite(estimate.Ts_world_body).all():
        raise InputError("estimate: no poses, or one is not finite (NaN or infinite)")
    t = seconds(estimate.stamps_ns)
    times = seconds(reference.stamps_ns.ravel()).reshape(-1, 2)
    inside = ((times >= t[0] - SLACK_S) & (times <= t[-1] + SLACK_S)).all(axis=1)
    if not inside.any():
        raise InputError(
            f"no relation overlaps the trajectory in time: estimate spans {t[0]:.3f} to "
            f"{t[-1]:.3f} s, relations {times.min():.3f} to {times.max():.3f} s: different clocks?"
        )
    T1, T2 = (estimate.Ts_world_body[_nearest(t, times[inside, k])] for k in (0, 1))
    relative = se3_inverse(T1) @ T2
    truth = reference.increments[inside]
    d = np.hypot(relative[:, 0, 3] - truth[:, 0], relative[:, 1, 3] - truth[:, 1])
    turn = np.arctan2(relative[:, 1, 0], relative[:, 0, 0]) - truth[:, 2]
    a = np.degrees(np.abs((turn + np.pi) % (2 * np.pi) - np.pi))
    return RelationsResult(
        len(d), float(d.mean()), float(d.std()), float(a.mean()), float(a.std()), d, a
    )


def _nearest(t: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.intp]:
    if len(t) == 1:
        return np.zeros(len(at), np.intp)
    k = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    return np.where(np.abs(t[k] - at) < np.abs(t[k - 1] - at), k, k - 1)
