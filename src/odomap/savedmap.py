"""Saved maps as places to start from: loaded, and compared with who wants to use them.

A map knows places by landmarks with descriptors, in the pixels of one ideal camera. Frames of
another camera, or of the same one looked through in another way, would be placed wrongly without a
word, so a map is refused unless the cameras are those that it was made with. What made a map
stands in its file: the rig, and as `sensors` which of its cameras were looked through.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from odomap.errors import InputError
from odomap.files.mapfile import MapFile
from odomap.maps.map import Map
from odomap.sensors.rig import CameraMount, Rig

if TYPE_CHECKING:
    from odomap.system.config import Config
    from odomap.system.eye import Eye

__all__ = ["SavedMap", "map_file", "map_settings", "rig_differences"]

KINDS = {
    "stereo": "a stereo pair",
    "rgbd": "a camera with depth",
    "mono": "one camera",
    "lidar2d": "a 2D laser",
    "lidar": "a 3D LiDAR",
}
"""What `tracking.sensors` says, in words."""

FILE = "map.odomap"
"""Name of the map in the folder of a run."""


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map, and what is said about how it was made.

    Attributes:
        name: the file, for people.
        map: what is remembered.
        rig: the sensors it was made with; None where that is not said.
        sensors: stereo, rgbd or mono; empty where that is not said.
        vocabulary: by which its places were recognised; empty for that of odomap, None where that
            is not said.
    """

    name: str
    map: Map
    rig: Rig | None = None
    sensors: str = ""
    vocabulary: str | None = None

    @classmethod
    def load(cls, path: str | Path) -> "SavedMap":
        """Load a map file.

        Args:
            path: the file, or the folder of a run with one.

        Raises:
            InputError: it is not there, or broken.
        """
        with MapFile(map_file(path)) as file:
            said = file.settings.get("sensors")
            sensors = said if isinstance(said, str) and said in KINDS else ""
            words = file.settings.get("vocabulary")
            words = words if isinstance(words, str) else None
            return cls(str(file.path), file.map(), file.rig, sensors, words)

    @classmethod
    def of(cls, map: "SavedMap | Map | str | Path") -> "SavedMap":
        """Return what is known of a map, from a file, or as a program has it."""
        if isinstance(map, SavedMap):
            return map
        return cls("map", map) if isinstance(map, Map) else cls.load(map)

    def usual_preset(self, rig: Rig) -> str:
        """Return the preset to use the map with where nobody says.

        Args:
            rig: what the recording carries.

        Raises:
            CalibrationError: there is no preset for the rig: it has no camera.
        """
        from odomap.system.config import preset_for

        return self.sensors or preset_for(rig)

    def check(self, rig: Rig, config: "Config") -> None:
        """Make sure that frames of a rig can be placed in the map.

        Raises:
            InputError: it holds no places, or was made with other cameras.
        """
        used = config.tracking.sensors
        if self.sensors and self.sensors != used:
            raise InputError(
                f"{self.name}: was made with {KINDS[self.sensors]}, not with {KINDS[used]}: "
                f"choose --preset {self.sensors}"
            )
        self._check_places(used)
        if self.rig is None:
            return
        for difference in rig_differences(self.rig, rig, used):
            raise InputError(
                f"{self.name}: was made with another rig: {difference}: give a recording of the "
                "same cameras, or their calibration with --rig"
            )

    def _check_places(self, sensors: str) -> None:
        """Make sure that something could be recognised in the map."""
        from odomap.system.recognition import describes_places

        of_lidars = {"lidar2d": "scan", "lidar": "cloud"}
        if sensors in of_lidars:
            kept = of_lidars[sensors]
            keyframes = (self.map.keyframe(k) for k in self.map.keyframe_ids)
            if not any(getattr(keyframe, kept) is not None for keyframe in keyframes):
                raise InputError(f"{self.name}: the map has no {kept}s: nothing could be localised")
            return
        if not self.map.num_landmarks:
            raise InputError(f"{self.name}: the map has no landmarks: nothing could be localised")
        if not describes_places(self.map):
            raise InputError(
                f"{self.name}: none of its landmarks has a descriptor, so no place in it can be "
                "recognised: make a map with `odomap run` without --odometry-only"
            )

    def notes(self, config: "Config") -> list[str]:
        """Return what is worth knowing where it is used otherwise than it was made."""
        words = config.places.vocabulary
        if self.vocabulary is None or self.vocabulary == words:
            return []
        there, here = (name or "the vocabulary of odomap" for name in (self.vocabulary, words))
        return [f"{self.name}: was made with {there}: its places are indexed anew with {here}"]

    def eye(self) -> "Eye":
        """Return the ideal camera whose pixels its features are in.

        Raises:
            InputError: the rig is not known.
            CalibrationError: the rig does not carry what the map says.
        """
        from odomap.system.config import preset, preset_for
        from odomap.system.visual import Sight

        if self.rig is None:
            raise InputError(
                f"{self.name}: does not say which cameras it was made with: give them with --rig"
            )
        return Sight.of(self.rig, preset(self.sensors or preset_for(self.rig))).eye


def map_file(path: str | Path) -> Path:
    """Return the map file of a path, which may be the folder of a run.

    Raises:
        InputError: the folder has none.
    """
    file = Path(path)
    if not file.is_dir():
        return file
    if not (file / FILE).exists():
        raise InputError(f"{file}: has no {FILE}: give a map file")
    return file / FILE


def map_settings(config: "Config") -> dict[str, Any]:
    """Return what a map file should say about how it was made."""
    return {"sensors": config.tracking.sensors, "vocabulary": config.places.vocabulary}


def rig_differences(there: Rig, here: Rig, sensors: str) -> Iterator[str]:
    """Yield in what the cameras that are looked through differ, in words.

    Args:
        there: the rig of a map.
        here: the rig of a recording.
        sensors: stereo, rgbd or mono.
    """
    if sensors == "lidar":
        return  # any LiDAR sees the same surfaces
    if sensors == "lidar2d":
        yield from _lasers(there, here)
        return
    if sensors == "rgbd" and here.depth is None:
        yield "a depth image there, none here"
    theirs, ours = _used(there, sensors), _used(here, sensors)
    if len(theirs) != len(ours):
        yield f"{len(theirs)} cameras there, {len(ours)} here"
    if sensors == "stereo" and len(theirs) == len(ours) == 2:
        there_m, here_m = (_distance(*pair) for pair in (theirs, ours))
        if not np.isclose(there_m, here_m, rtol=1e-6, atol=1e-9):
            yield f"the baseline is {there_m:.6g} m there, {here_m:.6g} m here"
    for a, b in zip(theirs, ours):
        for name, x, y in _numbers(a, b, sensors):
            same = np.shape(x) == np.shape(y) and (
                x == y if isinstance(x, str) else np.allclose(x, y, rtol=1e-6, atol=1e-9)
            )
            if not same:
                yield f"camera {b.name}: {name} is {_text(x)} there, {_text(y)} here"


def _used(rig: Rig, sensors: str) -> tuple[CameraMount, ...]:
    """Return the cameras that are looked through."""
    if sensors == "rgbd" and rig.depth is not None:
        return (rig.camera(rig.depth.camera),)
    return rig.cameras[: 2 if sensors == "stereo" else 1]


def _distance(a: CameraMount, b: CameraMount) -> float:
    return float(np.linalg.norm(a.T_body_camera.t - b.T_body_camera.t))


def _numbers(a: CameraMount, b: CameraMount, sensors: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield what has to be the same of two cameras: a name and both values."""
    yield "the model", a.camera.model, b.camera.model
    for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion"):
        yield name, getattr(a.camera, name), getattr(b.camera, name)
    if sensors != "mono":  # a single camera is the body, wherever it is mounted
        yield "T_body_camera", a.T_body_camera.matrix, b.T_body_camera.matrix


def _text(value: Any) -> str:
    if isinstance(value, str | int):
        return str(value)
    return str(np.array(value).round(6).tolist()) if np.ndim(value) else f"{value:.9g}"


def _lasers(there: Rig, here: Rig) -> Iterator[str]:
    """Yield in what the 2D lasers differ whose scans are kept: scans are numbers, one per beam."""
    theirs, ours = (
        next((mount for mount in rig.lidars if mount.angles[2]), None) for rig in (there, here)
    )
    if theirs is None or ours is None:
        yield "a 2D laser there, none here" if ours is None else "no 2D laser there, one here"
    elif theirs.angles != ours.angles:
        words = [
            f"{m.angles[2]} beams from {np.degrees(m.angles[0]):.1f}° to "
            f"{np.degrees(m.angles[1]):.1f}°"
            for m in (theirs, ours)
        ]
        yield f"{words[0]} there, {words[1]} here"
