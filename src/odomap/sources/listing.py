"""Listings: which image belongs to which instant, from a csv file or the names in a folder.

A listing is read forgivingly, because one bad row must not cost a recording: rows without a
usable stamp and repeated stamps are left out and noted, rows out of order are sorted, a column in
another unit than the format prescribes is converted. It is an error only if nothing is left.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.text import read_lines
from odomap.sensors.sync import order_stamps, read_stamps
from odomap.sources.source import Skipped

__all__ = ["Listing", "images_in", "list_rows", "read_listing"]

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff", ".webp")


@dataclass(frozen=True)
class Listing:
    """Stamped names, in order of time.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing.
        names: (N,) file names.
        skipped: rows that were left out.
        notes: what was found odd and mended, for the user.
    """

    stamps_ns: NDArray[np.int64]
    names: list[str]
    skipped: list[Skipped] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.names)


def read_listing(folder: Path, rate_hz: float, label: str) -> Listing:
    """Read the `data.csv` of a EuRoC camera; without one, take the stamps from the file names.

    Args:
        folder: the camera's folder, with `data.csv` and `data/`.
        rate_hz: nominal rate, 0 when unknown.
        label: what to call the file in notes.

    Raises:
        InputError: there is neither, or no row has a usable stamp.
    """
    file = folder / "data.csv"
    if not file.exists():
        names = images_in(folder / "data")
        if not names:
            raise InputError(f"{folder}: neither data.csv nor images in data/")
        rows = [(0, Path(name).stem, name) for name in names]
        listing = list_rows(rows, "ns", rate_hz, folder / "data", label)
        note = f"{label} is missing: stamps are taken from the names of the images"
        listing.notes.insert(0, note)
        return listing
    rows = []
    for number, cells in read_lines(file):
        name = cells[1] if len(cells) > 1 else f"{cells[0]}.png"
        rows.append((number, cells[0], name))
    return list_rows(rows, "ns", rate_hz, file, label)


def list_rows(
    rows: Sequence[tuple[int, str, str]], unit: str, rate_hz: float, file: Path, label: str
) -> Listing:
    """Bring rows (line number, stamp as text, name) in order.

    Raises:
        InputError: no row has a usable stamp, or most rows share theirs.
    """
    if not rows:
        raise InputError(f"{file}: no rows: the file is empty")
    column = read_stamps([stamp for _, stamp, _ in rows], unit, rate_hz)
    notes = [f"{label}: {column.note}"] if column.note else []
    skipped = []
    for row in np.flatnonzero(~column.valid).tolist():
        number, stamp, name = rows[row]
        skipped.append(Skipped(0, name, f"line {number}: stamp '{stamp}' is not a number"))
    good = np.flatnonzero(column.valid)
    if len(good) == 0:
        number, stamp, _ = rows[0]
        raise InputError(f"{file}:{number}: stamp '{stamp}' is not a number, nor is any other")
    order = order_stamps(column.stamps_ns[good])
    for row in good[order.repeated].tolist():
        number, stamp, name = rows[row]
        reason = f"line {number}: stamp {stamp} is repeated"
        skipped.append(Skipped(int(column.stamps_ns[row]), name, reason))
    if len(order.repeated) > len(order.order):
        raise InputError(
            f"{file}: {len(order.repeated)} of {len(good)} stamps are repeated (like "
            f"{rows[good[order.repeated[0]]][1]}): were digits lost, as in a spreadsheet?"
        )
    if order.disordered:
        notes.append(f"{label}: {order.disordered} stamps out of order: sorted")
    kept = good[order.order]
    return Listing(column.stamps_ns[kept], [rows[row][2] for row in kept.tolist()], skipped, notes)


def images_in(folder: Path) -> list[str]:
    """Return the sorted names of the image files in a folder; none if there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(
        entry.name
        for entry in folder.iterdir()
        if entry.suffix.lower() in SUFFIXES and not entry.name.startswith(".")
    )
