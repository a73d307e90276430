"""Estimates: what a tracker says about one frame."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.pose import SE3

__all__ = ["Estimate", "Status", "Tracks"]


class Status(StrEnum):
    """How a frame was placed."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
    RECOVERED = "recovered"
    LOST = "lost"


@dataclass(frozen=True)
class Tracks:
    """Image points behind one estimate, for drawing.

    Attributes:
        keypoints: (N, 2) float32, raw image pixels of the reference camera, this frame.
        previous: (N, 2) float32, the same points in the frame they were tracked from.
        inlier: (N,) bool, whether the pose agrees with them.
    """

    keypoints: NDArray[np.float32]
    previous: NDArray[np.float32]
    inlier: NDArray[np.bool_]


@dataclass(frozen=True)
class Estimate:
    """Where the body was at one frame, how sure that is, and why.

    Attributes:
        frame_id: id of the frame.
        stamp_ns: its time, integer nanoseconds.
        status: how it was placed; when lost, the poses hold the last one known.
        reason: a sentence a person can act on; empty when there is nothing to say.
        keyframe_id: the keyframe the pose hangs from, -1 before there is one.
        T_keyframe_body: pose relative to that keyframe, in its units.
        T_world_body: pose in the world as known when the frame was tracked; when lost, where it was
            last known to be, which is no measurement: look at the status before drawing it.
        covariance: (6, 6) of T_world_body, tangent (translation, rotation), right update,
            metres and radians; relative to the first pose, which is exact.
        num_inliers: observations that agree with the pose.
        is_keyframe: whether the frame becomes a keyframe, which observers are told of when it is
            made; but for the very first, its pose hangs from the one before as that of any frame.
        timing: milliseconds per stage that this estimate had to wait for.
        tracks: the image points behind it.
    """

    frame_id: int
    stamp_ns: int
    status: Status
    reason: str
    keyframe_id: int
    T_keyframe_body: SE3
    T_world_body: SE3
    covariance: NDArray[np.float64]
    num_inliers: int = 0
    is_keyframe: bool = False
    timing: Mapping[str, float] = field(default_factory=dict)
    tracks: Tracks | None = None

    @property
    def stamp(self) -> float:
        """Time in seconds, for people and files."""
        return self.stamp_ns * 1e-9
