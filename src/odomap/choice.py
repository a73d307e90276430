"""Which system a run is made with: SLAM, SLAM in a map that is there, or odometry.

What a run was told about it belongs together: it decides the usual preset, what has to fit, what
config.yaml says, and what is made in the end.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from odomap.errors import CalibrationError, InputError

if TYPE_CHECKING:
    from odomap.savedmap import SavedMap
    from odomap.sensors.rig import Rig
    from odomap.system.config import Config
    from odomap.system.system import System

__all__ = ["SystemChoice"]


@dataclass(frozen=True, eq=False)
class SystemChoice:
    """What was asked for.

    Attributes:
        rhythm: how stages follow each other.
        saved: a map to begin with; None for a new one.
        is_mapping: whether the map is changed.
        odometry_only: whether no map is kept at all.

    Raises:
        InputError: the two exclude each other.
        ConfigError: there is no such rhythm.
    """

    rhythm: str
    saved: "SavedMap | None" = None
    is_mapping: bool = True
    odometry_only: bool = False

    def __post_init__(self) -> None:
        from odomap.system.rhythms import check_rhythm

        check_rhythm(self.rhythm)
        if self.odometry_only and self.saved is not None:
            raise InputError(f"{self.saved.name}: odometry keeps no map, and cannot go on with one")

    def usual_preset(self, rig: "Rig") -> str | None:
        """Return the preset to take where nobody says; None for the one of the rig."""
        from odomap.system.config import odometry_preset

        if self.saved is not None:
            return self.saved.usual_preset(rig)
        return odometry_preset(rig) if self.odometry_only else None

    def check(self, rig: "Rig", settings: "Config") -> None:
        """Make sure that the map, if there is one, fits.

        Raises:
            InputError: it was made with other cameras, or knows no places; or the vocabulary by
                which places are to be recognised cannot be used.
        """
        if settings.places.vocabulary:
            from odomap.files.vocabulary import Vocabulary

            Vocabulary.load(settings.places.vocabulary)
        if self.saved is not None:
            self.saved.check(rig, settings)

    def notes(self, settings: "Config") -> list[str]:
        """Return what is worth knowing about how the map is used, one sentence each."""
        return [] if self.saved is None else self.saved.notes(settings)

    def head(self) -> dict[str, object]:
        """Return what the head of config.yaml says."""
        said: dict[str, object] = {"rhythm": self.rhythm}
        if self.odometry_only:
            said["odometry_only"] = True
        if self.saved is not None:
            said |= {"map": self.saved.name, "is_mapping": self.is_mapping}
        return said

    def make(self, rig: "Rig", settings: "Config", data: object) -> "System":
        """Make the system.

        Args:
            rig: what the recording carries.
            settings: sections for all parts.
            data: the recording, for people.

        Raises:
            CalibrationError: the rig does not carry what the settings ask for.
        """
        from odomap.system.config import LASER, LIDAR
        from odomap.system.slam import Slam

        if settings.tracking.sensors not in (LASER, LIDAR):
            import cv2

            # The stages use the cores themselves; OpenCV's own threads would only be in their way.
            cv2.setNumThreads(1)
        try:
            if self.odometry_only:
                from odomap.system.odometry import make_odometry

                return make_odometry(rig, settings, self.rhythm)
            begun = None if self.saved is None else self.saved.map
            return Slam(rig, settings, self.rhythm, begun, self.is_mapping)
        except CalibrationError as error:
            raise CalibrationError(f"{data}: {error}") from error
