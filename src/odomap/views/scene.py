"""What plots of a path share: which way is up, how much to draw, which unit to write.

A world frame has gravity along −z, unless it is the first camera itself, with y down: then the
first pose is the identity, and the path runs along z, or hardly along y.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.trajectory import Trajectory
from odomap.views.patherror import PathError, finite_part

__all__ = ["AXES", "Scene", "gaps_as_nan", "scene", "thin", "unit_of"]

AXES = "xyz"
FLAT = 0.3
"""A path whose least extent is below this share of its middle one is flat."""

SAME_AXES = 2.9
"""Trace of a rotation from which on (18°) the first pose counts as the identity."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A path ready to draw, in the world of the truth where there is one.

    Attributes:
        stamps_ns: (N,) stamps of the positions, nanoseconds.
        positions: (N, 3) of the path, metres, finite.
        rotations: (N, 3, 3) of the body.
        truth: (M, 3) positions of the truth while the path lasts, or None.
        distances: (N,) distance to the truth, metres, filled in between matches; None without it.
        up_axis: index of the vertical axis.
        up_sign: +1 where that axis points up, −1 where down.
        T_drawn_world: (4, 4) what was applied to the estimate's world.
    """

    stamps_ns: NDArray[np.int64]
    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    truth: NDArray[np.float64] | None
    distances: NDArray[np.float64] | None
    up_axis: int
    up_sign: float
    T_drawn_world: NDArray[np.float64]

    @property
    def ground(self) -> tuple[int, int]:
        """The two horizontal axes, in order."""
        a, b = (k for k in range(3) if k != self.up_axis)
        return a, b


def scene(trajectory: Trajectory | None, truth: Trajectory | None) -> Scene | None:
    """Lay a path on its truth and find which way is up; None where there is no path."""
    index = finite_part(trajectory)
    if trajectory is None or len(index) == 0:
        return None
    stamps = trajectory.stamps_ns[index]
    Ts = trajectory.Ts_world_body[index]
    error = PathError.of(trajectory, truth)
    true: NDArray[np.float64] | None = None
    distances: NDArray[np.float64] | None = None
    T = np.eye(4)
    R_first = Ts[0, :3, :3]
    if error is not None and truth is not None:
        T = error.T_truth_estimate.matrix
        Ts = T @ Ts
        true = truth.between(int(stamps[0]), int(stamps[-1])).positions
        # The truth's own rotation: a straight path leaves the roll of the alignment open.
        R_first = truth.Ts_world_body[0, :3, :3]
        at = stamps.astype(np.float64) - float(stamps[0])
        known = error.stamps_ns.astype(np.float64) - float(stamps[0])
        distances = np.interp(at, known, error.distances)
    positions = np.ascontiguousarray(Ts[:, :3, 3])
    axis, sign = _up(positions, R_first)
    return Scene(stamps, positions, Ts[:, :3, :3], true, distances, axis, sign, T)


def _up(positions: NDArray[np.float64], R_first: NDArray[np.float64]) -> tuple[int, float]:
    extents = np.ptp(positions, axis=0)
    least, middle, most = np.sort(extents)
    flat_in_y = middle > 0 and least < FLAT * middle and extents[1] == least
    along_z = most > 0 and extents[2] == most
    if np.trace(R_first) > SAME_AXES and (flat_in_y or along_z):
        return 1, -1.0
    return 2, 1.0


def thin(n: int, limit: int) -> NDArray[np.intp]:
    """Return at most `limit` indices spread evenly over n items, first and last among them."""
    if n <= limit:
        return np.arange(n)
    return np.unique(np.linspace(0, n - 1, limit).round().astype(np.intp))


def gaps_as_nan(stamps_ns: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Put NaN at the first value after a gap in time, so that no line is drawn across it."""
    out = np.array(values, dtype=np.float64)
    if len(stamps_ns) > 2:
        steps = np.diff(stamps_ns)
        out[1:][steps > 5 * np.median(steps)] = np.nan
    return out


def unit_of(largest: float) -> tuple[float, str]:
    """Return (factor, unit) that makes a length in metres readable on an axis."""
    if largest >= 1.0:
        return 1.0, "m"
    return (100.0, "cm") if largest >= 0.1 else (1000.0, "mm")
