"""Pictures: image files or the frames of a video, where neither time nor calibration is known.

A calibration is made from pictures of which nothing is known but that one camera took them. They
may be a folder, a pattern such as 'left/*.png', single files, or a video, of which evenly spaced
frames are looked at: a board held in a hand hardly moves between neighbours. A picture that cannot
be read costs that picture and says why; pictures of two sizes are an error, since no calibration
is for both.

Pictures of a stereo pair belong together by their names: the same one in both folders, or the same
last number in it (left_007.png and right_007.png).
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sources.capture import Cursor, open_file, to_grey, why_not
from odomap.sources.container import inspect
from odomap.sources.images import BadImage, decode, probe_format, read_image
from odomap.sources.listing import SUFFIXES, images_in
from odomap.sources.video import is_video

__all__ = ["Picture", "Pictures", "open_pictures", "pair_pictures"]

MOST = 240
"""So many pictures are looked at."""


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        name: of the file, or "frame 120".
        image: (H, W) uint8 grey; None if it cannot be read.
        reason: why not.
    """

    name: str
    image: NDArray[np.uint8] | None
    reason: str = ""


@dataclass(frozen=True)
class Pictures:
    """What one camera took.

    Attributes:
        where: the folder, pattern or video, for messages.
        files: the image files; for a video the one file.
        frames: which frames of the video; empty for image files.
        notes: what was found odd, for the user.
    """

    where: str
    files: tuple[Path, ...]
    frames: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def is_video(self) -> bool:
        """Whether these are frames of a video."""
        return bool(self.frames)

    def __len__(self) -> int:
        return len(self.frames) if self.is_video else len(self.files)

    def __iter__(self) -> Iterator[Picture]:
        """Yield all pictures, also those that cannot be read.

        Raises:
            InputError: two have different sizes, or the video cannot be decoded.
        """
        return self._frames() if self.is_video else self._images()

    def _images(self) -> Iterator[Picture]:
        form = probe_format(self.files, self.where)
        for path in self.files:
            try:
                yield Picture(path.name, read_image(path, form))
            except BadImage as error:
                yield Picture(path.name, None, self._why(path, str(error), form.resolution))

    def _why(self, path: Path, reason: str, expected: tuple[int, int]) -> str:
        """Return the reason, unless the picture is sound but of another size."""
        try:
            raw = decode(path)
        except BadImage:
            return reason
        size = f"{raw.shape[1]}x{raw.shape[0]}"
        raise InputError(
            f"{path}: is {size}, most pictures are {expected[0]}x{expected[1]}: one calibration is "
            "for one size; keep those of the size you will record with (none turned or cropped)"
        )

    def _frames(self) -> Iterator[Picture]:
        path = self.files[0]
        cursor = Cursor(path, None, is_turned=True)
        at: int | None = -1
        try:
            for frame in self.frames:
                name = f"frame {frame}"
                while at is not None and at < frame:
                    at = cursor.step()
                if at is None:
                    yield Picture(name, None, "the video ends before it")
                    continue
                image = cursor.image() if at == frame else None
                if image is None:
                    yield Picture(name, None, "cannot be decoded")
                else:
                    yield Picture(name, to_grey(image))
        finally:
            cursor.close()


def open_pictures(inputs: Sequence[str | Path]) -> Pictures:
    """Find the pictures one camera took.

    Args:
        inputs: a folder, a pattern with * or ?, a video, or image files.

    Returns:
        Them, at most 240, evenly spaced.

    Raises:
        InputError: there is no such thing, or no picture in it.
    """
    if len(inputs) > 1:
        return _thinned(str(Path(inputs[0]).parent), [Path(path) for path in inputs])
    given = inputs[0]
    path = Path(given)
    if path.is_dir():
        names = images_in(path)
        if not names:
            raise InputError(f"{path}: no pictures in it ({', '.join(SUFFIXES[:3])}, …)")
        return _thinned(str(given), [path / name for name in names])
    if path.is_file():
        return _video(path) if is_video(path) else _thinned(str(path.parent), [path])
    if re.search(r"[*?\[]", str(given)):
        root = Path(path.anchor) if path.anchor else Path()
        pattern = str(path.relative_to(path.anchor)) if path.anchor else str(path)
        found = sorted(p for p in root.glob(pattern) if p.suffix.lower() in SUFFIXES)
        if not found:
            raise InputError(f"{given}: no picture has such a name")
        return _thinned(str(given), found)
    raise InputError(f"{given}: no such folder, video or picture")


def _thinned(where: str, files: Sequence[Path]) -> Pictures:
    """Keep at most MOST files, evenly spaced."""
    notes = []
    if len(files) > MOST:
        keep = np.unique(np.linspace(0, len(files) - 1, MOST).round().astype(int))
        notes.append(f"{where}: {MOST} of {len(files)} pictures are looked at")
        files = [files[k] for k in keep]
    return Pictures(where, tuple(files), (), tuple(notes))


def _video(path: Path) -> Pictures:
    """Choose the frames of a video to look at."""
    container = inspect(path)
    capture = open_file(path)
    try:
        if not capture.isOpened() or not capture.grab():
            raise why_not(path)
        announced = int(max(0.0, capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        count = 1
        while capture.grab():
            count += 1
    finally:
        capture.release()
    notes = []
    if container.is_cut or count < 0.98 * announced:
        of = f" of {announced}" if announced > count else ""
        notes.append(f"{path}: the file is cut: it ends after {count}{of} frames")
    frames = np.unique(np.linspace(0, count - 1, min(count, MOST)).round().astype(int))
    if len(frames) < count:
        notes.append(f"{path}: {len(frames)} of {count} frames are looked at")
    return Pictures(str(path), (path,), tuple(frames.tolist()), tuple(notes))


def pair_pictures(left: Pictures, right: Pictures) -> None:
    """Make sure that the k-th pictures of two cameras belong together.

    Raises:
        InputError: their numbers or names do not fit each other.
    """
    if left.is_video != right.is_video:
        raise InputError(f"{left.where}, {right.where}: one is a video, the other is not")
    if len(left) != len(right) or left.frames != right.frames:
        kind = "frames" if left.is_video else "pictures"
        counts = f"{_total(left)} and {_total(right)} {kind}"
        raise InputError(
            f"{left.where}, {right.where}: {counts} do not pair: give the same number, taken at "
            f"the same times{_lonely(left, right)}"
        )
    if left.is_video:
        return
    names = [[path.stem for path in side.files] for side in (left, right)]
    if names[0] == names[1]:
        return
    numbers = [[_number(name) for name in side] for side in names]
    if numbers[0] != numbers[1] or None in numbers[0]:
        odd = next(
            k for k in range(len(left)) if numbers[0][k] != numbers[1][k] or not numbers[0][k]
        )
        raise InputError(
            f"{left.where}, {right.where}: '{left.files[odd].name}' and "
            f"'{right.files[odd].name}' do not pair: give the two pictures of a pair the same "
            "name or number"
        )


def _total(pictures: Pictures) -> int:
    return pictures.frames[-1] + 1 if pictures.is_video else len(pictures)


def _number(stem: str) -> str | None:
    found = re.findall(r"\d+", stem)
    return found[-1].lstrip("0") or "0" if found else None


def _lonely(left: Pictures, right: Pictures) -> str:
    """Return a hint at the first picture without a partner, where names tell."""
    keys = [{_number(p.stem) or p.stem: p for p in side.files} for side in (left, right)]
    for mine, theirs, where in ((0, 1, right.where), (1, 0, left.where)):
        alone = [path for key, path in keys[mine].items() if key not in keys[theirs]]
        if alone and not left.is_video and not right.is_video:
            return f" ('{alone[0].name}' has no partner in {where})"
    return ""
