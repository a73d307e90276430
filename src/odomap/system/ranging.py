"""Ranging: the depth of image points from one frame alone, if the rig can tell it.

A stereo pair finds the point in its other image, a depth sensor looks it up. Both err by a constant
in inverse depth, σ_z = σ z²; for a pair of baseline b and focal length f, σ = σ_d / (f b). So
inverse depth is what is measured, kept and weighted, and all that follows is the same for both:
to a bundle it is the disparity over the focal length of a pair one metre apart.

Reference: Mur-Artal, Tardós, "ORB-SLAM2", T-RO 2017, section III-A (the virtual baseline).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.association import View
from odomap.system.eye import Eye
from odomap.vision.depth import DepthConfig, inverse_depth_at
from odomap.vision.rectifier import Rectifier
from odomap.vision.stereo import StereoConfig, match_sparse, sgbm_disparity

__all__ = ["UNIT_BASELINE", "DepthRanger", "Ranger", "StereoRanger"]

Array = NDArray[np.float64]

UNIT_BASELINE = 1.0
"""Metres; with it "disparity over focal length" is inverse depth."""
LARGEST_SLACK_PX = 4.0
"""A tracked point's disparity lies this near the expected one."""
MIN_DISPARITY_PX = 0.05
"""Below this a point is at infinity as far as the pair can tell, and has no depth."""
ANY_DEPTH = DepthConfig(nearest=1e-3, farthest=1e6)
"""A dense disparity map is read as a depth image is, but has no range of its own."""


class Ranger(Protocol):
    """Measures depth beside an image.

    Attributes:
        sigma: standard deviation of inverse depth, 1/m.
        calibration: how far all of them may be off together, 1/m.
    """

    @property
    def sigma(self) -> float: ...  # noqa: D102 (see the class)

    @property
    def calibration(self) -> float: ...  # noqa: D102

    def missing(self, frame: Frame) -> str:
        """Say what a frame lacks for depth; empty if it has all."""
        ...

    def measure(self, frame: Frame, view: View, keypoints: Array, expected: Array) -> Array:
        """Measure inverse depth.

        Args:
            frame: as it came.
            view: its ideal image.
            keypoints: (N, 2) pixels in that.
            expected: (n,) inverse depth of the first n points, which are known, 1/m.

        Returns:
            (N,) 1/m, NaN where it cannot be measured.
        """
        ...

    def check(self, frame: Frame, view: View, points: Array) -> None:
        """Look at the first frame for signs that depth is not what it is taken for.

        Raises:
            CalibrationError: it is not.
        """
        ...


@dataclass(frozen=True, eq=False)
class StereoRanger:
    """Depth from the right image of a rectified pair."""

    index: int
    rectifier: Rectifier
    config: StereoConfig
    calibration_px: float

    @staticmethod
    def of(rig: Rig, rectifier: Rectifier, config: StereoConfig, calibration_px: float) -> "Ranger":
        """Return the ranger of a rig's pair."""
        _, right = rig.stereo_pair()
        return StereoRanger(rig.cameras.index(right), rectifier, config, calibration_px)

    @property
    def sigma(self) -> float:
        """Standard deviation of inverse depth, 1/m."""
        return self.config.noise_px / self._fb

    @property
    def calibration(self) -> float:
        """How far all inverse depths may be off together, 1/m."""
        return self.calibration_px / self._fb

    def missing(self, frame: Frame) -> str:
        """Say whether the right image is missing."""
        there = self.index < len(frame.images) and frame.images[self.index] is not None
        return "" if there else "the right image is missing"

    def measure(self, frame: Frame, view: View, keypoints: Array, expected: Array) -> Array:
        """Match the points in the right image."""
        right, config = self._right(frame), self.config
        if config.method == "sgbm":
            dense = sgbm_disparity(view.image, right, config)
            depth = self._fb / np.where(dense > MIN_DISPARITY_PX, dense, np.inf)
            return inverse_depth_at(depth.astype(np.float32), keypoints, ANY_DEPTH)
        low = np.full(len(keypoints), -2.0)
        high = np.full(len(keypoints), float(config.max_disparity_px))
        near = expected * self._fb
        low[: len(near)], high[: len(near)] = near - LARGEST_SLACK_PX, near + LARGEST_SLACK_PX
        disparity = match_sparse(view.image, right, keypoints, config, low, high)
        return np.where(disparity > MIN_DISPARITY_PX, disparity, np.nan) / self._fb

    def check(self, frame: Frame, view: View, points: Array) -> None:
        """Raise if the two images match better the other way round.

        Raises:
            CalibrationError: left and right are swapped.
        """
        right = self._right(frame)
        matched = np.isfinite(match_sparse(view.image, right, points, self.config)).sum()
        mirrored = match_sparse(
            np.ascontiguousarray(view.image[:, ::-1]),
            np.ascontiguousarray(right[:, ::-1]),
            np.stack([view.image.shape[1] - 1 - points[:, 0], points[:, 1]], axis=1),
            self.config,
        )
        swapped = int((mirrored > 1.0).sum())
        if swapped >= 30 and swapped > 2 * matched:
            raise CalibrationError(
                f"stereo pair: {swapped} of {len(points)} points have negative disparity, "
                f"{matched} positive: left and right are swapped, exchange the two cameras"
            )

    @property
    def _fb(self) -> float:
        return self.rectifier.camera.fx * self.rectifier.baseline

    def _right(self, frame: Frame) -> NDArray[np.uint8]:
        right = frame.images[self.index]
        assert right is not None, "missing() says so first"
        return self.rectifier.rectify(right, "right")


@dataclass(frozen=True, eq=False)
class DepthRanger:
    """Depth from a depth image registered to the eye's raw image."""

    eye: Eye
    config: DepthConfig

    @property
    def sigma(self) -> float:
        """Standard deviation of inverse depth, 1/m."""
        return self.config.noise

    @property
    def calibration(self) -> float:
        """How far all inverse depths may be off together, 1/m."""
        return self.config.calibration

    def missing(self, frame: Frame) -> str:
        """Say whether the depth image is missing."""
        return "the depth image is missing" if frame.depth is None else ""

    def measure(self, frame: Frame, view: View, keypoints: Array, expected: Array) -> Array:
        """Look the points up.

        Raises:
            CalibrationError: the depth image has another size than the camera's.
        """
        depth = frame.depth
        assert depth is not None, "missing() says so first"
        if depth.shape[::-1] != self.eye.raw:
            (w, h), (width, height) = depth.shape[::-1], self.eye.raw
            raise CalibrationError(
                f"frame {frame.id}: the depth image is {w}x{h}, the camera's {width}x{height}: "
                "depth must be registered to the camera"
            )
        return inverse_depth_at(depth, self.eye.to_raw(keypoints), self.config)

    def check(self, frame: Frame, view: View, points: Array) -> None:
        """Raise if hardly any depth can be believed.

        Raises:
            CalibrationError: depth lies outside what the sensor can measure.
        """
        depth = frame.depth
        assert depth is not None, "missing() says so first"
        known = depth[depth > 0]
        believed = (known >= self.config.nearest) & (known <= self.config.farthest)
        if known.size > 0.05 * depth.size and believed.mean() < 0.2:
            raise CalibrationError(
                f"depth: {100 * (1 - believed.mean()):.0f} % of the values lie outside "
                f"{self.config.nearest:g} to {self.config.farthest:g} m (median "
                f"{np.median(known):.3g} m): is the depth factor right? Else set depth.nearest "
                "and depth.farthest"
            )
