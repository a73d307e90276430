"""A scan made ready to be tracked, which needs no map: points of its beams, or why there are none.

Not every frame has a scan, not every scan as many beams as the rig says, and of some nothing came
back.
"""

from dataclasses import dataclass

import numpy as np

from odomap.lidar.scans import Beams, ScanPoints
from odomap.sensors.frame import Frame
from odomap.system.clock import Clock

__all__ = ["ScanView", "view_scan"]


@dataclass(frozen=True, eq=False)
class ScanView:
    """A scan being tracked.

    Attributes:
        frame: with the scan.
        scan: its points; None where there is none that can be used.
        clock: of the frame.
        wrong: why it cannot be used; empty where it can, and where there is none.
    """

    frame: Frame
    scan: ScanPoints | None
    clock: Clock
    wrong: str = ""

    def says_nothing(self, min_hits: int) -> str:
        """Say why it says nothing; empty if as many beams as needed came back."""
        if self.scan is None:
            return self.wrong or "no scan"
        count = len(self.scan)
        if count >= min_hits:
            return ""
        return f"{count} of {self.scan.num_beams} beams came back within reach, {min_hits} needed"

    def is_like(self, before: "ScanView | None") -> bool:
        """Say whether it is the very scan of another: of two that are measured none are equal."""
        ours, theirs = self.frame.scan, None if before is None else before.frame.scan
        return ours is not None and theirs is not None and np.array_equal(ours, theirs, True)


def view_scan(frame: Frame, beams: Beams) -> ScanView:
    """Make a frame's scan ready."""
    clock, scan, wrong = Clock(), None, ""
    if frame.scan is not None and frame.scan.shape == (len(beams),):
        scan = beams.points(frame.scan)
    elif frame.scan is not None:
        wrong = f"a scan of {frame.scan.size} beams where the rig says {len(beams)}"
    clock.lap("points")
    return ScanView(frame, scan, clock, wrong)
