"""Text tables: rows of numbers with comments, as trajectories and sensor logs have them.

A row is one line; commas, semicolons and blanks separate; '#' starts a comment. The first cell
can be kept as text, because a stamp must not become a float (see `odomap.sensors.sync`). Every
complaint names the file and the line. Files may be gzipped, whatever their name says.
"""

import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError

__all__ = ["Table", "read_lines", "read_table", "read_text"]

_GZIP = b"\x1f\x8b"


@dataclass(frozen=True)
class Table:
    """Rows of numbers from a text file.

    Attributes:
        stamps: the first cell of each row as text, or empty if it was read as a number.
        values: (N, columns) the other cells.
        lines: (N,) line numbers, from 1.
    """

    stamps: list[str]
    values: NDArray[np.float64]
    lines: list[int]

    def __len__(self) -> int:
        return len(self.lines)


def read_text(path: Path, packed: bool = True) -> str:
    """Read a text file, unpacking gzip.

    Args:
        path: the file.
        packed: False takes gzip for a text like any other.

    Raises:
        InputError: it is missing, unreadable or a broken gzip.
    """
    try:
        data = path.read_bytes()
        if packed and data[:2] == _GZIP:
            data = gzip.decompress(data)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise InputError(f"{path}: broken gzip ({error}): copy it again") from error
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    return data.decode("utf-8-sig", errors="replace")


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of every line that is neither empty nor a comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        cells = line.split("#", 1)[0].replace(",", " ").replace(";", " ").split()
        if cells:
            yield number, cells


def read_table(path: Path, columns: int, *, has_stamp: bool, exact: bool = True) -> Table:
    """Read rows of numbers.

    Args:
        path: the file.
        columns: cells a row must have, the stamp included.
        has_stamp: whether the first cell is a stamp, to be kept as text.
        exact: whether more cells than `columns` are an error (else they are ignored).

    Raises:
        InputError: a row has another length, or a cell is not a finite number.
    """
    stamps: list[str] = []
    lines: list[int] = []
    rows: list[list[float]] = []
    first = 1 if has_stamp else 0
    for number, cells in read_lines(path):
        if len(cells) < columns or (exact and len(cells) != columns):
            raise InputError(f"{path}:{number}: expected {columns} numbers, got {len(cells)}")
        try:
            rows.append([float(cell) for cell in cells[first:columns]])
        except ValueError:
            bad = next(cell for cell in cells[first:columns] if not _is_number(cell))
            raise InputError(f"{path}:{number}: '{bad}' is not a number") from None
        lines.append(number)
        if has_stamp:
            stamps.append(cells[0])
    values = np.array(rows, np.float64).reshape(len(rows), columns - first)
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        number = lines[int(np.argmin(finite))]
        raise InputError(f"{path}:{number}: NaN or infinite value: remove the row")
    return Table(stamps, values, lines)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
