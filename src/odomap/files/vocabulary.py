"""Vocabulary files: the words of a vocabulary in one file, read back exactly.

    vocabulary.save("words.odomap-vocabulary")      Vocabulary.load("words.odomap-vocabulary")

A file is a zip of .npy arrays and a manifest in JSON, as map files are:

    manifest.json             {"odomap_vocabulary": 1, "odomap": "0.6", "branching": 10, "depth": 5,
                               "descriptor_bits": 256, "num_images": 1621, "arrays": {...}}
    nodes/centres.npy         u1 (M, 32)  of all nodes, level by level; the root's is 0
    nodes/num_children.npy    u1 (M,)     whose children follow each other
    words/weights.npy         f4 (W,)     of the leaves, ln(images / images with the word)

It is not trusted: sizes are bounded before anything is read (`zipreader`), types, shapes and
checksums compared, and then the tree must be one.

Without a name, `load` reads the vocabulary that comes with odomap: 98,730 words, those of 459,001
trained on 1,621 public images, cut to five levels. OpenCV's ORB, whose bits are the same, may use
them as well.

Reference: Gálvez-López, Tardós, "Bags of binary words for fast place recognition in image
sequences", T-RO 28(5), 2012.
"""

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, Self

import numpy as np

from odomap.errors import InputError
from odomap.files.atomic import atomic_binary
from odomap.files.dbow2 import read_dbow2_nodes
from odomap.files.ziplayout import MANIFEST
from odomap.files.zipreader import ZipReader
from odomap.files.zipwriter import ZipWriter
from odomap.version import __version__
from odomap.vision.vocabulary import MOST_BRANCHING, MOST_DEPTH, MOST_NODES, VocabularyTree

__all__ = ["SUFFIX", "VERSION", "Vocabulary", "default_vocabulary_path"]

VERSION = 1
SUFFIX = ".odomap-vocabulary"
BITS = 256
LIMIT_MB = 256.0
"""More than the largest tree takes."""
LONGEST = 1 << 31


def default_vocabulary_path() -> Path:
    """Return where the vocabulary that comes with odomap lies."""
    return Path(str(resources.files("odomap.files") / f"orb{SUFFIX}"))


class Vocabulary(VocabularyTree):
    """A vocabulary tree that is kept in a file.

    Example:
        >>> vocabulary = Vocabulary.load()
        >>> bow = vocabulary.transform(np.zeros((3, 32), np.uint8))
        >>> bow.weights
        array([1.])
    """

    def save(self, path: str | Path) -> None:
        """Save the vocabulary; a file of that name stays as it was until the new one is whole.

        Weights are kept in single precision.

        Args:
            path: the file, by custom ending in `.odomap-vocabulary`.

        Raises:
            OutputError: the operating system refuses.
        """
        with atomic_binary(path) as binary:
            writer = ZipWriter(binary)
            writer.add("nodes/centres", self.centres)
            writer.add("nodes/num_children", self.num_children.astype(np.uint8))
            writer.add("words/weights", self.weights.astype(np.float32))
            writer.close(
                {
                    "odomap_vocabulary": VERSION,
                    "odomap": __version__,
                    "branching": self.branching,
                    "depth": self.depth,
                    "descriptor_bits": BITS,
                    "num_images": self.num_images,
                    "arrays": writer.arrays,
                }
            )

    @classmethod
    def load(cls, path: str | Path | None = None) -> Self:
        """Load a vocabulary.

        Args:
            path: the file; by default that which comes with odomap.

        Raises:
            InputError: it cannot be read, is broken, of a newer version, for other descriptors, or
                cannot be true.
        """
        file = default_vocabulary_path() if path is None else Path(path)
        with _VocabularyZip(file, LIMIT_MB) as archive:
            numbers = _numbers(archive)
            kinds = {"nodes/centres": "|u1", "nodes/num_children": "|u1", "words/weights": "<f4"}
            for name in sorted({*archive.members} - {f"{name}.npy" for name in kinds}):
                raise archive.error(f"{name[:80]!r}: is no part of a vocabulary")
            entries = {name: _declared(archive, name, kind) for name, kind in kinds.items()}
            (nodes, _), (words,) = (entries[n][0] for n in ("nodes/centres", "words/weights"))
            if entries["nodes/centres"][0][1] != BITS // 8 or nodes > MOST_NODES or words > nodes:
                raise archive.error(f"{MANIFEST}: {nodes} nodes and {words} words cannot be")
            arrays = {
                name: archive.array(name, kinds[name], shape, crc)
                for name, (shape, crc) in entries.items()
            }
            try:
                return cls(
                    arrays["nodes/centres"],
                    arrays["nodes/num_children"].astype(np.int64),
                    arrays["words/weights"].astype(np.float64),
                    numbers["branching"],
                    numbers["depth"],
                    numbers["num_images"],
                )
            except InputError as error:
                raise archive.error(str(error).removeprefix("vocabulary: ")) from None

    @classmethod
    def read_dbow2(
        cls, path: str | Path, progress: Callable[[int, int, str], None] | None = None
    ) -> Self:
        """Read a vocabulary in DBoW2's text format, as ORB-SLAM's is; packed (.gz, .xz) or not.

        Words are numbered anew.

        Args:
            path: the file.
            progress: called with nodes read, 0 (how many there are is not known) and a text.

        Raises:
            InputError: it cannot be read, is broken, or for other descriptors; names the line.
        """
        nodes = read_dbow2_nodes(path, progress)
        try:
            return cls(
                nodes.centres, nodes.num_children, nodes.weights, nodes.branching, nodes.depth
            )
        except InputError as error:
            raise InputError(f"{path}: {str(error).removeprefix('vocabulary: ')}") from None


class _VocabularyZip(ZipReader):
    """A zip whose complaints speak of a vocabulary."""

    def error(self, problem: str) -> InputError:
        return super().error(problem.replace("map file", "vocabulary file"))


def _numbers(archive: ZipReader) -> dict[str, int]:
    """Return the whole numbers of the manifest, after looking at version and descriptors."""
    content = archive.manifest
    version = content.get("odomap_vocabulary")
    if type(version) is not int or version < 1:
        raise archive.error(f"is no vocabulary file: {MANIFEST} has no version 'odomap_vocabulary'")
    if version > VERSION:
        raise archive.error(
            f"is of version {version}, this odomap reads {VERSION}: it was written by a newer "
            "odomap, update this one"
        )
    most = {"branching": MOST_BRANCHING, "depth": MOST_DEPTH, "num_images": LONGEST}
    numbers = {}
    for name, limit in most.items():
        value: Any = content.get(name)
        if type(value) is not int or not 0 <= value <= limit:
            raise archive.error(f"{MANIFEST}: {name} must be a whole number up to {limit}")
        numbers[name] = value
    bits = content.get("descriptor_bits")
    if bits != BITS:
        raise archive.error(
            f"is for descriptors of {str(bits)[:20]} bits, those of odomap have {BITS}: train one "
            "on their images with 'odomap vocabulary train'"
        )
    return numbers


def _declared(archive: ZipReader, name: str, kind: str) -> tuple[tuple[int, ...], int]:
    """Return shape and checksum that the manifest declares, after comparing the size."""
    arrays = archive.manifest.get("arrays")
    entry = arrays.get(name) if isinstance(arrays, dict) else None
    if not isinstance(entry, dict):
        raise archive.error(f"{MANIFEST}: {name} is not declared")
    shape, crc = entry.get("shape"), entry.get("crc32")
    ranks = 2 if name == "nodes/centres" else 1
    if not isinstance(shape, list) or len(shape) != ranks or type(crc) is not int:
        raise archive.error(f"{MANIFEST}: {name} must have {ranks} lengths and a crc32")
    if any(type(n) is not int or not 0 <= n < LONGEST for n in shape):
        raise archive.error(f"{MANIFEST}: {name} has a shape that cannot be")
    if entry.get("dtype") != kind:
        raise archive.error(
            f"{MANIFEST}: {name} must be of type {kind}, not {str(entry.get('dtype'))[:40]!r}"
        )
    archive.check_array(name, kind, shape)
    return tuple(shape), crc
