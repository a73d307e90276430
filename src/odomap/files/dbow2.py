"""Vocabularies in DBoW2's text format, as ORB-SLAM's is.

    10 6 0 0                                       branching, depth, scoring, weighting
    0 0 63 79 107 ... 241 0                        a node: parent, is it a leaf, 32 bytes, weight
    1 1 12 60 33 ... 9 7.39

Nodes are numbered from 1 in the order of lines, 0 is the root; a parent comes before its children.
Here they are re-ordered level by level. The file is read piece by piece: what is kept of it is
bounded by the largest tree, however long it says to be, and however well it is packed.

Reference: Gálvez-López, Tardós, "Bags of binary words for fast place recognition in image
sequences", T-RO 28(5), 2012.
"""

import gzip
import lzma
import warnings
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.vision.vocabulary import LEAST_BRANCHING, MOST_BRANCHING, MOST_DEPTH, MOST_NODES

__all__ = ["Dbow2Nodes", "read_dbow2_nodes"]

Progress = Callable[[int, int, str], None]

CELLS = 35
"""Numbers in a line: parent, is it a leaf, 32 bytes, weight."""
LONGEST_LINE = 1000
LINES = 8192
"""Lines read at a time."""
TF_IDF, TF = 0, 1
"""Weightings in which a word counts as often as it occurs."""


@dataclass(frozen=True, eq=False)
class Dbow2Nodes:
    """What a file says, its nodes level by level, as `VocabularyTree` has them.

    Attributes:
        branching: children of a node, at most.
        depth: levels below the root, at most.
        centres: (M, 32) uint8, the root first.
        num_children: (M,) int64.
        weights: (W,) float64 of the leaves.
    """

    branching: int
    depth: int
    centres: NDArray[np.uint8]
    num_children: NDArray[np.int64]
    weights: NDArray[np.float64]


def read_dbow2_nodes(path: str | Path, progress: Progress | None = None) -> Dbow2Nodes:
    """Read a vocabulary in DBoW2's text format, plain or packed by gzip or xz.

    Args:
        path: the file.
        progress: called with nodes read, 0 (how many there are is not known) and a text.

    Raises:
        InputError: it cannot be read, or is broken; names the line.
    """
    file = Path(path)
    try:
        with _opened(file) as stream:
            branching, depth = _header(file, stream)
            parts = list(_parts(file, stream, progress))
    except (EOFError, gzip.BadGzipFile, lzma.LZMAError, zlib.error) as error:
        raise InputError(f"{file}: is broken or cut off ({error}): copy it again") from error
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    if not parts:
        raise InputError(f"{file}: has no nodes: it was cut off, copy it again")
    parents, leaves, centres, weights = (np.concatenate(column) for column in zip(*parts))
    order, children = _ordered(file, parents, leaves, branching, depth)
    all_centres = np.concatenate([np.zeros((1, 32), np.uint8), centres])[order]
    all_weights = np.concatenate([[0.0], weights])[order]
    return Dbow2Nodes(branching, depth, all_centres, children, all_weights[children == 0])


def _opened(path: Path) -> BinaryIO:
    with open(path, "rb") as file:
        magic = file.read(6)
    if magic[:2] == b"\x1f\x8b":
        return gzip.open(path)  # type: ignore[return-value]
    if magic == b"\xfd7zXZ\x00":
        return lzma.open(path)  # type: ignore[return-value]
    return open(path, "rb")


def _header(path: Path, stream: BinaryIO) -> tuple[int, int]:
    """Return branching and depth."""
    line = stream.readline(LONGEST_LINE)
    try:
        branching, depth, _, weighting = (int(cell) for cell in line.split())
    except ValueError:
        raise InputError(
            f"{path}:1: is no vocabulary in DBoW2's text format: its first line must be branching, "
            "depth, scoring and weighting, as in '10 6 0 0'"
        ) from None
    if not LEAST_BRANCHING <= branching <= MOST_BRANCHING or not 1 <= depth <= MOST_DEPTH:
        raise InputError(
            f"{path}:1: branching {branching} must be {LEAST_BRANCHING} to {MOST_BRANCHING}, depth "
            f"{depth} 1 to {MOST_DEPTH}"
        )
    if weighting not in (TF_IDF, TF):
        raise InputError(
            f"{path}:1: weighting {weighting} is not read: save it with tf-idf (0) or tf (1)"
        )
    return branching, depth


def _parts(
    path: Path, stream: BinaryIO, progress: Progress | None
) -> Iterator[tuple[NDArray[np.generic], ...]]:
    """Yield parents, leaves, centres and weights, some thousand lines at a time."""
    done = 0
    lines = (line for line in iter(lambda: stream.readline(LONGEST_LINE), b"") if line.strip())
    while part := list(islice(lines, LINES)):
        if done + len(part) > MOST_NODES:
            raise InputError(f"{path}: has more than {MOST_NODES} nodes: that is too much")
        values = _numbers(path, part, done + 2)
        low, high = np.zeros(CELLS), np.full(CELLS, 255.0)
        high[0], high[1], high[-1] = MOST_NODES, 1, 1e6
        known = done + np.arange(1, len(part) + 1)
        whole = values[:, :-1] == np.floor(values[:, :-1])
        fits = ((values >= low) & (values <= high)).all(axis=1) & whole.all(axis=1)
        fits &= values[:, 0] < known
        if not fits.all():
            bad = int(np.argmin(fits))
            raise InputError(
                f"{path}:{done + 2 + bad}: must be a parent of a line before, 0 or 1, 32 bytes and "
                "a weight"
            )
        done += len(part)
        if progress is not None:
            progress(done, 0, f"{done} nodes")
        yield (
            values[:, 0].astype(np.int32),
            values[:, 1] > 0,
            values[:, 2:34].astype(np.uint8),
            values[:, 34].copy(),
        )


def _numbers(path: Path, lines: list[bytes], first: int) -> NDArray[np.float64]:
    """Return (n, 35) numbers of some lines."""
    for number, line in enumerate(lines, first):
        cells = len(line.split())
        if cells != CELLS:
            raise InputError(
                f"{path}:{number}: has {cells} numbers, {CELLS} expected: it was cut off, or is "
                "for descriptors of another length than 32 bytes"
            )
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # what is said where it is no number
        try:
            flat = np.fromstring(b"".join(lines).decode("ascii"), sep=" ")
            return flat.reshape(len(lines), CELLS)
        except (DeprecationWarning, ValueError):
            number = next(n for n, line in enumerate(lines, first) if not _is_row(line))
            raise InputError(f"{path}:{number}: {CELLS} numbers expected") from None


def _is_row(line: bytes) -> bool:
    try:
        return all(np.isfinite(float(cell)) for cell in line.split())
    except ValueError:
        return False


def _ordered(
    path: Path,
    parents: NDArray[np.int32],
    leaves: NDArray[np.bool_],
    branching: int,
    depth: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the nodes level by level, siblings side by side, and their numbers of children."""
    above = np.concatenate([[-1], parents]).astype(np.int64)
    counts = np.bincount(parents, minlength=len(above))
    if counts.max() > branching:
        node = int(counts.argmax())
        raise InputError(
            f"{path}: node {node} has {counts.max()} children, its first line says {branching}"
        )
    wrong = np.flatnonzero((counts == 0) != np.concatenate([[False], leaves]))
    if len(wrong):
        said = "no leaf" if counts[wrong[0]] == 0 else "a leaf"
        raise InputError(
            f"{path}:{wrong[0] + 1}: node {wrong[0]} is said to be {said}, but has "
            f"{counts[wrong[0]]} children: the file was cut off or changed"
        )
    # Children sorted by their parent's place in the level above; of one parent in file order.
    by_parent = np.argsort(above[1:], kind="stable") + 1
    start = np.concatenate([[0], np.cumsum(counts)])
    levels = [np.zeros(1, np.int64)]
    while len(levels[-1]):
        if len(levels) - 1 > depth:
            raise InputError(f"{path}: has more than {depth} levels, as its first line says")
        nodes = levels[-1][counts[levels[-1]] > 0]
        spans = [by_parent[start[n] : start[n + 1]] for n in nodes.tolist()]
        levels.append(np.concatenate(spans) if spans else np.empty(0, np.int64))
    order = np.concatenate(levels)
    return order, counts[order]
