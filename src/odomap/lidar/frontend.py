"""What every front-end of a 3D LiDAR does: makes sweeps ready, lays them onto its map.

    prepare   thins it out, finds edges, planes, ground: what needs no map
    match     finds where the body was at the stamp, from a guess and the motion over the sweep
    insert    adds it to a map of what was seen around, and forgets what is far

The map is the front-end's own, made of what it matches with, in the frame that odometry counts
from; loops never move it, since poses of keyframes are kept apart from it (`maps/map`).

Reference: C. Cadena et al., "Past, present, and future of simultaneous localization and mapping",
IEEE Trans. Robotics 32(6), 2016 (front-end and back-end).
"""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.lidar.sweeps import SweepPoints

__all__ = ["FrontEnd", "SweepMatch"]

Array = NDArray[np.float64]
P = TypeVar("P")


@dataclass(frozen=True, eq=False)
class SweepMatch:
    """How a sweep lies in a front-end's map.

    Attributes:
        T_map_body: (4, 4) of the body at the stamp.
        information: (6, 6) inverse covariance of a right update, zero where walls say nothing.
        num_inliers: points that lie on something known.
        num_points: that were looked at.
        error: root mean square distance of the inliers from what they lie on, metres.
        converged: whether the steps became small.
        reason: what is wrong; empty if nothing is.
        stays: (6, 6) what of an error of the sweep the map keeps, as it is seen from then on; None
            where nobody knows.
        bends: (6, 6) how far the body is off per change of the twist from sweep to sweep; None
            where nobody knows.
    """

    T_map_body: Array
    information: Array
    num_inliers: int
    num_points: int
    error: float
    converged: bool
    reason: str = ""
    stays: Array | None = None
    bends: Array | None = None

    @property
    def share(self) -> float:
        """Inliers as a share of the points."""
        return self.num_inliers / max(self.num_points, 1)


class FrontEnd(Protocol[P]):
    """Lays sweeps onto those before."""

    def prepare(self, sweep: SweepPoints) -> P:
        """Make a sweep ready without looking at the map."""
        ...

    def match(
        self, prepared: P, T_map_body: Array, twist: Array, again: bool = False
    ) -> SweepMatch:
        """Find where a sweep was taken.

        Args:
            prepared: the sweep.
            T_map_body: (4, 4) first guess of the body at the stamp.
            twist: (6,) how the body moves over the sweep, per second.
            again: whether the guess is what a match of this sweep found, with another motion: then
                it is near, and what is found is to be exact.
        """
        ...

    def insert(self, prepared: P, T_map_body: Array, twist: Array) -> None:
        """Add a sweep to the map, and forget what is far from it."""
        ...

    def seed(self, points: Array) -> None:
        """Add points (N, 3) of another map, in the frame of this one."""
        ...

    def clear(self) -> None:
        """Forget the map."""
        ...
