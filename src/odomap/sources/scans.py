"""Recordings of a 2D laser: one scan per frame, and what the wheels said then.

What a log writes for a beam is a number, whatever became of it. Here it becomes what it means:

    r ≤ 0, NaN             the beam says nothing           NaN
    r at the log's top     nothing within reach            inf
    else                   a surface at r metres           r

The value for "nothing within reach" is seldom announced. It stands out because it repeats: in a
real room the number of returns falls with the range, so a log whose last thousandth of the ranges
holds three times the readings of the hundredth below it ends in a code (81.83 and 81.91 are those
of lasers of SICK in centimetres, 8.183 in millimetres), and what is in that thousandth is it.

Frames come in the order of measurement, which is that of the log: clocks of old logs jump back by
up to a second while the odometry beside them goes on evenly. Stamps are names there; each is as the
log has it, to the last digit. Ranges are kept in memory, four bytes each (10 MB for an hour of
180 beams at 5 Hz).

Reference: S. Thrun, W. Burgard, D. Fox, "Probabilistic robotics", MIT Press 2005, chapter 6.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sensors.sync import format_stamp
from odomap.sources.source import Skipped

__all__ = ["TOP", "Beams", "LaserLog", "mark", "no_return", "ordered_rows", "planar"]

Array = NDArray[np.float64]

TOP, BELOW = 1e-3, 1e-2
"""Shares of the largest range: where its code may be, and what it is compared with."""
FEWEST = 10
"""So many readings are no accident."""
ORDERS = ("log", "stamps")


@dataclass(frozen=True)
class Beams:
    """What became of the beams of a recording.

    Attributes:
        no_return_m: the reading that means that nothing returned; inf if there is none.
        share_no_return: share of all beams from which nothing returned.
        share_invalid: share of all beams that say nothing (zero, negative, NaN, too near).
    """

    no_return_m: float
    share_no_return: float
    share_invalid: float

    @staticmethod
    def of(ranges: NDArray[np.floating], no_return_m: float) -> "Beams":
        """Return the shares in marked ranges."""
        count = max(ranges.size, 1)
        return Beams(
            no_return_m,
            int(np.isinf(ranges).sum()) / count,
            int(np.isnan(ranges).sum()) / count,
        )


@dataclass(eq=False, repr=False)
class LaserLog:
    """Scans of one 2D laser, in memory; a `RandomAccess`.

    Attributes:
        name: short name.
        rig: the laser, on a body that is where the wheels' odometry says, or else the laser.
        stamps_ns: (N,) int64 as in the log, none twice; in order of measurement.
        ranges: (N, beams) float32 metres, NaN where invalid, inf where nothing returned.
        odometry: (N, 4, 4) T_odom_body, if recorded.
        beams: what became of them.
        left_out: what the log had to leave out.
        notes: what was found odd and mended, for the user.
        details: facts for people.
        truth: None: logs have none.
        skipped: `left_out`.
    """

    name: str
    rig: Rig
    stamps_ns: NDArray[np.int64]
    ranges: NDArray[np.float32]
    odometry: Array | None
    beams: Beams
    left_out: list[Skipped] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    truth: Trajectory | None = None
    skipped: list[Skipped] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.skipped = list(self.left_out)
        if self.odometry is not None:
            self.odometry.setflags(write=False)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        count, beams = self.ranges.shape
        return f"{type(self).__name__}({self.name}: {count} scans of {beams} beams)"

    def __iter__(self) -> Iterator[Frame]:
        """Yield the scans in order of measurement."""
        self.skipped = list(self.left_out)
        return map(self.frame, range(len(self)))

    def frame(self, index: int) -> Frame:
        """Return one scan.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return Frame(
            id=index,
            stamp_ns=int(self.stamps_ns[index]),
            scan=self.ranges[index].astype(np.float64),
            odometry=None if self.odometry is None else self.odometry[index],
        )


def no_return(ranges: NDArray[np.floating]) -> float:
    """Find the reading that means that nothing returned; those a little below mean it, too.

    Args:
        ranges: readings as in the log, any shape, metres.

    Returns:
        The largest reading, or inf if it does not repeat as a code does.
    """
    valid = ranges[np.isfinite(ranges) & (ranges > 0)]
    if valid.size == 0:
        return float("inf")
    largest = float(valid.max())
    top = int((valid >= (1 - TOP) * largest).sum())
    below = int((valid >= (1 - BELOW) * largest).sum()) - top
    return largest if top >= FEWEST and top > 3 * below else float("inf")


def mark(ranges: NDArray[np.float32], nearest: float, farthest: float) -> None:
    """Set readings to what they mean, in place.

    Args:
        ranges: readings, metres; NaN where invalid and inf where nothing returned afterwards.
        nearest: what is nearer, zero or negative is invalid.
        farthest: from here on nothing returned.
    """
    ranges[ranges >= farthest] = np.inf
    with np.errstate(invalid="ignore"):
        ranges[(ranges <= 0) | (ranges < nearest)] = np.nan


def ordered_rows(
    stamps_ns: NDArray[np.int64], order: str, names: list[str], left_out: list[Skipped],
    notes: list[str],
) -> NDArray[np.intp]:  # fmt: skip
    """Bring scans in order, and leave out those whose stamp another one has.

    Args:
        stamps_ns: (N,) in the order of the log.
        order: "log" keeps that order; "stamps" sorts by them.
        names: (N,) what to call a scan that is left out.
        left_out: gets what is left out.
        notes: gets what is odd.

    Returns:
        Rows to keep, in order.

    Raises:
        InputError: there is no such order.
    """
    if order not in ORDERS:
        raise InputError(f"order '{order}' is none of {', '.join(ORDERS)}")
    _, first = np.unique(stamps_ns, return_index=True)
    rows = np.sort(first)
    for row in np.setdiff1d(np.arange(len(stamps_ns)), rows).tolist():
        stamp = int(stamps_ns[row])
        reason = f"stamp {format_stamp(stamp)} is repeated"
        left_out.append(Skipped(stamp, names[row], reason))
    steps = np.diff(stamps_ns[rows])
    if order == "stamps":
        rows = rows[np.argsort(stamps_ns[rows], kind="stable")]
    if (steps < 0).any():
        what = "sorted by stamp" if order == "stamps" else "scans stay in the order of the log"
        notes.append(
            f"{int((steps < 0).sum())} stamps go back, by {-steps.min() * 1e-9:.3f} s at most: "
            f"{what}"
        )
    return rows


def planar(poses: Array) -> Array:
    """Return (N, 4, 4) poses in space of (N, 3) x, y, heading in the plane."""
    Ts = np.tile(np.eye(4), (len(poses), 1, 1))
    Ts[:, 0, 0] = Ts[:, 1, 1] = np.cos(poses[:, 2])
    Ts[:, 1, 0] = np.sin(poses[:, 2])
    Ts[:, 0, 1] = -Ts[:, 1, 0]
    Ts[:, :2, 3] = poses[:, :2]
    return Ts
