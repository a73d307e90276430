"""Stereo visual odometry: the metric path of a pair of cameras.

Two stages share a map: the tracker places every frame against the last keyframe (`tracking`), the
mapper adjusts the window of the last keyframes whenever there is a new one (`mapping`). What is
remembered hangs from keyframes, so an adjusted window moves the frames that hang from it.

    vo = StereoVO(source.rig)
    for frame in source:
        estimate = vo.track(frame)
    vo.finish().trajectory

Cost: flow of some 300 points per frame; detection, stereo and one bundle adjustment per keyframe.

Reference: Nistér, Naroditsky, Bergen, "Visual Odometry", CVPR 2004.
"""

from dataclasses import dataclass

from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Estimate
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.config import Config
from odomap.system.mapping import WindowMapper
from odomap.system.stages import Stages
from odomap.system.tracking import StereoTracker
from odomap.system.worker import make_worker
from odomap.vision.rectifier import Rectifier

__all__ = ["Result", "StereoVO"]


@dataclass(frozen=True)
class Result:
    """What a run leaves.

    Attributes:
        trajectory: T_world_body of all placed frames as known at the end, with covariances.
        trajectory_live: the same frames as first emitted.
        map: keyframes and landmarks.
    """

    trajectory: Trajectory
    trajectory_live: Trajectory
    map: Map


class StereoVO:
    """Visual odometry of a stereo pair.

    Args:
        rig: with two cameras.
        config: sections for all parts; default the preset "stereo".
        rhythm: which thread runs what; see `worker`.

    Attributes:
        map: keyframes and landmarks.
        worker: runs the stages; its lists of observers are told of estimates and keyframes.

    Raises:
        CalibrationError: if the rig has no plausible stereo pair.
        ConfigError: if there is no such rhythm.
    """

    def __init__(self, rig: Rig, config: Config | None = None, rhythm: str = "inline") -> None:
        config = Config() if config is None else config
        rectifier = Rectifier(rig)
        self.map = Map()
        self._tracker = StereoTracker(rig, config, self.map, rectifier)
        mapper = WindowMapper(
            self.map,
            rectifier.T_body_camera,
            rectifier.camera,
            rectifier.baseline,
            config.window,
            config.bundle,
            config.noise,
        )
        self.worker = make_worker(rhythm, Stages(self.map, self._tracker, mapper))

    def track(self, frame: Frame) -> Estimate:
        """Place one frame.

        Args:
            frame: the next one in time, with both images.

        Returns:
            Where the body is, how sure that is, and why not if it is lost.

        Raises:
            CalibrationError: if left and right turn out to be swapped.
            KeyboardInterrupt: Ctrl-C was pressed meanwhile; the frame is done all the same.
        """
        return self.worker.track(frame)

    def finish(self) -> Result:
        """Return the path as known at the end; tracking may go on afterwards."""
        self.worker.finish()
        path = self._tracker.path
        return Result(path.trajectory(), path.trajectory_live(), self.map)
