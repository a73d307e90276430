"""A system: the stages of a run over one map, and the worker that plays them.

    frame → Tracker.track → Estimate → caller;  keyframe → Mapper, Closer → map;  finish → Result

Who tracks, maps and closes depends on the sensors and on whether a map is kept; what is asked of
the whole does not. Here is what all have in common, and what a run leaves.

Reference: Klein, Murray, "Parallel Tracking and Mapping for Small AR Workspaces", ISMAR 2007.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Estimate
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.background import ThreadConfig
from odomap.system.path import Path
from odomap.system.rhythms import make_worker
from odomap.system.stages import Loop, Stages

__all__ = ["Result", "System"]


@dataclass(frozen=True)
class Result:
    """What a run leaves.

    Attributes:
        trajectory: T_world_body of all placed frames as known at the end, with covariances.
        trajectory_live: the frames that could be placed when they came, as they were emitted.
        keyframes: the keyframes among the frames, as known at the end.
        map: keyframes and landmarks.
        is_metric: whether lengths are metres; if not, their unit is the run's own.
        T_body_tracked: (4, 4) where on the body that is what the poses are of: the identity, or
            the mount of a single camera, whose path without a scale cannot carry the lever arm.
        mapping: what local mapping did, counts by name; empty for odometry.
        loops: places that were taken for ones seen before, accepted or not, in order.
    """

    trajectory: Trajectory
    trajectory_live: Trajectory
    keyframes: Trajectory
    map: Map
    is_metric: bool = True
    T_body_tracked: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    mapping: Mapping[str, int] = field(default_factory=dict)
    loops: tuple[Loop, ...] = ()

    def truth(self, truth: Trajectory) -> Trajectory:
        """Return a ground truth of the body as one of what was tracked."""
        return Trajectory(truth.stamps_ns, truth.Ts_world_body @ self.T_body_tracked)


class System(ABC):
    """What odometry and SLAM with any sensors have in common.

    Attributes:
        map: keyframes and what they saw.
        worker: runs the stages; its lists of observers are told of estimates and keyframes.
    """

    def __init__(self, threads: ThreadConfig, rhythm: str, map: Map | None = None) -> None:
        self.map = Map() if map is None else map
        self.worker = make_worker(rhythm, self._make_stages(), threads)
        self._loops: list[Loop] = []
        self.worker.on_loop.append(self._loops.append)

    @abstractmethod
    def _make_stages(self) -> Stages:
        """Make the agents that share the map."""

    @property
    @abstractmethod
    def _path(self) -> Path:
        """The frames placed so far."""

    def track(self, frame: Frame) -> Estimate:
        """Place one frame.

        Args:
            frame: the next one in time.

        Returns:
            Where the body is, how sure that is, and why not if it is lost.

        Raises:
            CalibrationError: what the frame holds cannot be what the rig says.
            KeyboardInterrupt: Ctrl-C was pressed meanwhile; the frame is done all the same.
        """
        return self.worker.track(frame)

    def finish(self) -> Result:
        """Return the path as known at the end; tracking may go on afterwards."""
        self.worker.finish()
        self._come_to_rest()
        return Result(
            self._path.trajectory(),
            self._path.trajectory_live(),
            self._path.keyframes(),
            self.map,
            self._is_metric,
            self._T_body_tracked,
            self._counts(),
            tuple(self._loops),
        )

    def _come_to_rest(self) -> None:
        """Do what is left when nobody changes the map any more."""
        return

    def _counts(self) -> Mapping[str, int]:
        """Return what the mapper did, by name."""
        return {}

    @property
    def _is_metric(self) -> bool:
        """Whether lengths are metres."""
        return True

    @property
    def _T_body_tracked(self) -> NDArray[np.float64]:
        """(4, 4) where on the body that is what poses are of."""
        return np.eye(4)
