"""Stamps: from the text of a recording to integer nanoseconds, in order, in pairs.

Today's epoch in nanoseconds has 19 digits and a double holds 16, so a stamp that passes through a
float is off by up to 128 ns and no longer equals itself in another file. Here a stamp's text goes
to an integer by decimal arithmetic alone: digits d with e places after the point mean

    stamp_ns = d · 10^(u - e),    u = 9, 6, 3, 0 for a column in s, ms, µs, ns

Which u a column has is guessed from its median step and its size: a step between 0.5 ms and 10 s is
a sensor's, and a value between the years 2000 and 2100 is an epoch. A column that is plausible as
announced is never reinterpreted.

Order: rows are sorted stably, and of rows with one stamp the first stays. Pairs: of two ordered
streams each stamp takes its nearest partner within a tolerance, and both must agree: O(N log N).

Reference: D. L. Mills, "Internet time synchronization: the network time protocol", IEEE Trans.
Communications 39(10), 1991 (on stamps as fixed-point integers).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "StampColumn",
    "StampOrder",
    "format_stamp",
    "guess_unit",
    "order_stamps",
    "pair_stamps",
    "parse_stamp",
    "read_stamps",
]

UNITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Decimal exponent that takes a unit to nanoseconds."""
WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
EPOCH_S = (946_684_800.0, 4_102_444_800.0)
"""From the year 2000 to the year 2100."""
STEP_S = (5e-4, 10.0)
"""Steps a sensor may have: 2 kHz to one frame in ten seconds."""

_NUMBER = re.compile(r"([+-]?)(\d*)(?:\.(\d*))?(?:[eE]([+-]?\d{1,3}))?")


def parse_stamp(text: str, unit: str = "s") -> int:
    """Parse a decimal number into integer nanoseconds without passing through a float.

    Args:
        text: the number: "1403636584763555584", "1311868164.363181", "1.000000e-01".
        unit: what it counts: "s", "ms", "us" or "ns".

    Returns:
        Nanoseconds; what lies below is rounded half to even.

    Raises:
        ValueError: it is not a finite decimal number, or does not fit 64 bits.

    Example:
        >>> parse_stamp("1311868164.363181")
        1311868164363181000
    """
    match = _NUMBER.fullmatch(text.strip())
    if match is None or not (match[2] or match[3]):
        raise ValueError(f"stamp '{text.strip()}' is not a number")
    fraction = match[3] or ""
    shift = UNITS[unit] - len(fraction) + int(match[4] or 0)
    digits = int(match[2] + fraction)
    if digits and shift > 19:
        raise ValueError(f"stamp '{text.strip()}' does not fit 64 bits of nanoseconds")
    stamp = digits * 10**shift if shift >= 0 else _round_half_even(digits, 10**-shift)
    if stamp >= 2**63:
        raise ValueError(f"stamp '{text.strip()}' does not fit 64 bits of nanoseconds")
    return -stamp if match[1] == "-" else stamp


def _round_half_even(numerator: int, denominator: int) -> int:
    whole, rest = divmod(numerator, denominator)
    return whole + (2 * rest > denominator or (2 * rest == denominator and whole % 2 == 1))


def format_stamp(stamp_ns: int) -> str:
    """Write integer nanoseconds as seconds with nine places: the inverse of `parse_stamp`."""
    whole, rest = divmod(abs(int(stamp_ns)), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def guess_unit(values: NDArray[np.float64], expected: str, rate_hz: float = 0.0) -> str:
    """Guess what a column of stamps counts.

    Args:
        values: (N,) stamps as they stand in the file; only the finite ones are looked at.
        expected: the unit the format prescribes.
        rate_hz: nominal rate of the sensor; 0 when unknown.

    Returns:
        "s", "ms", "us" or "ns": `expected` wherever that is plausible, or nothing is.
    """
    values = np.unique(values[np.isfinite(values)])
    if len(values) == 0:
        return expected
    size = float(np.median(np.abs(values)))
    step = float(np.median(np.diff(values))) if len(values) > 1 else 0.0
    seconds = {unit: 10.0 ** (exponent - 9) for unit, exponent in UNITS.items()}
    low, high = (1 / (30 * rate_hz), 30 / rate_hz) if rate_hz > 0 else STEP_S
    fits = [u for u, s in seconds.items() if step == 0.0 or low <= step * s <= high]
    epochs = [u for u in fits if EPOCH_S[0] <= size * seconds[u] <= EPOCH_S[1]]
    if expected in epochs or (expected in fits and not epochs) or not fits:
        return expected
    if epochs:
        return epochs[0]
    if step == 0.0:
        return expected
    nominal = 1 / rate_hz if rate_hz > 0 else 0.05
    return min(fits, key=lambda u: abs(np.log(step * seconds[u] / nominal)))


@dataclass(frozen=True)
class StampColumn:
    """A column of stamps as read.

    Attributes:
        stamps_ns: (N,) int64; 0 where the text was no stamp.
        valid: (N,) bool.
        unit: what the column counts.
        note: a sentence for the user if that is not what the format prescribes, else empty.
    """

    stamps_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    unit: str
    note: str


def read_stamps(texts: Sequence[str], expected: str, rate_hz: float = 0.0) -> StampColumn:
    """Read a column of stamps exactly, in whatever unit it turns out to be.

    Args:
        texts: one stamp per row, as text.
        expected: the unit the format prescribes: "s", "ms", "us" or "ns".
        rate_hz: nominal rate of the sensor; 0 when unknown.

    Returns:
        The stamps in file order, with a mask of those that are numbers.
    """
    unit = guess_unit(np.array([_approximate(text) for text in texts]), expected, rate_hz)
    stamps = np.zeros(len(texts), np.int64)
    valid = np.zeros(len(texts), np.bool_)
    for row, text in enumerate(texts):
        try:
            stamps[row] = parse_stamp(text, unit)
            valid[row] = True
        except ValueError:
            continue
    note = ""
    if unit != expected:
        note = f"stamps are in {WORDS[unit]}, not in {WORDS[expected]}: converted"
    return StampColumn(stamps, valid, unit, note)


def _approximate(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


@dataclass(frozen=True)
class StampOrder:
    """How to bring a stream in order.

    Attributes:
        order: (M,) rows to keep, by increasing stamp.
        repeated: rows whose stamp an earlier row has, to be dropped.
        disordered: how many rows came earlier than the row before them.
    """

    order: NDArray[np.intp]
    repeated: NDArray[np.intp]
    disordered: int


def order_stamps(stamps_ns: NDArray[np.int64]) -> StampOrder:
    """Find the order of a stream in time, and its repeated rows.

    Args:
        stamps_ns: (N,) in file order.

    Returns:
        Rows to keep in order, rows to drop, and how many were out of order.
    """
    order = np.argsort(stamps_ns, kind="stable")
    ordered = stamps_ns[order]
    first = np.ones(len(ordered), np.bool_)
    first[1:] = ordered[1:] != ordered[:-1]
    disordered = int(np.count_nonzero(stamps_ns[1:] < stamps_ns[:-1]))
    return StampOrder(order[first], np.sort(order[~first]), disordered)


def pair_stamps(
    first_ns: NDArray[np.int64], second_ns: NDArray[np.int64], tolerance_ns: int = 0
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair two streams: each stamp with its nearest in the other, where both agree.

    Args:
        first_ns: (N,) strictly increasing.
        second_ns: (M,) strictly increasing.
        tolerance_ns: the most by which the stamps of a pair may differ.

    Returns:
        Indices into both, equally long and increasing.
    """
    if len(first_ns) == 0 or len(second_ns) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    to_second = _nearest(first_ns, second_ns)
    to_first = _nearest(second_ns, first_ns)
    rows = np.arange(len(first_ns))
    near = np.abs(first_ns - second_ns[to_second]) <= tolerance_ns
    agreed = near & (to_first[to_second] == rows)
    return rows[agreed], to_second[agreed]


def _nearest(queries: NDArray[np.int64], stamps: NDArray[np.int64]) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(stamps, queries), 0, len(stamps) - 1)
    left = np.maximum(right - 1, 0)
    is_left = np.abs(stamps[left] - queries) <= np.abs(stamps[right] - queries)
    return np.where(is_left, left, right)
