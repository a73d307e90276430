"""Gathering: images of any cameras, sizes and origins, where neither order nor calibration matters.

A vocabulary is trained on as many different images as there are: folders, patterns, image files,
recordings, videos and simulated worlds, together. Every image file is read for itself, since
nothing says that one camera took them; of a recording the frames of its first camera are taken. If
there are more than wanted, they are evenly spaced. One that cannot be read costs itself alone, and
says why.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from odomap.errors import InputError
from odomap.sources.images import BadImage, probe_format, read_image
from odomap.sources.listing import SUFFIXES, images_in
from odomap.sources.open import open as open_source
from odomap.sources.pictures import Picture
from odomap.sources.source import Source

__all__ = ["Gathering"]


class Gathering:
    """Images from everywhere; iterate it for them.

    Args:
        inputs: folders of images, patterns with * or ?, image files, and what `odomap.open` opens.
        most: images, evenly spaced.

    Raises:
        InputError: there is no such thing, or no image in any.
    """

    def __init__(self, inputs: Sequence[str | Path], most: int) -> None:
        if not inputs:
            raise InputError("IMAGES is missing: give folders, patterns, pictures or recordings")
        parts = [_found(given) for given in inputs]
        total = sum(len(part) for part in parts)
        if total == 0:
            raise InputError(f"{', '.join(map(str, inputs))}: no images in it")
        chosen = np.unique(np.linspace(0, total - 1, min(most, total)).round().astype(int))
        ends = np.cumsum([len(part) for part in parts])
        self._parts: list[tuple[list[Path] | Source, set[int]]] = []
        for part, end in zip(parts, ends.tolist()):
            own = chosen[(chosen >= end - len(part)) & (chosen < end)] - (end - len(part))
            self._parts.append((part, set(own.tolist())))
        self.total = total
        """Images there are, those left out included."""

    def __len__(self) -> int:
        return sum(len(chosen) for _, chosen in self._parts)

    def __iter__(self) -> Iterator[Picture]:
        """Yield all images, also those that cannot be read."""
        for part, chosen in self._parts:
            if isinstance(part, list):
                yield from (_picture(part[index]) for index in sorted(chosen))
            else:
                yield from _frames(part, chosen)


def _found(given: str | Path) -> list[Path] | Source:
    """Return the image files that a name stands for, or a recording."""
    path, name = Path(given), str(given)
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return [path]
    if path.is_dir() and (names := images_in(path)):
        return [path / image for image in names]
    if re.search(r"[*?\[]", name) and not path.exists() and not name.startswith("sim:"):
        root = Path(path.anchor) if path.anchor else Path()
        pattern = str(path.relative_to(path.anchor)) if path.anchor else name
        found = sorted(p for p in root.glob(pattern) if p.suffix.lower() in SUFFIXES)
        if not found:
            raise InputError(f"{name}: no picture has such a name")
        return found
    source = open_source(given)
    if not len(source):
        raise InputError(f"{name}: has no end: give a recording")
    return source


def _picture(path: Path) -> Picture:
    try:
        return Picture(str(path), read_image(path, probe_format([path], str(path))))
    except (BadImage, InputError) as error:
        return Picture(str(path), None, str(error).removeprefix(f"{path}: "))


def _frames(source: Source, chosen: set[int]) -> Iterator[Picture]:
    """Yield the first image of the chosen frames; of what a source skips it says why."""
    for index, frame in enumerate(source):
        if index in chosen:
            yield Picture(f"{source.name} frame {frame.id}", frame.images[0])
    for item in source.skipped:
        yield Picture(item.file, None, item.reason)
