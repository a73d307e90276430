"""Calibration: what a camera does to a ray, from pictures of a board of known size.

The problem: given where the corners of a chessboard appear in some pictures, find focal lengths,
centre and distortion of the lens (and of a second camera, and where that one is). It is a bundle
adjustment whose points are known (`calibration_arrow`); what is hard is to start it, and to know
which pictures to believe. A start is

    pinhole    Zhang's closed form, and its humbler forms (`geometry.zhang`)
    fisheye    a ladder of focal lengths from 0.15 to 2 image widths, of the undistorted model

each judged by how well single boards fit, the best two being adjusted and the better one kept. A
corner's σ is then estimated from the median residual, views that fit far worse than the others are
left out, and the adjustment goes on until the same views stay. For a pair, each camera is first
calibrated alone; the place of the second is what most pairs agree on, also about which end of a
symmetric board is up.

The covariance is that of the adjustment times the variance the residuals show; O(V N) per step.

Reference: Z. Zhang, "A flexible new technique for camera calibration", IEEE T-PAMI 22(11), 2000;
J. Kannala, S. Brandt, TPAMI 28(8), 2006 (fisheye).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.calibration_arrow import (
    ArrowProblem,
    ArrowSolution,
    ArrowState,
    residuals,
    solve_arrow,
)
from odomap.errors import CalibrationError, InputError
from odomap.geometry.camera import MODELS, Camera
from odomap.geometry.lie import se3_inverse, so3_log
from odomap.geometry.pose import SE3
from odomap.geometry.so3 import tail_shape
from odomap.geometry.twoview import homography
from odomap.geometry.zhang import intrinsics_of_plane_views, pose_of_plane

__all__ = ["Calibration", "calibrate_camera", "calibrate_pair"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_VIEWS = 3
START_VIEWS = 8
"""Views, spread over all, by which starts are judged."""
CLOSE_SECOND = 2.0
"""A second start is tried if boards fit it at most so much worse than the first."""
FOCAL_LADDER = np.geomspace(0.15, 2.0, 9)
SIGMA_FLOOR_PX = 0.005
"""Corners are not better than that, even in rendered pictures."""
MAX_ROUNDS = 4
OUTLIER_FACTOR, OUTLIER_PX = 3.0, 0.3
"""A view is left out whose RMS is above this many medians and these pixels."""
SAME_TURN, SAME_SHIFT = np.radians(5.0), 0.3
"""Pairs agree that put the second camera this near each other: radians, share of the baseline."""


@dataclass(frozen=True)
class Calibration:
    """What the pictures say about the cameras.

    Attributes:
        cameras: one lens, or left and right.
        T_left_right: where the right camera is; None for one camera.
        covariance: (G, G) of fx fy cx cy and coefficients of each camera in turn, then of
            T_left_right (tangent (translation, rotation), right update).
        Ts_camera_board: (V, 4, 4) the board in axes of the first camera; NaN where not used.
        pixels: (C, V, N, 2) the corners, NaN where not seen; for a pair ordered alike in both.
        residuals: (C, V, N, 2) reprojection errors in pixels, also of views left out.
        used: (C, V) which views the solution stands on.
        sigma_px: standard deviation of a corner's coordinate.
        converged: whether the adjustment came to rest.
    """

    cameras: tuple[Camera, ...]
    T_left_right: SE3 | None
    covariance: Array
    Ts_camera_board: Array
    pixels: Array
    residuals: Array
    used: Mask
    sigma_px: float
    converged: bool

    @property
    def view_rms(self) -> Array:
        """(C, V) root mean square reprojection error in pixels, NaN where not seen."""
        return np.asarray(np.sqrt(np.mean(np.sum(self.residuals**2, axis=3), axis=2)))

    @property
    def rms_px(self) -> Array:
        """(C,) root mean square reprojection error of the views used, pixels."""
        squares = np.sum(self.residuals**2, axis=3)
        return np.array([np.sqrt(np.mean(s[u])) for s, u in zip(squares, self.used)])

    def sigmas(self, camera: int) -> Array:
        """Return the standard deviations (4 + n,) of one camera's fx fy cx cy and coefficients."""
        at = sum(4 + len(lens.distortion) for lens in self.cameras[:camera])
        size = 4 + len(self.cameras[camera].distortion)
        return np.sqrt(np.diag(self.covariance)[at : at + size])

    @property
    def baseline_sigma(self) -> float:
        """Standard deviation of the distance of the cameras of a pair, metres; NaN for one."""
        if self.T_left_right is None:
            return float("nan")
        way = self.T_left_right.R.T @ self.T_left_right.t
        way = way / max(float(np.linalg.norm(way)), 1e-12)
        return float(np.sqrt(way @ self.covariance[-6:-3, -6:-3] @ way))


def calibrate_camera(
    points_board: ArrayLike,
    pixels: ArrayLike,
    resolution: tuple[int, int],
    model: str = "pinhole",
    num_coefficients: int = 4,
) -> Calibration:
    """Calibrate one camera.

    Args:
        points_board: (N, 3) corners of the board on z = 0, metres.
        pixels: (V, N, 2) where each view shows them; NaN for views that do not.
        resolution: width and height of the pictures.
        model: a key of `MODELS`.
        num_coefficients: how many distortion coefficients, one of the model's `lengths`.

    Returns:
        The calibration.

    Raises:
        InputError: shapes do not agree, or fewer than 3 views show the board.
        CalibrationError: an unknown model, or no lens explains the views.

    Example:
        >>> from odomap.simulation.board import board_views  # doctest: +SKIP
        >>> calibrate_camera(views.board.points, views.pixels, (640, 480))  # doctest: +SKIP
    """
    points, seen = _checked(points_board, pixels)
    blank = _blank(model, num_coefficients, resolution)
    views = np.flatnonzero(np.isfinite(seen[0, :, 0, 0]))
    if len(views) < MIN_VIEWS:
        raise InputError(f"{len(views)} views of the board, {MIN_VIEWS} or more needed")
    best: ArrowSolution | None = None
    for camera in _starts(points, seen[0, views], blank):
        state = _placed(points, seen, (camera,), np.eye(4)[None])
        solution = solve_arrow(ArrowProblem(points, seen), state, tolerance=1e-5)
        if best is None or solution.cost < best.cost:
            best = solution
    if best is None:
        raise CalibrationError(f"no {model} lens explains these {len(views)} views")
    return _settled(points, seen, best.state)


def calibrate_pair(
    points_board: ArrayLike,
    left: ArrayLike,
    right: ArrayLike,
    resolutions: Sequence[tuple[int, int]],
    model: str = "pinhole",
    num_coefficients: int = 4,
    *,
    symmetric: bool = False,
) -> Calibration:
    """Calibrate two cameras together.

    Args:
        points_board: (N, 3) corners of the board on z = 0, metres.
        left: (V, N, 2) where the left pictures show them; NaN for views that do not.
        right: (V, N, 2) the same views by the right camera.
        resolutions: width and height of left and right pictures.
        model: of both lenses.
        num_coefficients: of each lens.
        symmetric: whether the board looks the same upside down, so that the two pictures of a pair
            may count its corners from different ends.

    Returns:
        The calibration; pairs that contradict most others are not used.

    Raises:
        InputError: too few views, or left and right do not belong together.
        CalibrationError: an unknown model, or no lens explains the views.
    """
    points, seen = _checked(points_board, left, right)
    alone = []
    for name, pixels, resolution in zip(("left", "right"), seen, resolutions):
        try:
            alone.append(calibrate_camera(points, pixels, resolution, model, num_coefficients))
        except (InputError, CalibrationError) as error:
            raise type(error)(f"{name} camera: {error}") from error
    seen[0, ~alone[0].used[0]], seen[1, ~alone[1].used[0]] = np.nan, np.nan
    cameras = alone[0].cameras[0], alone[1].cameras[0]
    T_left_right, seen[1] = _agreed(points, seen, cameras, symmetric)
    mounts = np.stack([np.eye(4), T_left_right])
    state = _placed(points, seen, cameras, mounts)
    solution = solve_arrow(ArrowProblem(points, seen), state, tolerance=1e-5)
    return _settled(points, seen, solution.state)


def _checked(points_board: ArrayLike, *pixels: ArrayLike) -> tuple[Array, Array]:
    points = tail_shape(points_board, (3,), "points_board")
    seen = [np.array(tail_shape(p, (2,), "pixels")) for p in pixels]
    good = all(p.ndim == 3 and p.shape[1] == len(points) for p in seen)
    if points.ndim != 2 or not good or len({p.shape for p in seen}) > 1:
        shapes = ", ".join(str(p.shape) for p in seen)
        raise InputError(f"points_board {points.shape}, pixels {shapes}: give (N, 3), (V, N, 2)")
    if len(points) < 6 or np.any(points[:, 2] != 0):
        raise InputError("points_board: give 6 or more corners on the plane z = 0")
    for p in seen:
        p[~np.isfinite(p).all(axis=(1, 2))] = np.nan
    return points, np.stack(seen)


def _blank(model: str, num_coefficients: int, resolution: tuple[int, int]) -> Camera:
    """Return the model without distortion, at a focal length to be replaced."""
    size = float(max(resolution))
    width, height = resolution
    intrinsics = np.array([size, size, 0.5 * (width - 1.0), 0.5 * (height - 1.0)])
    if model in MODELS and MODELS[model].lengths == (2,):
        return Camera(model, intrinsics, np.array([0.0, 0.5]), resolution)
    count = num_coefficients
    if model in MODELS and count not in MODELS[model].lengths:
        count = MODELS[model].lengths[0]
    return Camera(model, intrinsics, np.zeros(count), resolution)


def _starts(points: Array, pixels: Array, blank: Camera) -> list[Camera]:
    """Return the two likeliest lenses to start from."""
    chosen = np.unique(np.linspace(0, len(pixels) - 1, START_VIEWS).round().astype(int))
    width = float(max(blank.resolution))
    guesses = [np.array([f * width, f * width, *blank.intrinsics[2:]]) for f in FOCAL_LADDER]
    if blank.model == "pinhole":
        Hs = np.stack([homography(points[:, :2], uv) for uv in pixels])
        guesses = intrinsics_of_plane_views(Hs, blank.resolution) + guesses[::3]
    rated = []
    for guess in guesses:
        camera = replace(blank, intrinsics=guess)
        errors = [pose_of_plane(points, uv, camera, mirrored=False)[1] for uv in pixels[chosen]]
        # The median, so that a picture without a board in it has no say.
        rated.append((float(np.median(errors)), camera))
    rated.sort(key=lambda item: item[0])
    limit = CLOSE_SECOND * rated[0][0]
    return [camera for error, camera in rated[:2] if np.isfinite(error) and error <= limit]


def _placed(
    points: Array, pixels: Array, cameras: tuple[Camera, ...], Ts_first_camera: Array
) -> ArrowState:
    """Place every board by the camera that sees it, the better one if both do."""
    Ts = np.tile(np.eye(4), (pixels.shape[1], 1, 1))
    Ts[:, 2, 3] = 1.0
    for v in range(pixels.shape[1]):
        least = np.inf
        for camera, mount, uv in zip(cameras, Ts_first_camera, pixels[:, v]):
            if np.isfinite(uv).all():
                T, error = pose_of_plane(points, uv, camera)
                if error < least:
                    Ts[v], least = mount @ T.matrix, error
    return ArrowState(cameras, Ts_first_camera, Ts)


def _agreed(
    points: Array, pixels: Array, cameras: tuple[Camera, Camera], symmetric: bool
) -> tuple[Array, Array]:
    """Return T_left_right as most pairs have it, and the right pixels ordered as the left are.

    The right pictures of pairs that have it otherwise are marked as not seen.
    """
    both = np.flatnonzero(np.isfinite(pixels[:, :, 0, 0]).all(axis=0))
    if len(both) < MIN_VIEWS:
        raise InputError(
            f"{len(both)} pairs in which both cameras see the board, {MIN_VIEWS} or more needed: "
            "hold it where the two pictures overlap"
        )
    right = pixels[1].copy()
    options = []
    for v in both:
        T_left_board = pose_of_plane(points, pixels[0, v], cameras[0])[0].matrix
        orders = [pixels[1, v], pixels[1, v, ::-1]] if symmetric else [pixels[1, v]]
        Ts = [pose_of_plane(points, uv, cameras[1])[0].matrix for uv in orders]
        options.append([T_left_board @ se3_inverse(T) for T in Ts])
    table = np.array(options)
    near = [_near(candidate, table) for candidate in table.reshape(-1, 4, 4)]
    votes = [int(np.count_nonzero(n.any(axis=1))) for n in near]
    winner = int(np.argmax(votes))
    if 2 * votes[winner] < len(both) or votes[winner] < MIN_VIEWS:
        raise InputError(
            f"only {votes[winner]} of {len(both)} pairs agree where the right camera is: "
            "do left and right pictures belong together, taken at the same time?"
        )
    for row, v in enumerate(both):
        if not near[winner][row].any():
            right[v] = np.nan
        elif not near[winner][row, 0]:
            right[v] = right[v, ::-1]
    return table.reshape(-1, 4, 4)[winner], right


def _near(T: Array, others: Array) -> Mask:
    """Say which of (..., 4, 4) are nearly T."""
    turn = np.linalg.norm(so3_log(T[:3, :3].T @ others[..., :3, :3]), axis=-1)
    shift = np.linalg.norm(others[..., :3, 3] - T[:3, 3], axis=-1)
    length = max(float(np.linalg.norm(T[:3, 3])), 1e-3)
    return np.asarray((turn < SAME_TURN) & (shift < SAME_SHIFT * length))


def _settled(points: Array, pixels: Array, state: ArrowState) -> Calibration:
    """Adjust with the σ the residuals have, without views that fit far worse than the others."""
    seen = np.isfinite(pixels[:, :, 0, 0])
    everything = ArrowProblem(points, pixels)
    for _ in range(MAX_ROUNDS):
        e = residuals(everything, state)
        used = _believed(e, seen)
        if np.any(np.count_nonzero(used, axis=1) < MIN_VIEWS):
            raise CalibrationError("hardly any two views agree: was the board bent, or moved?")
        sigma = max(1.4826 * float(np.median(np.abs(e[used]))), SIGMA_FLOOR_PX)
        kept = np.where(used[:, :, None, None], pixels, np.nan)
        solution = solve_arrow(ArrowProblem(points, kept, sigma), state)
        state = solution.state
        e = residuals(everything, state)
        if np.array_equal(_believed(e, seen), used):
            break
    views = np.asarray(used.any(axis=0))
    free = len(solution.covariance) + 6 * int(np.count_nonzero(views))
    surplus = 2 * int(np.count_nonzero(used)) * len(points) - free
    inflation = max(2.0 * solution.cost / max(surplus, 1), 1e-12)
    Ts = np.where(views[:, None, None], state.Ts_first_board, np.nan)
    return Calibration(
        cameras=state.cameras,
        T_left_right=SE3(state.Ts_first_camera[1]) if len(state.cameras) > 1 else None,
        covariance=solution.covariance * inflation,
        Ts_camera_board=Ts,
        pixels=pixels,
        residuals=e,
        used=used,
        sigma_px=float(sigma * np.sqrt(inflation)),
        converged=solution.converged,
    )


def _believed(errors: Array, seen: Mask) -> Mask:
    """Say which views (C, V) fit about as well as the others."""
    rms = np.sqrt(np.mean(np.sum(errors**2, axis=3), axis=2))
    used = np.zeros_like(seen)
    for c, row in enumerate(rms):
        row = np.where(seen[c], np.nan_to_num(row, nan=np.inf), np.nan)
        limit = max(OUTLIER_FACTOR * float(np.nanmedian(row)), OUTLIER_PX)
        used[c] = row <= limit
    return used
