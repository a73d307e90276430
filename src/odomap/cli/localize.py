"""`odomap localize` and `odomap continue`: saved maps used again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

__all__ = ["Continue", "Localize"]

Overrides = Annotated[tuple[tuple[str, str], ...], tyro.conf.Suppress]


@dataclass(frozen=True)
class _WithMap:
    """What a run that begins with a map is told."""

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """A map file, or the output folder of `odomap run` with a map.odomap."""
    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """A recording by the cameras that the map was made with; see `odomap run --help`."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the outputs; default a new name in runs/."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """A preset; default the one for how the map was made."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A config file, read over the preset."""
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rig.yaml: which sensors there are and where they are mounted."""
    rhythm: Literal["inline", "lockstep", "live"] = "lockstep"
    """How stages follow each other; see `odomap run --help`."""
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Stop after this many frames."""
    quiet: bool = False
    """No progress."""
    overrides: Overrides = ()

    def _run(self, is_mapping: bool, default: str) -> int:
        from odomap.cli.run import folder_name, track
        from odomap.run import chosen_config
        from odomap.savedmap import SavedMap
        from odomap.sources.open import open as open_source

        chosen_config(self.preset, self.config, self.overrides)  # names are checked first
        saved = SavedMap.load(self.map)
        source = open_source(self.data, self.rig)
        preset = self.preset or saved.usual_preset(source.rig)
        config = chosen_config(preset, self.config, self.overrides, source.rig)
        out = self.out or Path("runs") / f"{folder_name(source.name)}_{default}"
        command: dict[str, object] = {"data": self.data, "preset": preset}
        command |= {"rig": str(self.rig)} if self.rig else {}
        return track(
            source,
            out,
            config,
            command,
            self.max_frames,
            self.quiet,
            self.rhythm,
            map=saved,
            is_mapping=is_mapping,
        )[0]


@dataclass(frozen=True)
class Localize(_WithMap):
    """Place the frames of a recording in a saved map, which stays as it is.

    Writes trajectory.tum, trajectory_live.tum, metrics.json, config.yaml and report.html; poses are
    in the world of the map. Any field that `odomap config` prints can be set as --section.field
    VALUE.
    """

    def execute(self) -> int:
        """Place the frames, write, and say where everything is."""
        return self._run(is_mapping=False, default="localized")


@dataclass(frozen=True)
class Continue(_WithMap):
    """Go on mapping where a saved map ended, with a new recording.

    Writes what `odomap run` writes: the map as it grew, and the path of the new recording in the
    world of the map. The file that was read stays as it is. Any field that `odomap config` prints
    can be set as --section.field VALUE.
    """

    def execute(self) -> int:
        """Find the first place, go on from there, write, and say where everything is."""
        return self._run(is_mapping=True, default="continued")
