"""How far an estimated path is from the true one.

Nobody knows the world frame of an estimate, so a path is compared either after one best alignment,
or by its increments, which need none.

    ATE    e_k = |p_k − S p̂_k|,  S = argmin Σ|p_k − S p̂_k|²     (Umeyama, closed form)
    RPE    E_ij = (T_i⁻¹ T_j)⁻¹ (T̂_i⁻¹ T̂_j),  j the first pose a delta after i
    KITTI  the same over 100, 200, … 800 m of path, divided by the length

ATE says how consistent the whole is; RPE how fast it drifts; the KITTI figures are the drift per
metre at the scale of a drive. Relations (`relations`) and consistency of covariances (`nees`) have
their own files and are reachable from here. All are O(N) after matching.

Reference: Z. Zhang, D. Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation for
Visual(-Inertial) Odometry", IROS 2018; the KITTI figures: A. Geiger et al., CVPR 2012.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.evaluation.consistency import NeesResult, consistency, nees
from odomap.evaluation.match import Matched, match, rotation_angle, seconds
from odomap.evaluation.relations import Relations, RelationsResult, read_relations, relations
from odomap.geometry.align import umeyama, yaw_only
from odomap.geometry.lie import se3_inverse
from odomap.geometry.pose import Sim3
from odomap.geometry.trajectory import Trajectory

__all__ = [
    "Alignment",
    "AteResult",
    "KittiResult",
    "NeesResult",
    "Relations",
    "RelationsResult",
    "RpeResult",
    "Unit",
    "ate",
    "consistency",
    "coverage",
    "kitti_segments",
    "nees",
    "read_relations",
    "relations",
    "rpe",
]

Alignment = Literal["se3", "sim3", "yaw", "first", "none"]
Unit = Literal["s", "m", "f"]

KITTI_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
KITTI_STEP = 10


@dataclass(frozen=True, eq=False)
class AteResult:
    """Absolute trajectory error after one alignment.

    Attributes:
        rmse: root mean square of the position errors, metres; the usual figure.
        mean: their mean, metres.
        median: their median, metres.
        max: the largest, metres.
        rot_rmse_deg: root mean square of the rotation errors, degrees.
        scale: scale of the alignment; 1 unless aligned with "sim3".
        matched: number of poses compared.
        reference_poses: number of poses in the reference.
        coverage: share of the reference's time from the first to the last pose compared.
        path_m: length of the whole reference path, metres.
        errors: (N,) position errors, metres.
        rot_errors_deg: (N,) rotation errors, degrees.
        stamps_ns: (N,) stamps of the poses compared, nanoseconds.
        T_reference_estimate: the alignment, from the estimate's world to the reference's.
    """

    rmse: float
    mean: float
    median: float
    max: float
    rot_rmse_deg: float
    scale: float
    matched: int
    reference_poses: int
    coverage: float
    path_m: float
    errors: NDArray[np.float64]
    rot_errors_deg: NDArray[np.float64]
    stamps_ns: NDArray[np.int64]
    T_reference_estimate: Sim3

    @property
    def percent(self) -> float:
        """RMSE in percent of the reference path; NaN where that does not move."""
        return 100.0 * self.rmse / self.path_m if self.path_m > 0 else float("nan")

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by name, units in the names; coverage to four places."""
        return {
            "matched": self.matched,
            "truth": self.reference_poses,
            "coverage": round(self.coverage, 4),
            "rmse_m": self.rmse,
            "mean_m": self.mean,
            "median_m": self.median,
            "max_m": self.max,
            "rot_rmse_deg": self.rot_rmse_deg,
            "scale": self.scale,
            "path_m": self.path_m,
            "rmse_pct_of_path": self.percent,
        }


@dataclass(frozen=True, eq=False)
class RpeResult:
    """Relative pose error over a fixed delta.

    Attributes:
        delta: length of the increments, in `unit`.
        unit: "s" seconds, "m" metres of reference path, "f" matched frames.
        pairs: number of increments compared.
        trans_rmse: root mean square of the translation errors, metres.
        trans_median: their median, metres.
        rot_rmse_deg: root mean square of the rotation errors, degrees.
        rot_median_deg: their median, degrees.
        trans_errors: (M,) translation errors, metres.
        rot_errors_deg: (M,) rotation errors, degrees.
        stamps_ns: (M,) stamps of the first pose of each increment, nanoseconds.
    """

    delta: float
    unit: Unit
    pairs: int
    trans_rmse: float
    trans_median: float
    rot_rmse_deg: float
    rot_median_deg: float
    trans_errors: NDArray[np.float64]
    rot_errors_deg: NDArray[np.float64]
    stamps_ns: NDArray[np.int64]

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by name, units in the names."""
        return {
            "pairs": self.pairs,
            "trans_rmse_m": self.trans_rmse,
            "trans_median_m": self.trans_median,
            "rot_rmse_deg": self.rot_rmse_deg,
            "rot_median_deg": self.rot_median_deg,
        }


@dataclass(frozen=True, eq=False)
class KittiResult:
    """Drift over segments of 100 to 800 m, as the KITTI odometry benchmark averages it.

    Attributes:
        segments: number of segments.
        trans_pct: mean translation error, percent of the length.
        rot_deg_per_m: mean rotation error, degrees per metre.
        lengths_m: (M,) nominal lengths of the segments, metres.
        trans_errors: (M,) translation error per length of each segment (a ratio).
        rot_errors_deg_per_m: (M,) rotation error of each segment, degrees per metre.
    """

    segments: int
    trans_pct: float
    rot_deg_per_m: float
    lengths_m: NDArray[np.float64]
    trans_errors: NDArray[np.float64]
    rot_errors_deg_per_m: NDArray[np.float64]

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by name, units in the names."""
        return {
            "segments": self.segments,
            "trans_pct": self.trans_pct,
            "rot_deg_per_m": self.rot_deg_per_m,
        }


def ate(
    estimate: Trajectory,
    reference: Trajectory,
    align: Alignment = "se3",
    max_dt_s: float = 0.02,
) -> AteResult:
    """Compute the absolute trajectory error.

    Args:
        estimate: trajectory to judge.
        reference: ground truth, of the same body.
        align: "se3" rigid, "sim3" also scale (monocular), "yaw" keeps the vertical z axis,
            "first" puts the first poses on each other, "none" trusts the frames.
        max_dt_s: largest difference in time of two poses compared, seconds.

    Raises:
        InputError: fewer than three poses match, or a trajectory is not finite.
    """
    pairs = match(estimate, reference, max_dt_s)
    S = _alignment(pairs, align)
    s, R, t = S.scale if align == "sim3" else 1.0, S.R, S.t
    x, y = pairs.Ts_estimate[:, :3, 3], pairs.Ts_reference[:, :3, 3]
    d = np.linalg.norm(y - (s * x @ R.T + t), axis=1)
    Rs_true = pairs.Ts_reference[:, :3, :3]
    rot = np.degrees(rotation_angle(Rs_true.swapaxes(1, 2) @ (R @ pairs.Ts_estimate[:, :3, :3])))
    return AteResult(
        rmse=_rms(d),
        mean=float(d.mean()),
        median=float(np.median(d)),
        max=float(d.max()),
        rot_rmse_deg=_rms(rot),
        scale=float(s),
        matched=len(pairs),
        reference_poses=len(reference),
        coverage=_covered(pairs, reference),
        path_m=float(_path(reference.Ts_world_body)[-1]),
        errors=d,
        rot_errors_deg=rot,
        stamps_ns=pairs.stamps_ns,
        T_reference_estimate=S,
    )


def coverage(estimate: Trajectory, reference: Trajectory, max_dt_s: float = 0.02) -> float:
    """Return the share of the reference's time between the first and the last match, 0 to 1."""
    return _covered(match(estimate, reference, max_dt_s, at_least=1), reference)


def rpe(
    estimate: Trajectory,
    reference: Trajectory,
    delta: float = 1.0,
    unit: Unit = "s",
    align: Literal["se3", "sim3"] = "se3",
    max_dt_s: float = 0.02,
) -> RpeResult:
    """Compute the relative pose error between each pose and the first one a delta later.

    Args:
        estimate: trajectory to judge.
        reference: ground truth, of the same body.
        delta: length of an increment, in `unit`.
        unit: "s" seconds, "m" metres along the reference, "f" matched frames.
        align: "sim3" scales the estimate first; anything rigid has no effect on increments.
        max_dt_s: largest difference in time of two poses compared, seconds.

    Raises:
        InputError: no two matched poses are a delta apart, or a trajectory is not finite.
    """
    if not delta > 0:
        raise InputError(f"delta {delta:g} of the relative error: must be positive")
    pairs = match(estimate, reference, max_dt_s)
    E, G = pairs.Ts_estimate.copy(), pairs.Ts_reference
    if align == "sim3":
        E[:, :3, 3] *= umeyama(E[:, :3, 3], G[:, :3, 3], with_scale=True).scale
    key = _key(pairs, unit)
    j = np.searchsorted(key, key + delta - 1e-9)
    i = np.nonzero(j < len(key))[0]
    if len(i) == 0:
        whole = f"{key[-1] - key[0]:.3g} {_UNITS[unit]}"
        raise InputError(f"no two poses are {delta:g} {_UNITS[unit]} apart: the path has {whole}")
    j = j[i]
    error = se3_inverse(se3_inverse(G[i]) @ G[j]) @ (se3_inverse(E[i]) @ E[j])
    d = np.linalg.norm(error[:, :3, 3], axis=1)
    a = np.degrees(rotation_angle(error[:, :3, :3]))
    return RpeResult(
        delta=delta,
        unit=unit,
        pairs=len(i),
        trans_rmse=_rms(d),
        trans_median=float(np.median(d)),
        rot_rmse_deg=_rms(a),
        rot_median_deg=float(np.median(a)),
        trans_errors=d,
        rot_errors_deg=a,
        stamps_ns=pairs.stamps_ns[i],
    )


def kitti_segments(
    estimate: Trajectory, reference: Trajectory, max_dt_s: float = 0.02
) -> KittiResult:
    """Compute the KITTI odometry figures: mean drift over 100 to 800 m, from every tenth pose.

    Args:
        estimate: trajectory to judge.
        reference: ground truth, of the same body.
        max_dt_s: largest difference in time of two poses compared, seconds.

    Raises:
        InputError: the matched path is shorter than 100 m, or a trajectory is not finite.
    """
    pairs = match(estimate, reference, max_dt_s)
    E, G = pairs.Ts_estimate, pairs.Ts_reference
    path = _path(G)
    first = np.repeat(np.arange(0, len(G), KITTI_STEP), len(KITTI_LENGTHS_M))
    lengths = np.tile(np.array(KITTI_LENGTHS_M, np.float64), len(first) // len(KITTI_LENGTHS_M))
    last = np.searchsorted(path, path[first] + lengths)
    inside = last < len(G)
    if not inside.any():
        raise InputError(f"path of {path[-1]:.0f} m is too short for KITTI segments of 100 m")
    first, last, lengths = first[inside], last[inside], lengths[inside]
    error = se3_inverse(se3_inverse(E[first]) @ E[last]) @ (se3_inverse(G[first]) @ G[last])
    d = np.linalg.norm(error[:, :3, 3], axis=1) / lengths
    a = np.degrees(rotation_angle(error[:, :3, :3])) / lengths
    return KittiResult(len(d), float(100.0 * d.mean()), float(a.mean()), lengths, d, a)


_UNITS: dict[Unit, str] = {"s": "s", "m": "m", "f": "frames"}


def _alignment(pairs: Matched, align: Alignment) -> Sim3:
    x, y = pairs.Ts_estimate[:, :3, 3], pairs.Ts_reference[:, :3, 3]
    match align:
        case "se3" | "sim3":
            return umeyama(x, y, with_scale=align == "sim3")
        case "yaw":
            return yaw_only(x, y)
        case "first":
            return Sim3(pairs.Ts_reference[0] @ se3_inverse(pairs.Ts_estimate[0]))
        case "none":
            return Sim3(np.eye(4))
    raise InputError(f"alignment '{align}' is unknown: se3, sim3, yaw, first or none")


def _key(pairs: Matched, unit: Unit) -> NDArray[np.float64]:
    match unit:
        case "s":
            return seconds(pairs.stamps_ns)
        case "m":
            return _path(pairs.Ts_reference)
        case "f":
            return np.arange(len(pairs), dtype=np.float64)
    raise InputError(f"unit '{unit}' is unknown: s (seconds), m (metres) or f (frames)")


def _covered(pairs: Matched, reference: Trajectory) -> float:
    span = int(reference.stamps_ns[-1] - reference.stamps_ns[0])
    return int(pairs.stamps_ns[-1] - pairs.stamps_ns[0]) / span if span else 0.0


def _path(Ts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance travelled up to each pose (N,), metres."""
    steps = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1)
    path: NDArray[np.float64] = np.concatenate([[0.0], np.cumsum(steps)])
    return path


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt((values**2).mean()))
