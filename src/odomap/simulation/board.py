"""Pictures of a chessboard through any lens, with exactly known corners.

The problem: a calibration can be judged only against a camera whose numbers are known. Boards are
put all over the image, at several distances, tilted in all directions, as a careful person does;
`board_picture` renders them. The true corners are

    x = π(T_camera_board q),    q on a grid of squares in the plane z = 0.

Light falls unevenly, the wall behind is cluttered, the lens blurs and the sensor adds noise
(`exposure`). The same seed gives the same bytes.

Cost: 30 ms per picture of 640 x 480.

Reference: Z. Zhang, "A flexible new technique for camera calibration", IEEE T-PAMI 22(11), 2000,
section 4.2 (what orientation and number of views do to the result).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, OutputError
from odomap.geometry.camera import Camera
from odomap.geometry.lie import so3_exp
from odomap.geometry.pose import SE3
from odomap.simulation.board_picture import board_picture, corner_rays, paint_walls
from odomap.simulation.exposure import ImageNoise
from odomap.vision.board import Board

__all__ = [
    "BoardViews",
    "board_pose",
    "board_views",
    "render_board",
    "write_board_views",
]

Array = NDArray[np.float64]
NOISE = ImageNoise(exposure_drift=0.0, pair_drift=0.0, shutter_s=0.0, softness_px=0.6)
MARGIN_PX = 6.0
TRIES = 400
"""Poses drawn at most until one lies wholly in the images."""


@dataclass(frozen=True)
class BoardViews:
    """Pictures of a board, and the truth about them.

    Attributes:
        board: the board.
        images: (H, W) uint8 per view.
        pixels: (V, N, 2) the true corners, in the order of `Board.points`.
        Ts_camera_board: (V, 4, 4).
        right_images: the same views by the right camera of a pair; empty for one camera.
        right_pixels: (V, N, 2) there; (0, N, 2) for one camera.
    """

    board: Board
    images: tuple[NDArray[np.uint8], ...]
    pixels: Array
    Ts_camera_board: Array
    right_images: tuple[NDArray[np.uint8], ...]
    right_pixels: Array


def board_views(
    camera: Camera,
    seed: int = 0,
    count: int = 20,
    board: tuple[int, int] = (9, 6),
    square: float = 0.025,
    *,
    right: Camera | None = None,
    T_left_right: SE3 | None = None,
    noise: ImageNoise = NOISE,
) -> BoardViews:
    """Take pictures of a chessboard as a careful person does.

    Args:
        camera: any lens; the left camera of a pair.
        seed: of poses, light, clutter and noise.
        count: how many pictures.
        board: inner corners along and across.
        square: side of a square, metres.
        right: the right camera of a pair.
        T_left_right: where it is.
        noise: how imperfect the cameras are.

    Returns:
        The pictures with their true corners and poses.

    Raises:
        InputError: the cameras of the pair can hardly see one board together.

    Example:
        >>> camera = Camera(intrinsics=(100.0, 100.0, 79.5, 59.5), resolution=(160, 120))
        >>> board_views(camera, seed=1, count=2).pixels.shape
        (2, 54, 2)
    """
    target = Board(*board, square)
    eyes = [(camera, SE3.identity())]
    if right is not None:
        eyes.append((right, T_left_right or SE3.identity()))
    rng = np.random.default_rng([seed, 41])
    Ts = [_pose(rng, eyes, target, k, count) for k in range(count)]
    walls = paint_walls([lens for lens, _ in eyes], seed)
    images: list[list[NDArray[np.uint8]]] = [[], []]
    pixels: list[list[Array]] = [[], []]
    for number, (lens, T_first_this) in enumerate(eyes):
        rays = corner_rays(lens)
        for k, T in enumerate(Ts):
            T_this_board = T_first_this.inverse() @ T
            images[number].append(
                board_picture(lens, rays, walls, T_this_board, target, noise, (seed, k, number))
            )
            pixels[number].append(lens.project(T_this_board @ target.points))
    shape = (-1, len(target.points), 2)
    return BoardViews(
        target,
        tuple(images[0]),
        np.array(pixels[0]).reshape(shape),
        np.stack([T.matrix for T in Ts]),
        tuple(images[1]),
        np.array(pixels[1]).reshape(shape),
    )


def render_board(
    camera: Camera,
    T_camera_board: SE3,
    board: Board,
    *,
    seed: int = 0,
    noise: ImageNoise = NOISE,
) -> NDArray[np.uint8]:
    """Take one picture of a chessboard.

    Args:
        camera: any lens.
        T_camera_board: where the board is; its z points away from who sees its front.
        board: the board.
        seed: of light, clutter and noise.
        noise: how imperfect the camera is.

    Returns:
        (H, W) uint8.
    """
    rays, walls = corner_rays(camera), paint_walls([camera], seed)
    return board_picture(camera, rays, walls, T_camera_board, board, noise, (seed, 0, 0))


def board_pose(
    camera: Camera, board: Board, at: tuple[float, float], share: float, tilt: tuple[float, float],
    roll: float = 0.0,
) -> SE3:  # fmt: skip
    """Return where a board is that appears at a place of the image with a size and a tilt.

    Args:
        camera: any lens.
        board: the board.
        at: pixel of its middle.
        share: its length in the image over the image's smaller side, if it were not tilted.
        tilt: turn about the board's x and y axis, radians; 0 faces the camera.
        roll: turn about the line of sight, radians.

    Returns:
        T_camera_board.
    """
    ray = camera.unproject(np.array([at]))[0]
    if not np.all(np.isfinite(ray)):
        raise InputError(f"at: no ray of this lens leads to the pixel {at}")
    z = ray
    x = np.cross(np.array([0.0, 1.0, 0.0]), z)
    x /= np.linalg.norm(x)
    facing = np.stack([x, np.cross(z, x), z], axis=1)
    # A metre across the line of sight, one metre away, is this many pixels there.
    metre = float(np.linalg.norm(camera.project_jacobian(ray[None])[0] @ x))
    length = board.square * (board.columns + 1)
    distance = metre * length / (share * min(camera.resolution))
    R = facing @ so3_exp(np.array([0.0, 0.0, roll])) @ so3_exp(np.array([*tilt, 0.0]))
    middle = 0.5 * board.square * np.array([board.columns - 1.0, board.rows - 1.0, 0.0])
    return SE3.from_parts(R, distance * ray - R @ middle)


def write_board_views(views: BoardViews, folder: str | Path) -> Path:
    """Write pictures as PNG files, in folders `left` and `right` for a pair.

    Args:
        views: the pictures.
        folder: is made if it is not there.

    Returns:
        The folder.

    Raises:
        OutputError: something cannot be written.
    """
    import cv2

    root = Path(folder)
    places = [(root / "left" if views.right_images else root, views.images)]
    if views.right_images:
        places.append((root / "right", views.right_images))
    for place, images in places:
        for k, image in enumerate(images):
            ok, png = cv2.imencode(".png", image)
            if not ok:
                raise OutputError(f"{place}: picture {k} cannot be encoded as PNG")
            try:
                place.mkdir(parents=True, exist_ok=True)
                (place / f"board_{k:03d}.png").write_bytes(png.tobytes())
            except OSError as error:
                raise OutputError(f"{place}: cannot be written: {error.strerror}") from error
    return root


def _pose(
    rng: np.random.Generator, eyes: list[tuple[Camera, SE3]], board: Board, k: int, count: int
) -> SE3:
    """Draw a pose at which all cameras see the whole board; the k-th of `count` cells comes first.

    A board that does not fit there is drawn anew, smaller each time.
    """
    camera = eyes[0][0]
    size = np.array(camera.resolution, dtype=np.float64)
    columns = int(np.ceil(np.sqrt(count * size[0] / size[1])))
    rows = int(np.ceil(count / columns))
    cell = np.array([k % columns, k // columns])
    for attempt in range(TRIES):
        spread = np.minimum(0.5, 0.5 - 0.45 * attempt / TRIES)
        place = (cell + 0.5 + rng.uniform(-0.5, 0.5, 2)) / (columns, rows)
        at = size * np.clip(place + rng.normal(0, 0.15, 2), 0.5 - spread, 0.5 + spread) - 0.5
        share = rng.uniform(0.45, 0.95) * (1.0 - 0.6 * attempt / TRIES)
        turn, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.75)
        roll = rng.normal(0, 0.25)
        T = board_pose_or_none(
            camera, board, at, share, (tilt * np.cos(turn), tilt * np.sin(turn)), roll
        )
        if T is not None and all(_is_seen(lens, (F.inverse() @ T), board) for lens, F in eyes):
            return T
    raise InputError(
        f"no place in {camera.width}x{camera.height} images where a "
        f"{board.columns}x{board.rows} board of {board.square:g} m squares is seen whole"
    )


def board_pose_or_none(
    camera: Camera, board: Board, at: Array, share: float, tilt: tuple[float, float], roll: float
) -> SE3 | None:
    """Return `board_pose`, or None where no ray of the lens leads to the pixel."""
    if not np.all(np.isfinite(camera.unproject(at[None]))):
        return None
    return board_pose(camera, board, (float(at[0]), float(at[1])), share, tilt, roll)


def _is_seen(camera: Camera, T_camera_board: SE3, board: Board) -> bool:
    """Say whether the squares and half of the white border lie in the image."""
    n, m, s = board.columns, board.rows, board.square
    x, y = np.linspace(-1.5, n + 0.5, 9), np.linspace(-1.5, m + 0.5, 9)
    edge = np.concatenate(
        [
            np.stack([x, np.full(9, y[0])], axis=1),
            np.stack([x, np.full(9, y[-1])], axis=1),
            np.stack([np.full(9, x[0]), y], axis=1),
            np.stack([np.full(9, x[-1]), y], axis=1),
        ]
    )
    rim = T_camera_board @ (s * np.pad(edge, ((0, 0), (0, 1))))
    return bool(np.all(camera.is_inside(camera.project(rim), MARGIN_PX)))
