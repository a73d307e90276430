"""Times of points: what a field counts that nobody announced, from the sweeps themselves.

Drivers call it t, time, timestamp or offset_time and mean nanoseconds, microseconds, milliseconds
or seconds, since the stamp, since 1970, or of the sensor's own clock. The unit shows in how much a
sweep spans: P seconds from one sweep to the next, a sweep lasts about as long, and of units that
are a thousand apart only one makes

    P/50 ≤ unit · (largest - smallest) ≤ 4 P.

Where values are small against the time since 1970 they are relative to the stamp (to its begin,
its end or its middle: as they say). Values that lie around the stamps themselves are absolute. Else
they are of another clock, and the first point of a sweep is taken to be of its stamp.

Whole numbers are subtracted as such: a double holds today's nanoseconds to 256.

Reference: D. L. Mills, "Internet time synchronization: the network time protocol", IEEE Trans.
Communications 39(10), 1991.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sensors.sync import UNITS, WORDS

__all__ = ["PointTimes", "times_of"]

SPANS = (0.02, 4.0)
"""Times of a sweep go over so much of the step between sweeps, at least and at most."""
ALONE_S = (0.01, 1.0)
"""Spans of a sweep whose step is not known."""
REACH = 3.0
"""Steps between sweeps within which its times are around a stamp."""


@dataclass(frozen=True)
class PointTimes:
    """What a field of times means.

    Attributes:
        unit: "s", "ms", "us" or "ns".
        since: "stamp", "epoch" for the clock of the stamps, or "own" for another one.
        reach_s: farthest from the stamp that a time may be.
    """

    unit: str
    since: str
    reach_s: float

    def __str__(self) -> str:
        since = {
            "stamp": "since the stamp",
            "epoch": "absolute",
            "own": "of another clock: the first point is taken to be of the stamp",
        }
        return f"in {WORDS[self.unit]}, {since[self.since]}"

    def seconds(
        self, raw: NDArray[np.generic], stamp_ns: int, seen: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """Return (N,) seconds since the stamp; None if a sweep's times cannot be its own.

        Args:
            raw: (N,) as recorded.
            stamp_ns: of the sweep.
            seen: (N,) which points returned; times of others may be anything and become 0.
        """
        times = np.zeros(len(raw))
        if not seen.any():
            return times
        begin = {"stamp": 0, "epoch": stamp_ns}.get(self.since)
        if seen.all():
            times = _since(raw, self.unit, begin)
        else:
            times[seen] = _since(raw[seen], self.unit, begin)
        if not (np.abs(times) <= self.reach_s).all():
            return None
        return times


def _since(values: NDArray[np.generic], unit: str, begin_ns: int | None) -> NDArray[np.float64]:
    """Return values in seconds since a begin in ns, or since the smallest."""
    scale = 10 ** UNITS[unit]
    if values.dtype.kind in "iu":
        # The whole units before the begin are taken off exactly, what is left of one afterwards.
        first = int(values.min()) if begin_ns is None else begin_ns // scale
        rest = 0 if begin_ns is None else begin_ns - first * scale
        if values.dtype.kind == "u" and first >= 0:
            above, below = values >= np.uint64(first), np.uint64(first)
            wide = values.astype(np.uint64)
            parts = np.where(above, wide - below, below - wide).astype(np.float64)
            whole = np.where(above, parts, -parts)
        else:
            whole = (values.astype(np.int64) - first).astype(np.float64)
        return np.asarray((whole * scale - rest) * 1e-9)
    numbers = values.astype(np.float64)
    if begin_ns is None:
        return np.asarray((numbers - np.nanmin(numbers)) * scale * 1e-9)
    whole_s, rest_ns = divmod(begin_ns, 10**9)
    per_s = 10 ** (9 - UNITS[unit])
    return np.asarray((numbers - float(whole_s) * per_s) / per_s - rest_ns * 1e-9)


def times_of(
    name: str, columns: Sequence[NDArray[np.generic]], stamps_ns: Sequence[int], step_s: float,
    unit: str = "",
) -> PointTimes | None:  # fmt: skip
    """Find out what a field of times means.

    Args:
        name: of the field, for the message.
        columns: its values in some sweeps, of points that returned.
        stamps_ns: of these sweeps.
        step_s: usual time from sweep to sweep; 0 when unknown.
        unit: what it counts, where that is known.

    Returns:
        What it means, or None if all points of a sweep have one time.

    Raises:
        InputError: no unit fits.
    """
    numbers = [c[np.isfinite(c)] if c.dtype.kind == "f" else c for c in columns]
    kept = [(c, s) for c, s in zip(numbers, stamps_ns, strict=True) if len(c) > 1]
    spans = [_span(column) for column, _ in kept]
    span = float(np.median(spans)) if spans else 0.0
    if not kept and any(len(column) > 1 for column in columns):
        raise InputError(f"times of points in '{name}' are no numbers: leave them out by ?time=off")
    if span <= 0:
        return None
    low, high = (s * step_s for s in SPANS) if step_s > 0 else ALONE_S
    fits = [u for u, e in UNITS.items() if low <= span * 10.0 ** (e - 9) <= high]
    if unit and unit in UNITS:
        fits = [unit]
    if not fits:
        about = f"{step_s:.3g} s" if step_s > 0 else "a second or less"
        raise InputError(
            f"times of points in '{name}' go over {span:g} in a sweep, which is about {about} in "
            "no unit (s, ms, us, ns): say it by ?unit=us, or leave them out by ?time=off"
        )
    reach = REACH * (step_s if step_s > 0 else ALONE_S[1])
    for since, begins in (("stamp", [0] * len(kept)), ("epoch", [s for _, s in kept])):
        far = [
            np.abs(_since(column, fits[0], begin)).max()
            for (column, _), begin in zip(kept, begins, strict=True)
        ]
        if float(np.median(far)) <= reach:
            return PointTimes(fits[0], since, reach)
    return PointTimes(fits[0], "own", reach)


def _span(column: NDArray[np.generic]) -> float:
    if column.dtype.kind in "iu":
        return float(int(column.max()) - int(column.min()))
    return float(column.max()) - float(column.min())
