"""Lines of a graph as text: a tag, names of vertices, numbers.

    EDGE_SE2 3 4 1.02 -0.01 0.31 500 0 0 500 0 5000

g2o and TORO files are lists of such lines in any order. They are grouped by their tag and each
group becomes two arrays at once, so that a graph of ten thousand poses is read in a fraction of a
second; only where that fails are lines looked at one by one, to name the broken one. Empty lines
and comments (#) are passed over. O(size of the file).
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, nearest_name

__all__ = ["Array", "Index", "Layout", "Lines", "Rows", "parse_lines"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Layout:
    """What follows a tag: so many whole numbers (-1: any), then so many numbers."""

    ids: int
    numbers: int


@dataclass(frozen=True)
class Rows:
    """The lines of one tag.

    Attributes:
        ids: (n, k) names of vertices.
        numbers: (n, m) what follows them.
        lines: (n,) line numbers, from 1.
    """

    ids: Index
    numbers: Array
    lines: Index

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def of(cls, ids: Index, numbers: Array) -> "Rows":
        """Return rows that stand in no file yet; ids (n,) or (n, k)."""
        return cls(ids[:, None] if ids.ndim == 1 else ids, numbers, np.zeros(len(ids), np.int64))

    @classmethod
    def none(cls, layout: Layout) -> "Rows":
        """Return no rows of a layout."""
        ids = np.zeros((0, max(layout.ids, 1)), np.int64)
        return cls.of(ids, np.zeros((0, layout.numbers)))


@dataclass(frozen=True)
class Lines:
    """A file, grouped by tag.

    Attributes:
        file: where it stands.
        rows: by tag, in the order in which tags come first.
        skipped: how many lines of each unknown tag were passed over.
    """

    file: Path
    rows: Mapping[str, Rows]
    skipped: Mapping[str, int]

    def get(self, tag: str, layout: Layout) -> Rows:
        """Return the rows of a tag, none where there are none."""
        return self.rows.get(tag, Rows.none(layout))


def parse_lines(
    file: Path, text: str, layouts: Mapping[str, Layout], skip_unknown: bool = False
) -> Lines:
    """Group the lines of a graph by tag.

    Args:
        file: where the text is from, for messages.
        text: the whole of it.
        layouts: what follows each tag.
        skip_unknown: whether lines of other tags are passed over; else they are an error.

    Raises:
        InputError: names the line that is broken.
    """
    if "\0" in text:
        raise InputError(f"{file}: is not text: give a g2o or TORO file")
    if "#" in text:
        text = re.sub("#[^\n]*", "", text)
    words, numbers = _grouped(text)
    # Python takes 1_000 for a number: only where there are such words, every word is looked at.
    suspect = text.count("_") != sum(tag.count("_") * len(rows) for tag, rows in words.items())
    skipped = {}
    for tag in [tag for tag in words if tag not in layouts]:
        if not skip_unknown:
            raise InputError(f"{file}:{numbers[tag][0]}: {_unknown(tag, layouts)}")
        skipped[tag] = len(words.pop(tag))
    rows = {}
    for tag, lines in words.items():
        row_of = np.array(numbers[tag], np.int64)
        error = _broken(file, tag, layouts[tag], lines, row_of) if suspect else None
        if error is not None:
            raise error
        rows[tag] = _rows(file, tag, layouts[tag], lines, row_of)
    return Lines(file, rows, skipped)


def _grouped(text: str) -> tuple[dict[str, list[list[str]]], dict[str, list[int]]]:
    """Return the words of every line, and its number, by tag."""
    words: dict[str, list[list[str]]] = {}
    numbers: dict[str, list[int]] = {}
    for number, line in enumerate(text.split("\n"), 1):
        row = line.split()
        if not row:
            continue
        tag = row[0]
        if tag not in words:
            words[tag], numbers[tag] = [], []
        words[tag].append(row)
        numbers[tag].append(number)
    return words, numbers


def _unknown(tag: str, layouts: Mapping[str, Layout]) -> str:
    if not tag.isprintable() or not tag.isascii():
        return "is not text of a graph: give a g2o or TORO file"
    if _complaint(tag, whole=False) == "":
        return f"a line begins with a tag, not {tag[:40]}: is it a BAL problem (odomap bundle)?"
    shown = tag if len(tag) <= 40 else f"{tag[:40]}…"
    return f"tag '{shown}' is unknown{nearest_name(tag, layouts)}; --skip-unknown reads the rest"


def _rows(file: Path, tag: str, layout: Layout, words: list[list[str]], lines: Index) -> Rows:
    """Turn the words of one tag into arrays."""
    if layout.ids < 0:  # a list of names, of any length: one row for each
        lines = np.repeat(lines, [len(row) - 1 for row in words])
        words = [[tag, word] for row in words for word in row[1:]]
        layout = Layout(1, 0)
    k, width = layout.ids, 1 + layout.ids + layout.numbers
    try:
        if any(len(row) != width for row in words):
            raise ValueError
        ids = np.array([[int(word) for word in row[1 : 1 + k]] for row in words], np.int64)
        flat = chain.from_iterable(row[1 + k :] for row in words)
        values = np.fromiter(map(float, flat), np.float64, len(words) * layout.numbers)
        if not np.isfinite(values).all():
            raise ValueError
    except (ValueError, OverflowError):
        error = _broken(file, tag, layout, words, lines)
        raise error or InputError(f"{file}: {tag}: cannot be read") from None
    return Rows(ids.reshape(len(words), k), values.reshape(len(words), layout.numbers), lines)


def _broken(
    file: Path, tag: str, layout: Layout, words: list[list[str]], lines: Index
) -> InputError | None:
    """Return what is wrong with the first line that cannot be read."""
    for line, (_, *row) in zip(lines, words):
        want = layout.ids + layout.numbers
        if layout.ids >= 0 and len(row) != want:
            names = "name" if layout.ids == 1 else "names"
            parts = f"{layout.ids} {names} and {layout.numbers} numbers"
            return InputError(f"{file}:{line}: {tag} takes {parts}, {len(row)} of {want} are there")
        for place, word in enumerate(row):
            wrong = _complaint(word, whole=place < layout.ids or layout.ids < 0)
            if wrong:
                return InputError(f"{file}:{line}: {tag}: '{word[:40]}' {wrong}")
    return None


def _complaint(word: str, whole: bool) -> str:
    """Return what is wrong with a word, or nothing."""
    try:
        if "_" in word:
            raise ValueError
        if whole:
            np.int64(int(word))
            return ""
        return "" if np.isfinite(float(word)) else "is not finite"
    except OverflowError:
        return "is too large for the name of a vertex"
    except ValueError:
        return "is not a whole number" if whole else "is not a number"
