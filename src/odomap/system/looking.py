"""Looking: a frame made ready to be tracked, which needs no map.

The image becomes that of an ideal pinhole, and its features are found. Not every frame shows
something: one may come late, without an image, or with that of the frame before.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.sensors.frame import Frame
from odomap.system.association import Association, View
from odomap.system.clock import Clock
from odomap.system.eye import Eye
from odomap.system.locating import Located
from odomap.vision.coverage import coverage

__all__ = ["Look", "Looker", "Unseen", "doubt"]

BLANK = 8.0
"""Standard deviation of grey levels below which an image shows nothing."""


@dataclass(frozen=True, eq=False)
class Look:
    """A frame being tracked: its ideal view, and the clock."""

    frame: Frame
    view: View
    clock: Clock


@dataclass(frozen=True, eq=False)
class Unseen:
    """A frame that shows nothing to be tracked, and why."""

    frame: Frame
    reason: str
    clock: Clock


class Looker:
    """Makes frames ready.

    Args:
        eye: the camera.
        association: finds the features of an image.
    """

    def __init__(self, eye: Eye, association: Association) -> None:
        self._eye, self._association = eye, association
        self._raw: NDArray[np.uint8] | None = None
        self._newest_ns = -1

    def look(self, frame: Frame, is_begun: bool) -> Look | Unseen:
        """Find the features of a frame.

        Args:
            frame: the next one in time.
            is_begun: whether tracking goes on, so that images must change; before, a camera may
                wait.

        Raises:
            CalibrationError: the image has another size than the calibration.
        """
        clock = Clock()
        if frame.stamp_ns <= self._newest_ns:
            return Unseen(frame, "its time is not after that of the frame before", clock)
        self._newest_ns = frame.stamp_ns
        image = self._eye.image(frame)
        if image is None:
            return Unseen(frame, f"the {self._eye.name} image is missing", clock)
        if self._is_frozen(frame) and is_begun:
            return Unseen(frame, "the image is the one before, bit by bit: frozen?", clock)
        look = Look(frame, self._association.view(frame.id, frame.stamp_ns, image), clock)
        clock.lap("prepare")
        return look

    def _is_frozen(self, frame: Frame) -> bool:
        """Say whether a frame shows the very same image as the one before, though it is no blank.

        Even of a camera that stands still no two images are equal: there is noise.
        """
        before, self._raw = self._raw, frame.images[self._eye.index]
        if before is None or self._raw is None:
            return False
        return np.array_equal(before, self._raw) and float(before.std()) > BLANK


def doubt(located: Located, needed: int, coverage_needed: float, view: View, camera: Camera) -> str:
    """Say in a sentence why a pose is not to be believed; empty if it is.

    Args:
        located: the pose, and which observations agree with it.
        needed: how many must.
        coverage_needed: part of the image that they must be spread over.
        view: what it was found in.
        camera: the pinhole of the view.
    """
    if located.num_inliers >= needed:
        covered = coverage(located.pixels[located.inliers], camera)
        if covered >= coverage_needed:
            return ""
        return (
            f"what agrees covers {100 * covered:.1f} % of the image, "
            f"{100 * coverage_needed:.1f} % needed: something before the lens?"
        )
    contrast = float(view.pyramid[-1].std())
    if contrast < BLANK:
        cause = (
            f"the image is nearly uniform (contrast {contrast:.0f} of 255): covered lens, no light?"
        )
    elif not located.expected:
        cause = "none of the landmarks is where the camera is expected to look"
    elif len(located.rows) < needed:
        again = f"{len(located.rows)} of {located.expected} landmarks found again"
        cause = f"{again}: motion blur or too fast?"
    else:
        cause = "what was found does not fit one motion: moving objects or a wrong calibration?"
    return f"{located.num_inliers} inliers of {needed} needed: {cause}"
