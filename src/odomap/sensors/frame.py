"""Frames: what the sensors said at one instant, never changed afterwards."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Frame", "ImuSamples"]


@dataclass(frozen=True)
class ImuSamples:
    """Inertial samples in the IMU frame.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing.
        gyro: (N, 3) angular rates, rad/s.
        accel: (N, 3) specific forces, m/s² (gravity included: at rest +9.81 upwards).
    """

    stamps_ns: NDArray[np.int64]
    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class Frame:
    """All that the sensors of a rig said at one instant.

    Attributes:
        id: running number within its source, from 0; gaps mean skipped frames.
        stamp_ns: time, integer nanoseconds.
        images: one entry per camera of the rig, in its order: (H, W) uint8, or None if missing.
        depth: (H, W) float32 metres registered to the rig's depth camera, 0 where unknown.
        scan: 2D scan: (N,) float64 ranges in metres, NaN where invalid, inf where nothing returned.
        cloud: 3D sweep: (N, 4) float64 x, y, z in the LiDAR frame and seconds since `stamp_ns`.
        imu: the samples after the previous frame, up to and including this one's stamp.
    """

    id: int
    stamp_ns: int
    images: tuple[NDArray[np.uint8] | None, ...] = ()
    depth: NDArray[np.float32] | None = None
    scan: NDArray[np.float64] | None = None
    cloud: NDArray[np.float64] | None = None
    imu: ImuSamples | None = None

    @property
    def stamp(self) -> float:
        """Time in seconds, for people and files."""
        return self.stamp_ns * 1e-9

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Yield the arrays of this frame (for counting bytes, or freezing them)."""
        yield from (image for image in self.images if image is not None)
        yield from (a for a in (self.depth, self.scan, self.cloud) if a is not None)
