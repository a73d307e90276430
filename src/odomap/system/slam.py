"""SLAM: simultaneous localisation and mapping with whatever sensors a rig carries.

    system = Slam(source.rig)
    for frame in source:
        estimate = system.track(frame)
    result = system.finish()
    odomap.save_map("home.odomap", result.map, source.rig)

What the configuration says of the sensors decides which system it is: that of cameras
(`visualslam`), of a 2D laser (`laserslam`) or of a 3D LiDAR (`cloudslam`). What they share is in
`system`.
"""

from typing import TYPE_CHECKING, Any

from odomap.maps.map import Map
from odomap.sensors.rig import Rig
from odomap.system.config import LASER, LIDAR, Config, preset, preset_for
from odomap.system.system import System

if TYPE_CHECKING:
    from odomap.system.path import Path
    from odomap.system.stages import Stages
    from odomap.vision.vocabulary import VocabularyTree

__all__ = ["Slam"]


class Slam(System):
    """Simultaneous localisation and mapping with the sensors of a rig.

    Args:
        rig: one camera, a stereo pair, a camera with depth, a 2D laser, or a 3D LiDAR.
        config: sections for all parts; default the preset for what the rig carries.
        rhythm: which thread runs what; see `rhythms`.
        map: a map to go on with; default a new one.
        is_mapping: whether the map is changed; if not, frames are only placed in it.
        vocabulary: makes the words by which cameras recognise places; default that which the
            configuration names (`places.vocabulary`). A map holds no words: one made with another
            vocabulary gets them anew.

    Attributes:
        map: keyframes, and landmarks of cameras.
        worker: runs the stages; its lists of observers are told of estimates, keyframes and loops.

    Raises:
        CalibrationError: the rig does not carry what the configuration says.
        ConfigError: there is no such rhythm.
        InputError: the vocabulary that the configuration names cannot be used.
    """

    if TYPE_CHECKING:  # what it makes is one of its kinds

        def __init__(
            self,
            rig: Rig,
            config: Config | None = None,
            rhythm: str = "inline",
            map: Map | None = None,
            is_mapping: bool = True,
            vocabulary: VocabularyTree | None = None,
        ) -> None: ...

        def _make_stages(self) -> Stages: ...

        @property
        def _path(self) -> Path: ...

    def __new__(cls, rig: Rig, config: Config | None = None, *args: Any, **kwargs: Any) -> System:  # type: ignore[misc]
        """Return the system for the sensors that the configuration says."""
        chosen = preset(preset_for(rig)) if config is None else config
        if chosen.tracking.sensors == LASER:
            from odomap.system.laserslam import LaserSlam

            return LaserSlam(rig, chosen, *args, **kwargs)
        if chosen.tracking.sensors == LIDAR:
            from odomap.system.cloudslam import CloudSlam

            return CloudSlam(rig, chosen, *args, **kwargs)
        from odomap.system.visualslam import VisualSlam

        return VisualSlam(rig, chosen, *args, **kwargs)
