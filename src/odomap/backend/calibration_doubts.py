"""Doubts: what a set of calibration pictures leaves open.

The problem: an adjustment always returns numbers. Whether the pictures determine them is another
matter, and a small residual does not answer it: boards held parallel to each other leave focal
length and distance exchangeable, boards in one place leave the centre free, a lens is extrapolated
wherever no corner was. Each doubt is a test on the geometry of the views or on the covariance,

    places       views whose corners differ by more than 4 % of the image diagonal
    turns        the widest angle between the normals of two boards
    coverage     corners (fisheye: edges) of the image without a board
    σ            standard deviations of focal length and centre, from the covariance
    misfit       the share of the residuals that depends on the place in the image
                 (Σ_cells n |mean|² - what noise alone would leave) / Σ |r|²

and says in one sentence what is open and what to do. Fatal doubts are those after which the numbers
mean nothing. O(V² + V N).

Reference: P. Sturm, S. Maybank, "On plane-based camera calibration: a general algorithm,
singularities, applications", CVPR 1999.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.calibration import Calibration
from odomap.geometry.camera import Camera

__all__ = ["Doubt", "doubts", "misfit", "places"]

Array = NDArray[np.float64]

FEW_VIEWS = 10
SAME_PLACE = 0.04
"""Views are one place whose corners differ by less, on average, in image diagonals."""
PARALLEL_DEG, STEEP_DEG = 5.0, 20.0
"""Boards turned against each other by less determine nothing; by more, enough."""
FATAL_FOCAL, LARGE_FOCAL = 0.05, 0.005
"""σ of the focal length over itself: beyond use, and worth a word."""
LARGE_CENTRE = 0.005
"""σ of the centre over the image width."""
HIGH_RMS_PX = 1.0
MISFIT, MISFIT_PX = 0.4, 0.15
"""Share and size of residuals from which on the lens model is in question."""
SQUARE = 0.05
OFF_CENTRE = 0.15


@dataclass(frozen=True)
class Doubt:
    """Something the pictures leave open.

    Attributes:
        text: one sentence: what, and what to do.
        is_fatal: whether the numbers mean nothing.
    """

    text: str
    is_fatal: bool = False


def doubts(calibration: Calibration) -> list[Doubt]:
    """Say what the pictures leave open, the worst first.

    Args:
        calibration: of one camera or two.
    """
    found: list[Doubt] = []
    names = ("left camera: ", "right camera: ") if len(calibration.cameras) > 1 else ("",)
    for c, name in enumerate(names):
        for doubt in _of_camera(calibration, c):
            found.append(Doubt(name + doubt.text, doubt.is_fatal))
    if not calibration.converged:
        found.append(Doubt("the adjustment did not come to rest: take the numbers with care"))
    return sorted(found, key=lambda doubt: not doubt.is_fatal)


def _of_camera(calibration: Calibration, c: int) -> list[Doubt]:
    used = calibration.used[c]
    camera, pixels = calibration.cameras[c], calibration.pixels[c, used]
    spread = _turned_deg(calibration.Ts_camera_board[used])
    found = _views(camera, pixels, spread)
    found += _numbers(camera, calibration.sigmas(c), spread)
    if not any(doubt.is_fatal for doubt in found):
        found += _lens(camera, pixels, calibration.residuals[c, used])
    return found


def _views(camera: Camera, pixels: Array, spread_deg: float) -> list[Doubt]:
    """Ask of the views: how many, where, how turned."""
    found = []
    count = places(pixels, camera.resolution)
    if count < 3:
        where = "one place" if count == 1 else "two places"
        found.append(
            Doubt(
                f"all {len(pixels)} boards are in {where}: move the board about the picture, near "
                "and far, and tilt it",
                is_fatal=True,
            )
        )
    elif count < FEW_VIEWS:
        found.append(Doubt(f"only {count} different views of the board: 15 to 30 are better"))
    if count >= 3 and PARALLEL_DEG <= spread_deg < STEEP_DEG:
        found.append(
            Doubt(
                f"boards are turned by at most {spread_deg:.0f}° against each other, which leaves "
                "the focal length uncertain: tilt the board by 30 to 45° in some pictures"
            )
        )
    return found


def _numbers(camera: Camera, sigmas: Array, spread_deg: float) -> list[Doubt]:
    """Ask of the numbers: how sure, how plausible."""
    found = []
    share = float(np.max(sigmas[:2] / camera.intrinsics[:2]))
    centre = float(np.max(sigmas[2:4]))
    if spread_deg < PARALLEL_DEG or not share < FATAL_FOCAL:
        why = "all boards are parallel to each other" if spread_deg < STEEP_DEG else "too few views"
        found.append(
            Doubt(
                f"the pictures do not determine the focal length (± {100 * min(share, 9.99):.1f} "
                f"%): {why}; tilt the board by 30 to 45° in several directions",
                is_fatal=True,
            )
        )
    elif share > LARGE_FOCAL:
        found.append(
            Doubt(
                f"the focal length is known to ± {100 * share:.1f} % only: add pictures with the "
                "board tilted by 30 to 45°, and large in the picture"
            )
        )
    elif centre > LARGE_CENTRE * camera.width:
        found.append(
            Doubt(
                f"the centre is known to ± {centre:.1f} px only: add pictures with the board "
                "tilted in several directions, in all parts of the picture"
            )
        )
    aspect = camera.fx / camera.fy
    if abs(aspect - 1.0) > SQUARE:
        found.append(
            Doubt(
                f"fx / fy is {aspect:.3f}: pixels are rarely that oblong; were the pictures "
                "stretched, or is the board not made of squares?"
            )
        )
    size = np.array(camera.resolution)
    away = np.abs(camera.intrinsics[2:] - 0.5 * (size - 1)) / size
    if np.any(away > OFF_CENTRE):
        found.append(
            Doubt(
                f"the centre ({camera.cx:.0f}, {camera.cy:.0f}) is far from that of "
                f"{camera.width}x{camera.height} pictures: were they cropped?"
            )
        )
    return found


def _lens(camera: Camera, pixels: Array, residuals: Array) -> list[Doubt]:
    """Ask of the residuals and the image: is the lens of this kind, and seen everywhere?"""
    found = []
    other = "pinhole" if camera.model == "kannala_brandt" else "kannala_brandt"
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=2))))
    if rms > HIGH_RMS_PX:
        found.append(
            Doubt(
                f"reprojection error of {rms:.2f} px: is the board flat, the picture sharp and "
                f"still, the lens a {camera.model} one (--model {other})?"
            )
        )
    elif rms > MISFIT_PX and misfit(pixels, residuals, camera.resolution) > MISFIT:
        found.append(
            Doubt(
                "residuals depend on the place in the picture: the lens is not a "
                f"{camera.model} one (--model {other}), or the board is not flat"
            )
        )
    empty = _empty_regions(camera, pixels)
    if empty:
        found.append(
            Doubt(
                f"no board in the {' and '.join(empty)} of the picture: the distortion there is "
                "extrapolated"
            )
        )
    width, height = camera.resolution
    ends = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)
    if camera.model == "pinhole" and not np.isfinite(camera.unproject(ends)).all():
        found.append(
            Doubt(
                "the distortion folds back before the corners of the picture: add pictures with "
                "the board there, or try --model kannala_brandt"
            )
        )
    return found


def places(pixels: Array, resolution: tuple[int, int]) -> int:
    """Count views that differ.

    Args:
        pixels: (V, N, 2).
        resolution: width and height.

    Returns:
        How many views there are, no two of which look alike.
    """
    limit = SAME_PLACE * float(np.hypot(*resolution))
    kept: list[Array] = []
    for view in pixels:
        if all(np.mean(np.linalg.norm(view - other, axis=1)) > limit for other in kept):
            kept.append(view)
    return len(kept)


def misfit(pixels: Array, residuals: Array, resolution: tuple[int, int]) -> float:
    """Return the share of the squared residuals that depends on the place in the image.

    Args:
        pixels: (V, N, 2).
        residuals: (V, N, 2).
        resolution: width and height.

    Returns:
        About 0 for noise alone, 1 for none of it.
    """
    across, down = 12, 9
    cell = (pixels.reshape(-1, 2) + 0.5) / np.array(resolution) * (across, down)
    cell = np.clip(cell.astype(int), 0, (across - 1, down - 1))
    index, r = cell[:, 1] * across + cell[:, 0], residuals.reshape(-1, 2)
    counts = np.bincount(index, minlength=across * down)
    sums = np.stack([np.bincount(index, r[:, k], across * down) for k in (0, 1)], axis=1)
    total = float(np.sum(r * r))
    full = counts > 0
    explained = float(np.sum(sums[full] ** 2 / counts[full, None]))
    degrees = int(np.count_nonzero(full))
    left = (total - explained) / max(len(r) - degrees, 1)
    return float(max(0.0, (explained - degrees * left) / max(total, 1e-12)))


def _turned_deg(Ts_camera_board: Array) -> float:
    """Return the widest angle between the normals of two boards, degrees."""
    normals = Ts_camera_board[:, :3, 2]
    return float(np.degrees(np.arccos(np.clip(np.min(normals @ normals.T), -1.0, 1.0))))


def _empty_regions(camera: Camera, pixels: Array) -> list[str]:
    """Return the names of the corners of the image (fisheye: edges) that no board reached."""
    x, y = (pixels.reshape(-1, 2) / np.array(camera.resolution)).T
    if camera.model == "pinhole":
        regions = {
            "upper left": (x < 0.3) & (y < 0.3),
            "upper right": (x > 0.7) & (y < 0.3),
            "lower left": (x < 0.3) & (y > 0.7),
            "lower right": (x > 0.7) & (y > 0.7),
        }
    else:
        regions = {"left": x < 0.25, "right": x > 0.75, "top": y < 0.25, "bottom": y > 0.75}
    return [name for name, here in regions.items() if not here.any()]
