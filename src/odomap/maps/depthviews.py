"""Depth and colour of a frame, as an ideal pinhole sees them: from a depth sensor or a stereo pair.

Fusing projects voxels into the image, and a pinhole makes that two divisions. Depth of a sensor is
registered to a camera that may have a distorted lens: its pixels are read where the pinhole's rays
meet the lens, each whole, since a depth between two surfaces is none. A stereo pair is rectified,
matched densely (SGM), and has depth z = f b / d.

How far depth can be used follows from its noise, which grows with its square,

    σ_z = k z²,   k = 0.0015 per metre of a structured-light sensor, σ_d / (f b) of a stereo pair:

where σ_z is half the band that distances are cut at, a surface is lost in its noise.

Reference: K. Khoshelham, S. Oude Elberink, "Accuracy and resolution of Kinect depth data for indoor
mapping applications", Sensors 12(2), 2012; H. Hirschmüller, "Stereo processing by semiglobal
matching and mutual information", IEEE T-PAMI 30(2), 2008.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig

__all__ = ["DepthView", "DepthViews", "SensorViews", "StereoViews", "depth_views"]

SENSOR_NOISE = 0.0015
"""Standard deviation of a structured-light sensor's depth, over its square, 1/m."""
DISPARITY_NOISE_PX = 0.3
"""Standard deviation of a disparity of dense matching."""


@dataclass(frozen=True)
class DepthView:
    """What one frame says of the surfaces before it.

    Attributes:
        depth: (H, W) float32 metres along the optical axis, 0 where unknown.
        colour: (H, W) grey or (H, W, 3) RGB, uint8.
    """

    depth: NDArray[np.float32]
    colour: NDArray[np.uint8]


class DepthViews(Protocol):
    """Makes views of frames.

    Attributes:
        camera: the pinhole of the views.
        T_body_camera: where it is mounted.
        noise: standard deviation of depth, over its square, 1/m.
    """

    camera: Camera
    T_body_camera: SE3
    noise: float

    def view(self, frame: Frame, colour: NDArray[np.uint8] | None = None) -> DepthView | None:
        """Return what a frame shows, or None if it has no depth.

        Args:
            frame: of the rig.
            colour: (H, W, 3) RGB of the first camera's image; without it the view is grey.

        Raises:
            InputError: depth or colour has not the size of the camera's image.
        """
        ...


def depth_views(rig: Rig) -> DepthViews:
    """Return what makes views of the frames of a rig.

    Raises:
        InputError: the rig has neither a depth sensor nor a stereo pair.
    """
    if rig.depth is not None:
        return SensorViews(rig)
    if len(rig.cameras) >= 2:
        return StereoViews(rig)
    raise InputError(
        "there is no depth: a cloud or a mesh needs a depth sensor or a stereo pair, "
        f"this rig has {'one camera' if rig.cameras else 'no camera'}"
    )


class SensorViews:
    """Views of a depth sensor, registered to one of the cameras."""

    def __init__(self, rig: Rig) -> None:
        from odomap.vision.undistorter import Undistorter

        assert rig.depth is not None
        mount = rig.camera(rig.depth.camera)
        self._row = rig.cameras.index(mount)
        self._name = mount.name
        self._raw = mount.camera
        self._undistorter = Undistorter(mount.camera)
        self.camera = self._undistorter.camera
        self.T_body_camera = mount.T_body_camera
        self.noise = SENSOR_NOISE
        geometry = self._undistorter.geometry
        self._maps = None if geometry.is_identity else geometry.maps()

    def view(self, frame: Frame, colour: NDArray[np.uint8] | None = None) -> DepthView | None:
        """Return what a frame shows, or None if it has no depth."""
        if frame.depth is None:
            return None
        image = frame.images[self._row]
        if colour is not None and self._row == 0:
            image = colour
        size = (self._raw.height, self._raw.width)
        if image is None:
            image = np.full(size, 160, np.uint8)
        for what, array in (("depth", frame.depth), ("image", image)):
            if array.shape[:2] != size:
                raise InputError(
                    f"frame {frame.id}: {what} is {array.shape[1]}x{array.shape[0]}, camera "
                    f"'{self._name}' is calibrated for {size[1]}x{size[0]}: depth must be "
                    "registered to the camera's image"
                )
        depth = np.asarray(frame.depth, np.float32)
        if self._maps is not None:
            import cv2

            # Nearest: the mean of two surfaces is neither.
            depth = np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST), np.float32)
        return DepthView(depth, self._undistorter.undistort(image))


class StereoViews:
    """Views of a stereo pair, by dense matching."""

    def __init__(self, rig: Rig) -> None:
        from odomap.vision.rectifier import Rectifier
        from odomap.vision.stereo import StereoConfig

        self._rectifier = Rectifier(rig)
        self._config = StereoConfig(method="sgbm")
        self.camera = self._rectifier.camera
        self.T_body_camera = SE3(self._rectifier.T_body_camera)
        self._reach = self.camera.fx * self._rectifier.baseline
        self.noise = DISPARITY_NOISE_PX / self._reach

    def view(self, frame: Frame, colour: NDArray[np.uint8] | None = None) -> DepthView | None:
        """Return what a frame shows, or None if one of its images is missing."""
        from odomap.vision.stereo import sgbm_disparity

        left, right = frame.images[:2]
        if left is None or right is None:
            return None
        left = self._rectifier.rectify(left, "left")
        right = self._rectifier.rectify(right, "right")
        disparity = _smoothed(sgbm_disparity(left, right, self._config))
        known = (disparity > 0.0) & self._rectifier.mask
        depth = np.zeros(disparity.shape, np.float32)
        depth[known] = self._reach / disparity[known]
        shown = left if colour is None else self._rectifier.rectify(colour, "left")
        return DepthView(depth, shown)


def _smoothed(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the median over 5x5 pixels where known, else 0: it takes lone outliers away."""
    import cv2

    known = np.nan_to_num(disparity, nan=0.0)
    median = np.asarray(cv2.medianBlur(known, 5), np.float32)
    return np.where(known > 0.0, median, np.float32(0.0))
