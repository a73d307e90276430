"""Lines of logs: plain text, gzip or bzip2, read one after the other.

A log ends where its writer was stopped, and a file where its copy was: what can be unpacked before
the cut is read, and the rest is told. A line is at most a megabyte, so that something else than
text cannot fill the memory; what is not text comes out as lines that nobody recognises.
"""

import bz2
import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

from odomap.errors import InputError

__all__ = ["LogLines", "beginnings"]

LONGEST = 1 << 20
"""Bytes of a line."""
PEEKED_LINES = 200
"""So many lines say what a log is."""


class LogLines:
    """The lines of a log, numbered from 1; iterate it once.

    Args:
        path: the file; what packs it is told by its first bytes, not by its name.

    Attributes:
        cut: why the end of it could not be unpacked, or empty; known when the iteration is over.
        is_whole: whether the last line ended in a newline, as all do that were written out.

    Raises:
        InputError: while iterating: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut = ""
        self.is_whole = True

    def __iter__(self) -> Iterator[tuple[int, str]]:
        """Yield number and text of every line."""
        try:
            with _unpacked(self.path) as file:
                yield from self._lines(file)
        except OSError as error:
            raise InputError(f"{self.path}: {error.strerror or error}") from error

    def _lines(self, file: BinaryIO) -> Iterator[tuple[int, str]]:
        number, goes_on = 1, False
        while True:
            try:
                line = file.readline(LONGEST)
            except (EOFError, OSError, zlib.error) as error:
                self.cut = f"cannot be unpacked to its end ({error}): copied in part?"
                return
            if not line:
                return
            is_end = line.endswith(b"\n")
            # The rest of a line that is too long is thrown away.
            if not goes_on:
                yield number, line.decode("ascii", errors="replace")
            number += is_end
            goes_on, self.is_whole = not is_end, is_end


def beginnings(path: Path) -> list[str]:
    """Return the first words of the first lines of a file, none if it is not text.

    Raises:
        InputError: it cannot be read, or nothing of it can be unpacked.
    """
    words: list[str] = []
    lines = LogLines(path)
    for number, line in lines:
        if number > PEEKED_LINES:
            break
        words += line.split(maxsplit=1)[:1]
    if lines.cut and not words:
        raise InputError(f"{path}: {lines.cut}")
    return words


def _unpacked(path: Path) -> BinaryIO:
    with path.open("rb") as file:
        magic = file.read(3)
    if magic[:2] == b"\x1f\x8b":
        return cast(BinaryIO, gzip.open(path, "rb"))
    if magic == b"BZh":
        return cast(BinaryIO, bz2.open(path, "rb"))
    return path.open("rb")
