"""Bundle adjustment problems as text, as "Bundle adjustment in the large" has them (BAL).

    cameras points observations
    camera point u v                        per observation, pixels from the centre, v upwards
    r₁ r₂ r₃ t₁ t₂ t₃ f k₁ k₂               per camera, one number per line
    x y z                                   per point, likewise

A camera is T_camera_world, r its rotation vector, and looks along -z (see `Adjustment`). Rotation
vectors are laid on a grid of 14 decimals when read, on which what is off by rounding falls back:
what was read is written and read again bit for bit. Counts are checked against the file before
anything is made. Plain or gzip, O(size of the file).

Reference: S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle adjustment in the large",
ECCV 2010.
"""

import gzip
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.problem import BAL, Adjustment
from odomap.errors import InputError
from odomap.files.atomic import write_bytes
from odomap.files.text import read_text
from odomap.geometry.lie import so3_exp, so3_log

__all__ = ["read_bal", "write_bal"]

Array = NDArray[np.float64]

DECIMALS = 14
CAMERA, POINT, OBSERVATION = 9, 3, 4
"""Numbers of each."""


def read_bal(path: str | Path) -> Adjustment:
    """Read a bundle adjustment problem.

    Args:
        path: the file, plain or gzip.

    Returns:
        One lens "bal" per view, its numbers held fixed, and weights of 1.

    Raises:
        InputError: names the file, and the line of what is wrong.

    Example:
        >>> problem = read_bal("problem-49-7776-pre.txt.gz")  # doctest: +SKIP
        >>> problem.num_views, problem.num_points, problem.num_observations  # doctest: +SKIP
        (49, 7776, 31843)
    """
    file = Path(path)
    text = read_text(file)
    cameras, points, observations = _counts(file, text)
    words = text.split()[3:]
    want = OBSERVATION * observations + CAMERA * cameras + POINT * points
    if len(words) != want:
        what = "is it cut off?" if len(words) < want else "do they belong to another problem?"
        raise InputError(
            f"{file}: {len(words)} numbers follow the first line, which promises {want}: {what}"
        )
    try:
        numbers = np.fromiter(map(float, words), np.float64, want)
    except ValueError:
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all() or "_" in text:
        _check_words(file, text)
    seen = numbers[: OBSERVATION * observations].reshape(-1, OBSERVATION)
    view = _indices(file, text, seen[:, 0], cameras, "camera")
    point = _indices(file, text, seen[:, 1], points, "point")
    rest = numbers[seen.size :]
    rows = rest[: CAMERA * cameras].reshape(-1, CAMERA)
    Ts = np.tile(np.eye(4), (cameras, 1, 1))
    Ts[:, :3, :3] = so3_exp(_on_grid(so3_exp(rows[:, :3])))
    Ts[:, :3, 3] = rows[:, 3:6]
    places = rest[rows.size :].reshape(-1, POINT)
    try:
        return Adjustment(
            Ts, places, view, point, seen[:, 2:], rows[:, 6:], BAL, np.arange(cameras)
        )
    except InputError as error:
        raise InputError(f"{file}: {str(error).removeprefix('adjustment: ')}") from error


def write_bal(path: str | Path, problem: Adjustment) -> None:
    """Write a bundle adjustment problem; the same problem gives the same bytes.

    Args:
        path: the file; gzipped if it ends in `.gz`.
        problem: lenses "bal" and weights of 1: the format knows no others.

    Raises:
        InputError: other lenses or weights.
        OutputError: it cannot be written.
    """
    file = Path(path)
    if set(problem.models) != {BAL}:
        raise InputError(f"{file}: BAL files hold lenses of model '{BAL}', f k1 k2, only")
    if not (problem.weights == 1.0).all():
        raise InputError(f"{file}: BAL files hold no weights: make them 1")
    counts = f"{problem.num_views} {problem.num_points} {problem.num_observations}"
    seen = zip(problem.view.tolist(), problem.point.tolist(), problem.pixels.tolist())
    Ts = problem.Ts_camera_world
    lenses = problem.intrinsics[problem.lens, :3]
    cameras = np.column_stack([_on_grid(Ts[:, :3, :3]), Ts[:, :3, 3], lenses])
    lines = [
        counts,
        *(f"{k} {m} {u!r} {v!r}" for k, m, (u, v) in seen),
        *map(repr, cameras.ravel().tolist()),
        *map(repr, problem.points_world.ravel().tolist()),
    ]
    data = "\n".join([*lines, ""]).encode("ascii")
    write_bytes(file, gzip.compress(data, mtime=0) if file.suffix == ".gz" else data)


def _on_grid(R: Array) -> Array:
    """Return rotation vectors, of length 0 to π, on the grid."""
    return np.asarray(np.round(so3_log(R), DECIMALS) + 0.0)


def _counts(file: Path, text: str) -> tuple[int, int, int]:
    """Read the first line."""
    words = text[: text.find("\n") if "\n" in text else None].split()
    if not text.strip():
        raise InputError(f"{file}: is empty")
    if "\0" in text or len(words) != 3 or not all(w.isascii() and w.isdigit() for w in words):
        raise InputError(
            f"{file}:1: three whole numbers expected, those of cameras, points and observations: "
            "is this a BAL problem?"
        )
    cameras, points, observations = map(int, words)
    if not cameras * points * observations:
        raise InputError(f"{file}:1: no cameras, points or observations: nothing to do")
    return cameras, points, observations


def _check_words(file: Path, text: str) -> None:
    """Raise at the first word that is not a finite number."""
    for number, line in enumerate(text.split("\n"), 1):
        for word in line.split():
            try:
                if "_" in word:
                    raise ValueError
                finite = np.isfinite(float(word))
            except ValueError:
                raise InputError(f"{file}:{number}: '{word[:40]}' is not a number") from None
            if not finite:
                raise InputError(f"{file}:{number}: '{word}' is not finite")


def _indices(file: Path, text: str, values: Array, count: int, what: str) -> NDArray[np.int64]:
    """Return a column of indices, each below `count`."""
    wrong = (values < 0) | (values >= count) | (values != np.floor(values))
    if wrong.any():
        row = int(np.argmax(wrong))
        line = _line_of(text, 3 + OBSERVATION * row)
        raise InputError(
            f"{file}:{line}: {what} {values[row]:g} is not there: the {count} are numbered from 0"
        )
    return values.astype(np.int64)


def _line_of(text: str, word: int) -> int:
    """Return the line in which the word of that number, from 0, stands."""
    for number, line in enumerate(text.split("\n"), 1):
        word -= len(line.split())
        if word < 0:
            return number
    return 0
