"""Maps used again: frames placed in a saved map, and maps that go on where they ended.

    result = odomap.localize("runs/home/map.odomap", "evening")        # the map stays as it is
    result = odomap.continue_map("runs/home/map.odomap", "evening")    # and grows
    result.trajectory                                                  # in the world of the map

Either is a run (`odomap.run`) that begins with a map: nothing is known of where the first frame
was taken, so it is recognised among the map's places (`system.recognition`). Frames before that
are lost. Words of places are no part of a map: they are made anew by the vocabulary at hand, so
that a map made with another one needs nothing. The trajectory is that of the new recording alone,
in the world of the map, and its stamps may be earlier than those of the map, or the same.
"""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from odomap.run import RHYTHM, Progress, RunResult, run
from odomap.savedmap import SavedMap

if TYPE_CHECKING:
    from odomap.maps.map import Map
    from odomap.sensors.rig import Rig
    from odomap.sources.source import Source
    from odomap.system.config import Config

__all__ = ["continue_map", "localize"]


def localize(
    map: "str | Path | Map | SavedMap",
    data: "str | Path | Source",
    out: str | Path | None = None,
    *,
    preset: str | None = None,
    config: "Config | str | Path | None" = None,
    rig: "Rig | str | Path | None" = None,
    rhythm: str = RHYTHM,
    max_frames: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    origin: Mapping[str, object] | None = None,
) -> RunResult:
    """Place the frames of a recording in a map, which is not changed.

    Args:
        map: a map file, the folder of a run, or a map.
        data, out, config, rig, rhythm, max_frames, progress, origin: see `odomap.run`.
        preset: name of a preset; default the one for the cameras that the map was made with.

    Returns:
        Trajectories and metrics; `failure` says why no frame could be placed.

    Raises:
        InputError: the map is broken, holds no places or was made with other cameras; the recording
            or the config is wrong.
        OutputError: the folder cannot be written.
        Interrupted: Ctrl-C; the result so far is written and inside.

    Example:
        >>> result = localize("runs/home/map.odomap", "evening")  # doctest: +SKIP
        >>> result.metrics["localised"]  # doctest: +SKIP
        412
    """
    return run(
        data,
        out,
        preset=preset,
        config=config,
        rig=rig,
        rhythm=rhythm,
        max_frames=max_frames,
        progress=progress,
        origin=origin,
        map=map,
        is_mapping=False,
    )


def continue_map(
    map: "str | Path | Map | SavedMap",
    data: "str | Path | Source",
    out: str | Path | None = None,
    **options: Any,
) -> RunResult:
    """Go on mapping where a map ended, with a new recording.

    Args:
        map: a map file, the folder of a run, or a map, which grows then.
        data, out: see `odomap.run`; the folder gets the grown map.
        options: see `localize`.

    Returns:
        Trajectories and metrics of the new recording, and the grown map.

    Raises:
        InputError, OutputError, Interrupted: see `localize`.
    """
    return run(data, out, map=map, is_mapping=True, **options)


class _CallableModule(ModuleType):
    """Let `odomap.localize` be called, whether it is the function or this module."""

    def __call__(self, *args: Any, **kwargs: Any) -> RunResult:
        return localize(*args, **kwargs)


sys.modules[__name__].__class__ = _CallableModule
