"""`odomap calibrate`: from pictures of a chessboard to rig.yaml."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from odomap.cli.progress import Steps

if TYPE_CHECKING:
    from odomap.calibrate import CalibrationResult

__all__ = ["Calibrate"]


@dataclass(frozen=True)
class Calibrate:
    """Calibrate a camera or a stereo pair from chessboard pictures; write rig.yaml.

    Two folders (or patterns, or videos) are the left and the right camera of a pair. Writes
    rig.yaml and, beside it, calibration.png, which shows how well it fits and what it stands on.
    """

    images: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="IMAGES")]
    """A folder, a pattern such as 'left/*.png', a video, picture files; two for a pair."""
    board: Annotated[str, tyro.conf.arg(metavar="WxH")]
    """INNER corners along and across: 9x6 for a board of 10 x 7 squares."""
    square: Annotated[float, tyro.conf.arg(metavar="M")]
    """Side of a square in metres."""
    model: Literal["pinhole", "kannala_brandt", "double_sphere"] = "pinhole"
    """The lens: pinhole up to about 100°, the others for fisheyes."""
    k3: bool = False
    """Give a pinhole a third radial coefficient: for wide lenses, with many pictures."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("rig.yaml")
    """Where to write the rig; calibration.png goes beside it."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Calibrate, write, and say how sure the numbers are."""
        from odomap.calibrate import calibrate

        left, right = cameras(self.images)
        with Steps("searching boards", self.quiet) as steps:
            result = calibrate(
                left,
                right,
                board=self.board,
                square=self.square,
                model=self.model,
                k3=self.k3,
                out=self.out,
                progress=steps.show,
            )
        for warning in result.warnings:
            print(f"odomap: warning: {warning}", file=sys.stderr)
        for name, value in rows(result):
            print(f"{name:<16} {value}")
        return 0


def cameras(images: tuple[str, ...]) -> tuple[list[str], list[str] | None]:
    """Say which arguments are one camera's pictures and which the other's.

    A shell turns left/*.png into many names: single pictures are those of one camera.

    Raises:
        InputError: there is none, or more than two cameras.
    """
    from odomap.errors import InputError
    from odomap.sources.listing import SUFFIXES

    if not images:
        raise InputError("IMAGES is missing: give a folder, a pattern, a video or pictures")
    single = [Path(name).suffix.lower() in SUFFIXES and "*" not in name for name in images]
    if all(single) and len({Path(name).parent for name in images}) == 1:
        return list(images), None
    if all(single):
        raise InputError(
            "pictures of several folders: give the folders, as in 'odomap calibrate left/ right/'"
        )
    if len(images) > 2 or any(single):
        raise InputError(
            f"{len(images)} sets of pictures: give one for a camera, two for a stereo pair"
        )
    return [images[0]], [images[1]] if len(images) == 2 else None


def rows(result: "CalibrationResult") -> list[tuple[str, str]]:
    """Return the lines of the conclusion, name and value."""
    import numpy as np

    from odomap.geometry.camera import MODELS

    calibration = result.calibration
    lines = []
    for c, mount in enumerate(result.rig.cameras):
        camera, sigma = mount.camera, calibration.sigmas(c)
        pictures, _, found = result.counts[c]
        used = int(calibration.used[c].sum())
        size = f"{camera.width}x{camera.height}"
        lines += [
            (mount.name, f"{camera.model}, {size}"),
            (
                "  focal length",
                f"fx {camera.fx:.2f} ± {sigma[0]:.2f}  fy {camera.fy:.2f} ± {sigma[1]:.2f} px",
            ),
            (
                "  centre",
                f"cx {camera.cx:.2f} ± {sigma[2]:.2f}  cy {camera.cy:.2f} ± {sigma[3]:.2f} px",
            ),
        ]
        names = MODELS[camera.model].names.replace("[", "").replace("]", "").split()
        numbers = zip(names, camera.distortion, sigma[4:])
        text = "  ".join(f"{name} {value:.5f} ± {s:.5f}" for name, value, s in numbers)
        lines += [
            ("  distortion", text),
            ("  reprojection", f"{calibration.rms_px[c]:.3f} px RMS"),
            ("  views", f"{used} used, {found} with the {result.board} board, {pictures} pictures"),
        ]
    if calibration.T_left_right is not None:
        baseline = float(np.linalg.norm(calibration.T_left_right.t))
        lines.append(("baseline", f"{baseline:.5f} ± {calibration.baseline_sigma:.5f} m"))
    names_of = ("rig", "picture")
    return lines + [(name, str(path)) for name, path in zip(names_of, result.written)]
