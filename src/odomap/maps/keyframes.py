"""Keyframes: what was measured at the instants worth keeping, without where.

A keyframe holds the data of one frame and never changes; its pose is a row of `States`. All
payloads are optional and may come together: features of a camera, a scan, a cloud, a finished
submap, the inertial samples since the keyframe before.

Reference: G. Klein, D. Murray, Parallel tracking and mapping for small AR workspaces, 2007.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from odomap.sensors.frame import ImuSamples

if TYPE_CHECKING:
    from odomap.vision.features import Features

__all__ = ["Keyframe"]


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame worth keeping; no pose inside.

    Attributes:
        id: number within its map, from `Map.new_keyframe_id`.
        stamp_ns: time, integer nanoseconds.
        features: image features of the reference camera.
        scan: (N,) ranges of a 2D scan, metres.
        cloud: (N, 3) or (N, 4) points of a 3D sweep, metres, as seen from where the LiDAR was at
            the stamp, and how strongly each returned.
        submap: a finished submap, frozen.
        imu: inertial samples since the keyframe before.
    """

    id: int
    stamp_ns: int
    features: "Features | None" = None
    scan: NDArray[np.float64] | None = None
    cloud: NDArray[np.float32] | None = None
    submap: object | None = None
    imu: ImuSamples | None = None

    @property
    def stamp(self) -> float:
        """Time in seconds, for people and files."""
        return self.stamp_ns * 1e-9

    def without_payload(self) -> "Keyframe":
        """Return the same keyframe with its id and stamp only."""
        return Keyframe(self.id, self.stamp_ns)
