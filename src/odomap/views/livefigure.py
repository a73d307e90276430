"""What a sensor looks like in the live view: a camera with its image, a LiDAR with its sweep.

Where the sensor is now, a figure stands: the frustum of a camera, which shows what it sees, and
shows it larger in the panel; the axes of a LiDAR, x ahead in red, and around them what has just
returned. Where it was at keyframes there are marks, small frusta or arrow heads, all of them one
set of lines. When the sensor has no pose of its own its figure is red.
"""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.views.livepicture import shrunk

__all__ = ["CameraFigure", "Figure", "LidarFigure", "arrows", "frusta", "opening"]

Array = NDArray[np.float64]
Segments = NDArray[np.float32]
Colour = tuple[int, int, int]

SENSOR: Colour = (53, 224, 161)
LOST: Colour = (255, 84, 60)
FRUSTUM_SIZE, AXES_SIZE = 0.07, 0.12
"""As shares of the distance to what the sensor sees."""
FRUSTUM_IMAGE_PX = 320
WIDEST_VIEW = 1.2
"""Frusta are at most so wide at distance 1, also those of a fisheye."""
CORNERS = np.array([(0.5, 0.0, 0.0), (-0.5, 0.4, 0.0), (-0.25, 0.0, 0.0), (-0.5, -0.4, 0.0)])
"""Of an arrow head: x is ahead."""


class Figure(Protocol):
    """A sensor on the page."""

    def resize(self, reach: float) -> None:
        """Let its size be that of what it sees, world units."""

    def resize_points(self, size: float) -> None:
        """Let its points be of a size, world units."""

    def show(
        self, T_world_sensor: Array, wxyz: Array, sight: NDArray[Any] | None, is_lost: bool
    ) -> None:
        """Draw it where it is now.

        Args:
            T_world_sensor: (4, 4).
            wxyz: (4,) its rotation.
            sight: what it sees; None keeps what was there before.
            is_lost: whether it has no pose of its own.
        """


class CameraFigure:
    """A frustum with the image.

    Args:
        server: of pages.
        camera: its lens; None where nobody knows.
    """

    def __init__(self, server: Any, camera: Camera | None) -> None:
        wide, high = opening(camera)
        self._gui: Any = server.gui
        self._picture: Any = None
        self.node = server.scene.add_camera_frustum(
            "/run/camera",
            fov=2 * np.arctan(high),
            aspect=wide / high,
            color=SENSOR,
            thickness=2.5,
            thickness_units="screen",
            visible=False,
            cast_shadow=False,
            receive_shadow=False,
        )

    def resize(self, reach: float) -> None:
        """Let its size be that of what it sees, world units."""
        self.node.scale = FRUSTUM_SIZE * reach

    def resize_points(self, size: float) -> None:
        """Do nothing: an image has none."""

    def show(
        self, T_world_sensor: Array, wxyz: Array, sight: NDArray[np.uint8] | None, is_lost: bool
    ) -> None:
        """Draw the camera where it is now, and the image (h, w, 3) RGB that it sees."""
        self.node.position = T_world_sensor[:3, 3]
        self.node.wxyz = wxyz
        self.node.color = LOST if is_lost else SENSOR
        self.node.visible = True
        if sight is not None:
            self.node.image = shrunk(sight, FRUSTUM_IMAGE_PX)
            self._enlarge(sight)

    def _enlarge(self, image: NDArray[np.uint8]) -> None:
        if self._picture is None:
            self._picture = self._gui.add_image(image, jpeg_quality=80, order=1e9)
        else:
            self._picture.image = image


class LidarFigure:
    """Axes, x ahead, and what has just returned.

    Args:
        server: of pages.
    """

    def __init__(self, server: Any) -> None:
        self.node = server.scene.add_frame("/run/lidar", origin_color=SENSOR, visible=False)
        self.sweep = server.scene.add_point_cloud(
            "/run/lidar/sweep",
            np.zeros((0, 3), np.float32),
            SENSOR,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def resize(self, reach: float) -> None:
        """Let its size be that of what it sees, world units."""
        size = AXES_SIZE * reach
        self.node.axes_length, self.node.axes_radius = size, 0.05 * size
        self.node.origin_radius = 0.15 * size

    def resize_points(self, size: float) -> None:
        """Let its points be of a size, world units."""
        self.sweep.point_size = size

    def show(
        self, T_world_sensor: Array, wxyz: Array, sight: NDArray[np.float32] | None, is_lost: bool
    ) -> None:
        """Draw the LiDAR where it is now, and the points (N, 3) that it sees from there."""
        self.node.position = T_world_sensor[:3, 3]
        self.node.wxyz = wxyz
        self.node.origin_color = LOST if is_lost else SENSOR
        self.node.visible = True
        self.sweep.colors = np.array(LOST if is_lost else SENSOR, np.uint8)
        if sight is not None:
            self.sweep.points = sight


def frusta(Ts_world_camera: Array, opening: tuple[float, float], size: float) -> Segments:
    """Return the (8 K, 2, 3) edges of K cameras.

    Args:
        Ts_world_camera: (K, 4, 4).
        opening: half width and half height of the image at distance 1.
        size: length of a frustum, world units.
    """
    x, y = opening
    tips = size * np.array([(0, 0, 0), (-x, -y, 1), (x, -y, 1), (x, y, 1), (-x, y, 1)])
    edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    return _segments(Ts_world_camera, tips[edges])


def arrows(Ts_world_lidar: Array, size: float) -> Segments:
    """Return the (4 K, 2, 3) edges of K arrow heads.

    Args:
        Ts_world_lidar: (K, 4, 4); x is ahead.
        size: length of a head, world units.
    """
    return _segments(Ts_world_lidar, size * CORNERS[[(0, 1), (1, 2), (2, 3), (3, 0)]])


def opening(camera: Camera | None) -> tuple[float, float]:
    """Return half the width and height of the image at distance 1."""
    if camera is None:
        return 0.6, 0.4
    wide = min(0.5 * camera.width / camera.fx, WIDEST_VIEW)
    return wide, wide * camera.height / camera.width


def _segments(Ts: Array, edges: Array) -> Segments:
    """Return edges (E, 2, 3) as seen from poses (K, 4, 4): (K E, 2, 3)."""
    world = np.einsum("kij,eaj->keai", Ts[:, :3, :3], edges) + Ts[:, None, None, :3, 3]
    return np.asarray(world.reshape(-1, 2, 3), np.float32)
