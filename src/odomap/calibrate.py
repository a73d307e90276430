"""One call from pictures of a chessboard to a rig: pictures → boards → lenses → rig.yaml, a plot.

    result = odomap.calibrate("pictures/", board="9x6", square=0.025, out="rig.yaml")
    result.calibration.cameras[0], result.calibration.rms_px, result.warnings

Two sets of pictures make a stereo pair. The place for the results is tested before the search. What
the pictures do not determine is an error where the numbers would mean nothing, and nothing is
written; otherwise it is a warning that says which pictures to add.
"""

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError, OutputError

if TYPE_CHECKING:
    from odomap.backend.calibration import Calibration
    from odomap.sensors.rig import Rig
    from odomap.sources.pictures import Pictures
    from odomap.vision.board import Board

__all__ = ["CalibrationResult", "calibrate"]

Array = NDArray[np.float64]
Inputs = str | Path | Sequence[str | Path]
Tell = Callable[[int, int, str], None]

MOST_FRAMES = 60
"""So many views of a video are used at most."""
LOOK = 8
"""Pictures in which to look for a board of another size."""
ROLES = ("left", "right")
LEAST = 20
"""Corners that a board of another size must have to be suggested."""


@dataclass(frozen=True)
class CalibrationResult:
    """What a calibration found.

    Attributes:
        rig: the camera, or left and right; the first one is the body.
        calibration: numbers, covariance, residuals.
        board: the board.
        names: of the picture of each view, per camera.
        counts: per camera: pictures, of which could be read, of which show the board.
        warnings: what a person should know, one sentence each.
        written: rig.yaml and the picture, if asked for.
    """

    rig: "Rig"
    calibration: "Calibration"
    board: "Board"
    names: tuple[tuple[str, ...], ...]
    counts: tuple[tuple[int, int, int], ...]
    warnings: tuple[str, ...]
    written: tuple[Path, ...]


@dataclass
class _Search:
    """What was found in the pictures of one camera."""

    where: str
    names: list[str] = field(default_factory=list)
    corners: list[Array | None] = field(default_factory=list)
    sharp: list[float] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)
    resolution: tuple[int, int] = (0, 0)

    @property
    def found(self) -> int:
        return sum(corners is not None for corners in self.corners)


def calibrate(
    images: Inputs,
    right: Inputs | None = None,
    *,
    board: "str | Board" = "9x6",
    square: float = 0.025,
    model: str = "pinhole",
    k3: bool = False,
    out: str | Path | None = None,
    progress: Tell | None = None,
) -> CalibrationResult:
    """Calibrate a camera, or a stereo pair, from pictures of a chessboard.

    Args:
        images: a folder, a pattern, a video or image files; of the left camera for a pair.
        right: the same for the right camera.
        board: INNER corners along and across, "9x6" for 10 x 7 squares.
        square: side of a square, metres.
        model: of the lens: pinhole, kannala_brandt or double_sphere.
        k3: whether a pinhole has a third radial coefficient.
        out: where to write rig.yaml (a file, or a folder); calibration.png goes beside it.
        progress: called with (done, total, text) as pictures are searched.

    Returns:
        The rig, the numbers behind it, and warnings.

    Raises:
        InputError: pictures cannot be used, or the board is not seen in enough of them.
        CalibrationError: the pictures do not determine the camera.
        OutputError: the results cannot be written.

    Example:
        >>> result = calibrate("pictures/", board="9x6", square=0.025)  # doctest: +SKIP
        >>> result.rig.cameras[0].camera.fx  # doctest: +SKIP
        520.3
    """
    from odomap.backend.calibration_doubts import doubts
    from odomap.sources.pictures import open_pictures, pair_pictures
    from odomap.vision.board import Board

    target = board if isinstance(board, Board) else Board.parse(board, square)
    _check_model(model, k3)
    file = _target_file(out) if out is not None else None
    sets = [open_pictures(_listed(given)) for given in (images, right) if given is not None]
    if len(sets) == 2:
        pair_pictures(*sets)
    tell = progress or (lambda *_: None)
    searches = _searched(sets, target, tell)
    for search in searches:
        _check_seen(search, target)
    pixels, views = _views(searches, sets[0].is_video, len(target.points))
    tell(1, 1, "solving")
    calibration = _solved(target, pixels, searches, model, 5 if k3 else 4)
    open_questions = doubts(calibration)
    fatal = [doubt.text for doubt in open_questions if doubt.is_fatal]
    where = ", ".join(search.where for search in searches)
    if fatal:
        raise CalibrationError(f"{where}: {fatal[0]}")
    rig = _rig(calibration, where)
    warnings = [note for pictures in sets for note in pictures.notes]
    warnings += [text for search in searches for text in _notes(search)]
    warnings += _dropped(calibration, searches, views)
    warnings += [doubt.text for doubt in open_questions]
    names = tuple(tuple(search.names[v] for v in views) for search in searches)
    counts = tuple((len(s.names), len(s.names) - len(s.unreadable), s.found) for s in searches)
    written = _write(file, rig, calibration, names) if file is not None else ()
    return CalibrationResult(rig, calibration, target, names, counts, tuple(warnings), written)


def _check_model(model: str, k3: bool) -> None:
    """Raise unless there is such a lens, before pictures are searched for it."""
    from odomap.errors import nearest_name
    from odomap.geometry.camera import MODELS

    if model not in MODELS:
        hint = nearest_name(model, MODELS)
        raise CalibrationError(f"model: '{model}' is unknown{hint}; known are {', '.join(MODELS)}")
    if k3 and model != "pinhole":
        raise InputError(f"k3 is a coefficient of the pinhole, not of {model}")


def _listed(given: Inputs) -> Sequence[str | Path]:
    return [given] if isinstance(given, str | Path) else given


def _target_file(out: str | Path) -> Path:
    """Return where rig.yaml goes, after making sure that it can, and that nothing is lost."""
    from odomap.files.atomic import make_folder
    from odomap.files.rig import read_rig

    file = Path(out)
    if file.is_dir() or file.suffix.lower() not in (".yaml", ".yml"):
        file = file / "rig.yaml"
    make_folder(file.parent)
    if file.exists():
        try:
            rig = read_rig(file)
        except InputError as error:
            raise OutputError(
                f"{file}: is there and is no rig.yaml: choose another file with --out"
            ) from error
        if rig.imu is not None or rig.lidars or rig.depth is not None:
            raise OutputError(
                f"{file}: is there and describes more than cameras: choose another file with --out"
            )
    return file


def _searched(sets: "Sequence[Pictures]", board: "Board", tell: Tell) -> list[_Search]:
    """Look for the board in all pictures."""
    from odomap.vision.board import find_board, guess_size, sharpness

    searches = []
    total, done = sum(map(len, sets)), 0
    for pictures in sets:
        search = _Search(pictures.where)
        spare = {round(k) for k in np.linspace(0, len(pictures) - 1, LOOK)}
        for index, picture in enumerate(pictures):
            tell(done, total, f"{picture.name}  {search.found} boards")
            done += 1
            search.names.append(picture.name)
            corners, sharp = None, 0.0
            if picture.image is None:
                search.unreadable.append(f"{picture.name}: {picture.reason}")
            else:
                search.resolution = picture.image.shape[1], picture.image.shape[0]
                corners = find_board(picture.image, board)
                size = guess_size(picture.image) if corners is None and index in spare else None
                if size is not None:
                    search.sizes.append(size)
                sharp = 0.0 if corners is None else sharpness(picture.image, corners)
            search.corners.append(corners)
            search.sharp.append(sharp)
        searches.append(search)
    return searches


def _check_seen(search: _Search, board: "Board") -> None:
    """Raise unless enough pictures show the board; say what they show instead."""
    from odomap.backend.calibration import MIN_VIEWS

    readable = len(search.names) - len(search.unreadable)
    if readable == 0:
        raise InputError(f"{search.where}: no picture can be read ({search.unreadable[0]})")
    if search.found >= MIN_VIEWS:
        return
    seen = "in none" if search.found == 0 else f"in only {search.found}"
    mend = f"is it whole, with a white margin, and are there {board} INNER corners?"
    mine = max(board.columns, board.rows), min(board.columns, board.rows)
    others = Counter(size for size in search.sizes if size != mine)
    (columns, rows), times = max(
        others.items(), key=lambda item: (item[1], item[0]), default=((0, 0), 0)
    )
    # Bricks and shelves look like small boards, and in each picture like another one.
    if columns * rows >= LEAST and 2 * times >= min(LOOK, readable):
        mend = (
            f"looks like a {columns}x{rows} board: give --board {columns}x{rows} (inner corners, "
            "one less than squares along each side)"
        )
    elif search.found:
        mend = f"{MIN_VIEWS} are the least, 15 to 30 are good; {mend}"
    raise InputError(
        f"{search.where}: a {board} board is seen {seen} of {readable} pictures: {mend}"
    )


def _views(
    searches: Sequence[_Search], is_video: bool, count: int
) -> tuple[Array, NDArray[np.int64]]:
    """Return the corners (C, V, N, 2) of the views to use, NaN where not seen, and their places."""
    from odomap.vision.board import choose_views

    blank = np.full((count, 2), np.nan)
    pixels = np.array([[blank if c is None else c for c in s.corners] for s in searches])
    seen = np.isfinite(pixels[:, :, 0, 0])
    views = np.flatnonzero(seen.any(axis=0))
    if is_video:
        sharp = np.array([search.sharp for search in searches])
        chosen: list[int] = []
        # Views that all cameras have come first: they alone tell where the cameras are.
        for group in (seen.all(axis=0), *(row & ~seen.all(axis=0) for row in seen)):
            rows, some = np.flatnonzero(group), MOST_FRAMES - len(chosen)
            if len(rows) and some > 0:
                where = np.nan_to_num(pixels[:, rows]).transpose(1, 0, 2, 3).reshape(len(rows), -1)
                worst = np.where(seen[:, rows], sharp[:, rows], np.inf).min(axis=0)
                chosen += rows[choose_views(where, worst, some)].tolist()
        views = np.array(sorted(chosen), dtype=np.int64)
    return pixels[:, views], views


def _solved(
    board: "Board", pixels: Array, searches: Sequence[_Search], model: str, coefficients: int
) -> "Calibration":
    from odomap.backend.calibration import calibrate_camera, calibrate_pair

    where = ", ".join(search.where for search in searches)
    sizes = [search.resolution for search in searches]
    try:
        if len(searches) == 1:
            return calibrate_camera(board.points, pixels[0], sizes[0], model, coefficients)
        if sizes[0] != sizes[1]:
            texts = ["{}x{}".format(*size) for size in sizes]
            raise InputError(f"pictures are {texts[0]} and {texts[1]}: a pair needs one size")
        left, right = pixels
        symmetric = board.is_symmetric
        return calibrate_pair(
            board.points, left, right, sizes, model, coefficients, symmetric=symmetric
        )
    except InputError as error:
        raise type(error)(f"{where}: {error}") from error


def _rig(calibration: "Calibration", where: str) -> "Rig":
    """Return the rig, refused where no rig can be like that (a swapped pair, for one)."""
    from odomap.geometry.pose import SE3
    from odomap.sensors.rig import CameraMount, Rig

    mounts = (SE3.identity(), calibration.T_left_right or SE3.identity())
    names = ROLES if len(calibration.cameras) > 1 else ("camera",)
    try:
        rig = Rig(
            tuple(
                CameraMount(name, camera, mount)
                for name, camera, mount in zip(names, calibration.cameras, mounts)
            )
        )
        if len(rig.cameras) > 1:
            rig.stereo_pair()
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error
    return rig


def _notes(search: _Search) -> list[str]:
    """Say what was wrong with the pictures of one camera."""
    notes = []
    if search.unreadable:
        more = len(search.unreadable) - 1
        also = f" (and {more} more)" if more else ""
        notes.append(f"{search.where}: skipped {search.unreadable[0]}{also}")
    readable = len(search.names) - len(search.unreadable)
    if search.found < 0.5 * readable:
        notes.append(f"{search.where}: the board is found in {search.found} of {readable} pictures")
    return notes


def _dropped(
    calibration: "Calibration", searches: Sequence[_Search], views: NDArray[np.int64]
) -> list[str]:
    """Say which views contradict the others."""
    notes = []
    for c, search in enumerate(searches):
        seen = np.array([search.corners[v] is not None for v in views])
        bad = np.flatnonzero(seen & ~calibration.used[c])
        if len(bad):
            names = ", ".join(search.names[views[k]] for k in bad[:3])
            more = ", …" if len(bad) > 3 else ""
            notes.append(
                f"{search.where}: {len(bad)} left out that contradict the others ({names}{more}): "
                "moved while taken, or the board bent?"
            )
    return notes


def _write(
    file: Path, rig: "Rig", calibration: "Calibration", names: tuple[tuple[str, ...], ...]
) -> tuple[Path, ...]:
    from odomap.files.atomic import write_bytes
    from odomap.files.rig import write_rig
    from odomap.views.calibration import calibration_figure
    from odomap.views.style import figure_png

    write_rig(file, rig)
    stem = "calibration" if file.stem == "rig" else f"{file.stem}.calibration"
    picture = file.with_name(f"{stem}.png")
    write_bytes(picture, figure_png(calibration_figure(calibration, names), dpi=110))
    return file, picture


class _CallableModule(ModuleType):
    """Let `odomap.calibrate` be called, whether it is the function or, once imported, this file."""

    def __call__(self, *args: Any, **kwargs: Any) -> CalibrationResult:
        return calibrate(*args, **kwargs)


sys.modules[__name__].__class__ = _CallableModule
