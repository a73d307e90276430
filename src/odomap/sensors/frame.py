"""Frames: what the sensors said at one instant, never changed afterwards.

A frame carries raw measurements only. Cameras of one frame are taken to be exposed together; the
inertial samples belong to the interval that the frame closes,

    stamp(previous frame) < stamps_ns <= stamp(this frame),

so that the samples of consecutive frames, put one after the other, are the whole stream: what
preintegration needs, and what stays true when a frame between is left out.

Reference: C. Forster et al., "On-manifold preintegration for real-time visual-inertial odometry",
IEEE Trans. Robotics 33(1), 2017.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.sensors.sweep import Sweep

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

    def __post_init__(self) -> None:
        count = len(self.stamps_ns)
        if self.gyro.shape != (count, 3) or self.accel.shape != (count, 3):
            raise ValueError(
                f"{count} stamps need gyro and accel of shape ({count}, 3), "
                f"got {self.gyro.shape} and {self.accel.shape}"
            )
        if np.any(self.stamps_ns[1:] <= self.stamps_ns[:-1]):
            raise ValueError("stamps of inertial samples must increase strictly")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def between(self, after_ns: int | None, until_ns: int) -> "ImuSamples":
        """Return the samples after one stamp, up to and including another (views, no copies).

        Args:
            after_ns: excluded lower end, None for the beginning.
            until_ns: included upper end.
        """
        start = 0
        if after_ns is not None:
            start = int(np.searchsorted(self.stamps_ns, after_ns, side="right"))
        stop = max(start, int(np.searchsorted(self.stamps_ns, until_ns, side="right")))
        return ImuSamples(self.stamps_ns[start:stop], self.gyro[start:stop], self.accel[start:stop])

    @staticmethod
    def joined(parts: "Sequence[ImuSamples]") -> "ImuSamples":
        """Put consecutive pieces of one stream together."""
        if not parts:
            return ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        return ImuSamples(
            np.concatenate([part.stamps_ns for part in parts]),
            np.concatenate([part.gyro for part in parts]),
            np.concatenate([part.accel for part in parts]),
        )


@dataclass(frozen=True)
class Frame:
    """All that the sensors of a rig said at one instant.

    Attributes:
        id: running number within its source, from 0; gaps mean skipped frames.
        stamp_ns: time, integer nanoseconds.
        images: one entry per camera of the rig, in its order: (H, W) uint8, or None if missing.
        depth: (H, W) float32 metres registered to the rig's depth camera, 0 where unknown.
        scan: 2D scan: (N,) float64 ranges in metres, NaN where invalid, inf where nothing returned.
        cloud: 3D sweep, of points each at its own moment.
        imu: the samples after the previous frame, up to and including this one's stamp.
        odometry: (4, 4) T_odom_body by the wheels' own reckoning at this stamp; it drifts, so only
            steps from frame to frame mean something. None where no wheels are read.
    """

    id: int
    stamp_ns: int
    images: tuple[NDArray[np.uint8] | None, ...] = ()
    depth: NDArray[np.float32] | None = None
    scan: NDArray[np.float64] | None = None
    cloud: Sweep | None = None
    imu: ImuSamples | None = None
    odometry: NDArray[np.float64] | None = None

    @property
    def stamp(self) -> float:
        """Time in seconds, for people and files."""
        return self.stamp_ns * 1e-9

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Yield the arrays of this frame (for counting bytes, or freezing them)."""
        yield from (image for image in self.images if image is not None)
        yield from (a for a in (self.depth, self.scan, self.odometry) if a is not None)
        if self.cloud is not None:
            yield from self.cloud.arrays()
        if self.imu is not None:
            yield from (self.imu.stamps_ns, self.imu.gyro, self.imu.accel)
