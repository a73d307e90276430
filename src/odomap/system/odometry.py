"""Visual odometry: the path of a stereo pair, a single camera, or a camera with depth.

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

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, ConfigError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import Rig
from odomap.system.association import Association, FeatureAssociation, FlowAssociation
from odomap.system.config import Config, preset
from odomap.system.keyframetracking import KeyframeTracker
from odomap.system.keyframing import Keyframes
from odomap.system.mapping import WindowMapper
from odomap.system.path import Path
from odomap.system.stages import Stages
from odomap.system.starting import make_start
from odomap.system.system import Result
from odomap.system.visual import Sight, VisualSystem

__all__ = ["MonocularVO", "Odometry", "Result", "RgbdVO", "StereoVO", "make_odometry"]


class Odometry(VisualSystem):
    """What the odometries of all cameras have in common: frames against the last keyframe.

    Attributes:
        map: keyframes and landmarks of the last stretch of the way.
        worker: runs the stages; its lists of observers are told of estimates and keyframes.
    """

    def _stages(self, sight: Sight, config: Config) -> Stages:
        eye, ranger = sight.eye, sight.ranger
        association = _association(config, eye.mask)
        bias = sight.depth_bias(config.noise)
        keyframes = Keyframes(self.map, eye, ranger, bias, association, config)
        start = make_start(self.map, eye, keyframes, association, config)
        self._tracker = KeyframeTracker(self.map, eye, association, keyframes, start, config)
        depth = (1.0, 0.0) if ranger is None else (ranger.sigma, ranger.calibration)
        mapper = WindowMapper(
            self.map,
            eye.T_body_camera,
            eye.camera,
            config.window,
            config.bundle,
            config.noise,
            bias,
            *depth,
        )
        return Stages(self.map, self._tracker, mapper)

    @property
    def _path(self) -> Path:
        return self._tracker.path


class StereoVO(Odometry):
    """Visual odometry of a stereo pair: metric.

    Args:
        rig: with two cameras.
        config: sections for all parts; default the preset "stereo-flow".
        rhythm: which thread runs what; see `rhythms`.

    Raises:
        CalibrationError: if the rig has no plausible stereo pair.
        ConfigError: if there is no such rhythm.
    """

    def __init__(self, rig: Rig, config: Config | None = None, rhythm: str = "inline") -> None:
        config = preset("stereo-flow") if config is None else config
        super().__init__(Sight.of_pair(rig, config), config, rhythm)


class MonocularVO(Odometry):
    """Visual odometry of a single camera: the camera is the body, the scale is free but constant.

    Poses are in units of the scene's median depth at the start. Frames before the second view have
    no pose when they come, and get one when tracking has started.

    Args:
        camera: its lens; the first image of a frame is looked at.
        config: sections for all parts; default the preset "mono-flow".
        rhythm: which thread runs what; see `rhythms`.
        T_body_camera: its mount on a rig, which a result tells; poses are the camera's anyway.

    Raises:
        ConfigError: if there is no such rhythm, or the configuration does not follow candidates.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        rhythm: str = "inline",
        T_body_camera: SE3 | None = None,
    ) -> None:
        config = preset("mono-flow") if config is None else config
        if not config.candidates.follow:
            raise ConfigError(
                "candidates.follow: false, but a single camera gets its landmarks that way alone: "
                "set it true, or take the preset mono-flow"
            )
        super().__init__(Sight.of_camera(camera, T_body_camera), config, rhythm)


class RgbdVO(Odometry):
    """Visual odometry of a camera with a registered depth image: metric.

    Args:
        rig: with a camera and a depth image.
        config: sections for all parts; default the preset "rgbd-flow".
        rhythm: which thread runs what; see `rhythms`.

    Raises:
        CalibrationError: if the rig has no depth image.
        ConfigError: if there is no such rhythm.
    """

    def __init__(self, rig: Rig, config: Config | None = None, rhythm: str = "inline") -> None:
        config = preset("rgbd-flow") if config is None else config
        super().__init__(Sight.of_depth(rig, config), config, rhythm)


def make_odometry(rig: Rig, config: Config, rhythm: str = "inline") -> Odometry:
    """Return the odometry that a configuration asks for.

    Args:
        rig: what there is.
        config: `tracking.sensors` says which of it is used.
        rhythm: which thread runs what; see `rhythms`.

    Raises:
        CalibrationError: the rig does not carry that.
    """
    if config.tracking.sensors == "stereo":
        return StereoVO(rig, config, rhythm)
    if config.tracking.sensors == "rgbd":
        return RgbdVO(rig, config, rhythm)
    if not rig.cameras:
        raise CalibrationError("this rig has no camera: monocular odometry needs one")
    mount = rig.cameras[0]
    return MonocularVO(mount.camera, config, rhythm, mount.T_body_camera)


def _association(config: Config, mask: NDArray[np.bool_]) -> Association:
    """Return how points are found again; odometry keeps no map that they would be described for."""
    if config.tracking.association == "flow":
        return FlowAssociation(config.features, config.flow, mask)
    return FeatureAssociation.of_detector(config.features, config.matching, mask)
