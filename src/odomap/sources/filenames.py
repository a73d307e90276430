"""File names as order and time: what the name of an image says of when it was taken.

Natural order compares the numbers in names as numbers, so 9 comes before 10. The last number of a
name is either a counter or a clock. A clock is told by its size (the epoch of today in s, ms, µs or
ns), by a decimal point, or by its step: counters step by one or a few, clocks in µs or ns by ten
thousand or more. Without a clock, image n of a counter that usually steps by s is taken at

    t_n = (counter_n - counter_0) / (s · rate),

so that an image that is missing leaves a gap and does not shift those behind it.

Reference: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012
(stamps as file names).
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.text import read_lines
from odomap.sensors.sync import EPOCH_S, STEP_S, UNITS, guess_unit, pair_stamps
from odomap.sources.listing import list_rows
from odomap.sources.source import Skipped

__all__ = ["Clock", "in_order", "pair_names", "stamp_names"]

RATE_HZ = 30.0
PAIR_TOLERANCE_NS = 5_000_000
"""Left and right of a pair may differ by 5 ms."""
CLOCK_STEP = 10_000
"""Numbers that step by so much or more are no counters."""
SPARSE = 2
"""A counter that skips more than that many of its numbers is none."""
_LAST = re.compile(r"(\d+(?:\.\d+)?)\D*$")


@dataclass(frozen=True)
class Clock:
    """What tells the time of images.

    Attributes:
        file: a file of times, or None.
        rate_hz: nominal rate of the camera; 0 when unknown.
        folder: where the images are, for messages.
        kind: what they are, for messages.
    """

    file: Path | None
    rate_hz: float
    folder: Path
    kind: str = "images"


def in_order(names: Iterable[str]) -> list[str]:
    """Return names in natural order.

    Example:
        >>> in_order(["10.png", "9.png"])
        ['9.png', '10.png']
    """
    return sorted(names, key=lambda name: (_pieces(name), name))


def _pieces(name: str) -> list[tuple[int, str]]:
    """Return a name as texts and numbers that compare: (-1, text), (number, "")."""
    pieces = re.split(r"(\d+)", name.lower())
    return [(int(piece), "") if piece.isdigit() else (-1, piece) for piece in pieces]


def pair_names(
    folders: Sequence[Path], lists: Sequence[Sequence[str]]
) -> tuple[list[list[str]], list[Skipped]]:
    """Pair the images of two folders: by name, by the number in the name, or by stamp.

    Args:
        folders: the two folders.
        lists: their images.

    Returns:
        The names of each folder, equally long, and what has no partner.

    Raises:
        InputError: nothing fits.
    """
    keys = [[Path(name).stem for name in names] for names in lists]
    if not set(keys[0]) & set(keys[1]):
        keys = [[str(number) for number in _numbers(names)] for names in lists]
    left, right = (_clock_stamps(names) for names in lists)
    if not set(keys[0]) & set(keys[1]) and left is not None and right is not None:
        rows = pair_stamps(left, right, PAIR_TOLERANCE_NS)
    else:
        places = {key: place for place, key in enumerate(keys[1])}
        ours = np.array([i for i, key in enumerate(keys[0]) if key in places], np.intp)
        rows = ours, np.array([places[keys[0][i]] for i in ours.tolist()], np.intp)
    if len(rows[0]) == 0:
        raise InputError(
            f"{folders[1]}: no image has the name, number or stamp of one in {folders[0].name}: "
            "name those that belong together alike"
        )
    left_out = [
        Skipped(0, f"{folder.name}/{names[alone]}", f"has no partner in {other.name}")
        for folder, other, names, side in zip(folders, folders[::-1], lists, rows, strict=True)
        for alone in np.setdiff1d(np.arange(len(names)), side).tolist()
    ]
    return [[names[i] for i in side] for names, side in zip(lists, rows, strict=True)], left_out


def stamp_names(
    names: Sequence[str], clock: Clock, left_out: list[Skipped], notes: list[str]
) -> tuple[list[int], NDArray[np.int64]]:
    """Find out when images were taken.

    Args:
        names: the images in natural order.
        clock: what tells the time.
        left_out: is given those without a time of their own.
        notes: is given what was found odd.

    Returns:
        Which of the images to use, in order of time, and their stamps.

    Raises:
        InputError: the file of times fits none of them.
    """
    if clock.file is not None:
        rows, where, unit = _from_file(clock, clock.file, names, left_out, notes), clock.file, "s"
    else:
        found = _clock_unit(names)
        if found is None:
            return list(range(len(names))), _at_rate(names, clock, notes)
        rows = [(0, _last(name), str(place)) for place, name in enumerate(names)]
        where, unit = clock.folder, found
    listing = list_rows(rows, unit, clock.rate_hz, where, where.name)
    left_out += [Skipped(s.stamp_ns, names[int(s.file)], s.reason) for s in listing.skipped]
    notes += listing.notes
    return [int(place) for place in listing.names], listing.stamps_ns


def _from_file(
    clock: Clock, file: Path, names: Sequence[str], left_out: list[Skipped], notes: list[str]
) -> list[tuple[int, str, str]]:
    """Return (line, time, place of the image) of each image that a file of times tells of."""
    lines = list(read_lines(file))
    places = {key: i for i, name in enumerate(names) for key in (name, Path(name).stem)}
    named = []
    for line, cells in lines:
        found = [k for k, cell in enumerate(cells[:2]) if Path(cell).name in places]
        if len(cells) > 1 and len(found) == 1:
            named.append((line, cells[1 - found[0]], str(places[Path(cells[found[0]]).name])))
    if len(named) >= max(1, len(lines) // 2):
        rows = named
    else:
        numbers = _numbers(names)
        is_counted = len(set(numbers)) == len(names) and max(numbers, default=0) < len(lines)
        order = numbers if is_counted else range(len(names))
        rows = [
            (lines[number][0], lines[number][1][0], str(place))
            for place, number in enumerate(order)
            if number < len(lines)
        ]
        if not is_counted and len(lines) != len(names):
            notes.append(f"{file.name} has {len(lines)} times for {len(names)} {clock.kind}")
    timed = {int(place) for _, _, place in rows}
    left_out += [
        Skipped(0, name, f"{file.name} has no time for it")
        for place, name in enumerate(names)
        if place not in timed
    ]
    if not rows:
        raise InputError(f"{file}: {len(lines)} times for {len(names)} {clock.kind}: none matches")
    return rows


def _last(name: str) -> str:
    """Return the last number in a name, as text; empty if there is none."""
    found = _LAST.search(Path(name).stem)
    return found[1] if found else ""


def _numbers(names: Sequence[str]) -> list[int]:
    """Return the counter each name has: its last number, or else its place."""
    texts = [_last(name) for name in names]
    if all(text.isdigit() for text in texts):
        return [int(text) for text in texts]
    return list(range(len(names)))


def _clock_unit(names: Sequence[str]) -> str | None:
    """Return what the numbers in names count if they are times; None if they are counters."""
    texts = [_last(name) for name in names]
    if not all(texts):
        return None
    values = np.array([float(text) for text in texts])
    steps = np.diff(np.unique(values))
    step = float(np.median(steps)) if len(steps) else 0.0
    expected = "s" if sum("." in text for text in texts) * 2 > len(texts) else "ns"
    unit = guess_unit(values, expected)
    seconds = 10.0 ** (UNITS[unit] - 9)
    is_step = STEP_S[0] <= step * seconds <= STEP_S[1] or len(values) == 1
    is_epoch = EPOCH_S[0] <= float(np.median(values)) * seconds <= EPOCH_S[1]
    if is_step and (is_epoch or step >= CLOCK_STEP or (expected == unit == "s")):
        return unit
    return None


def _clock_stamps(names: Sequence[str]) -> NDArray[np.int64] | None:
    """Return the stamps in names, if they are times and in order."""
    unit = _clock_unit(names)
    if unit is None:
        return None
    rows = [(0, _last(name), name) for name in names]
    listing = list_rows(rows, unit, 0.0, Path(), "")
    return listing.stamps_ns if len(listing) == len(names) else None


def _at_rate(names: Sequence[str], clock: Clock, notes: list[str]) -> NDArray[np.int64]:
    """Return stamps at a rate, with gaps where numbers are missing."""
    rate = clock.rate_hz or RATE_HZ
    counters = np.array(_numbers(names), np.float64)
    steps = np.diff(counters)
    places = np.arange(len(names), dtype=np.float64)
    if len(steps) and np.all(steps > 0):
        counted = (counters - counters[0]) / float(np.median(steps))
        if counted[-1] <= SPARSE * len(names) and np.all(counted == np.round(counted)):
            places = counted
    known = "rate_hz of the calibration" if clock.kind == "images" else "the usual rate"
    whose = known if clock.rate_hz else "set rate_hz in rig.yaml if that is wrong"
    notes.append(
        f"neither times.txt nor the names tell when {clock.kind} were taken: they are taken to be "
        f"{1e3 / rate:.4g} ms apart ({whose})"
    )
    return np.round(places * 1e9 / rate).astype(np.int64)
