"""A sweep made ready to be tracked, which needs no map, and what a keyframe keeps of it.

Not every frame has a sweep, not every sweep points that returned; and where the points' times or
beams are not what the rig says, the mistake is in how the recording is read, and is said at once.

Reference: I. Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 8(2), 2023.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.lidar.deskew import deskew
from odomap.lidar.frontend import FrontEnd
from odomap.lidar.sweeps import SweepPoints, points_of
from odomap.lidar.voxels import first_in_voxels
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount
from odomap.system.clock import Clock
from odomap.system.cloudconfig import CloudTrackingConfig

__all__ = ["CloudView", "CloudViewer"]

Array = NDArray[np.float64]

LONG = 3.0
"""Turns that a sweep may last: more, and its times are in another unit."""
SHORT = 0.01
"""Turns that a sweep all around lasts at least; one that lasts not at all came at once."""
ALL_AROUND = 0.02
"""Share of the points that is in each quarter around then."""


@dataclass(frozen=True, eq=False)
class CloudView:
    """A sweep being tracked.

    Attributes:
        frame: with the sweep.
        points: what returned, with times since the middle of the sweep; None where there is none.
        middle: of the sweep, seconds since the stamp.
        prepared: as the front-end wants it.
        clock: of the frame.
        wrong: what cannot be as the rig says; empty if nothing.
    """

    frame: Frame
    points: SweepPoints | None
    prepared: Any
    clock: Clock
    middle: float = 0.0
    wrong: str = ""

    def __len__(self) -> int:
        return 0 if self.points is None else len(self.points)

    def says_nothing(self, min_points: int) -> str:
        """Say why it says nothing; empty if as many points as needed returned."""
        if self.points is None:
            return "no sweep"
        if len(self) >= min_points:
            return ""
        rows = self.points.num_rows
        return f"{len(self)} of {rows} points returned from within range, {min_points} needed"

    def is_like(self, before: "CloudView | None") -> bool:
        """Say whether it is the very sweep of another: of two that are measured none are equal."""
        ours, theirs = self.frame.cloud, None if before is None else before.frame.cloud
        if ours is None or theirs is None or len(ours) != len(theirs):
            return False
        return np.array_equal(ours.points, theirs.points, equal_nan=True)


class CloudViewer:
    """Makes sweeps ready.

    Args:
        mount: of the LiDAR.
        front_end: says what is to be prepared.
        config: how far points are used, and how thin keyframes keep them.

    Attributes:
        T_body_lidar: (4, 4) where the LiDAR is on the body.
    """

    def __init__(
        self, mount: LidarMount, front_end: FrontEnd[Any], config: CloudTrackingConfig
    ) -> None:
        self._mount, self._front_end, self._config = mount, front_end, config
        self.T_body_lidar = mount.T_body_lidar.matrix
        self._T_lidar_body = se3_inverse(self.T_body_lidar)

    def view(self, frame: Frame) -> CloudView:
        """Make a frame's sweep ready."""
        clock = Clock()
        if frame.cloud is None:
            return CloudView(frame, None, None, clock)
        points = points_of(frame.cloud, self._mount, self._config.farthest)
        if wrong := self._wrong(points):
            return CloudView(frame, points, None, clock, 0.0, wrong)
        if not len(points):
            return CloudView(frame, points, None, clock)
        middle = float(points.times.mean())
        points = replace(points, times=points.times - middle)
        prepared = self._front_end.prepare(points)
        clock.lap("points")
        return CloudView(frame, points, prepared, clock, middle)

    def _wrong(self, points: SweepPoints) -> str:
        """Say what of times and beams cannot be as the rig says."""
        mount = self._mount
        if not len(points):
            return ""
        highest = int(points.beams.max()) + 1
        if mount.beams and highest > mount.beams:
            return (
                f"lidar '{mount.name}': a point is of beam {highest}, the rig says that there are "
                f"{mount.beams}: mend 'beams' in a rig.yaml"
            )
        lasts, turn = float(np.ptp(points.times)), 1.0 / mount.rate_hz if mount.rate_hz else 0.0
        if turn and lasts > LONG * turn:
            return (
                f"lidar '{mount.name}': the times of a sweep's points lie {lasts:.3g} s apart, and "
                f"a turn takes {turn:.3g} s: are they in milliseconds, or nanoseconds?"
            )
        if 0.0 < lasts < SHORT * turn and _is_all_around(points.points):
            return (
                f"lidar '{mount.name}': the times of points all around lie {lasts:.3g} s apart, "
                f"and a turn takes {turn:.3g} s: are they in seconds?"
            )
        if not np.isfinite(points.times).all():
            return f"lidar '{mount.name}': times of points are not finite numbers"
        return ""

    def kept(self, view: CloudView, twist: Array) -> NDArray[np.float32]:
        """Return what a keyframe keeps of a sweep.

        Args:
            view: the sweep.
            twist: (6,) the motion over it, per second.

        Returns:
            (N, 4) x, y, z of one point per small voxel, as seen from where the LiDAR was at the
            stamp, and how strongly it returned.
        """
        points = view.points
        assert points is not None
        rows = first_in_voxels(points.points, self._config.keyframe_voxel)
        moved = deskew(points.points.take(rows, axis=0), points.times[rows] + view.middle, twist)
        T = self._T_lidar_body
        kept = np.empty((len(rows), 4), np.float32)
        kept[:, :3] = moved @ T[:3, :3].T + T[:3, 3]
        kept[:, 3] = points.intensities[rows]
        return kept


def _is_all_around(points: Array) -> bool:
    """Say whether points (N, 3) lie in each quarter around the body."""
    quarters = 2 * (points[:, 0] > 0.0) + (points[:, 1] > 0.0)
    counts = np.bincount(quarters, minlength=4)
    return bool(counts.min() > ALL_AROUND * len(points))
