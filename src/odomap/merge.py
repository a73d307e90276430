"""Two maps of one place made one, from files or as a program has them.

    merged = odomap.merge_maps("runs/morning", "runs/evening", "home.odomap")
    merged.num_places, merged.T_first_second, merged.map

Each map is in a world of its own. Places of the second are recognised among those of the first by
what they show, and measured; from these the second is brought to the first, in size, too, if they
were made with one camera, and landmarks that are the same become one; where depth was measured all
is adjusted together. Neither is changed. Maps that cannot be one are refused before anything is
compared: other cameras, no descriptors. Words of places are no part of a map: they are made anew,
whatever vocabulary it was made with.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, TrackingFailed
from odomap.files.atomic import find_obstacle, make_folder
from odomap.files.mapfile import save_map
from odomap.savedmap import KINDS, SavedMap, map_file, map_settings, rig_differences

if TYPE_CHECKING:
    from odomap.maps.map import Map
    from odomap.sensors.rig import Rig
    from odomap.system.config import Config
    from odomap.system.merging import Merger, Merging
    from odomap.system.stages import Loop
    from odomap.vision.vocabulary import VocabularyTree

__all__ = ["Merged", "merge_maps"]

Tell = Callable[[int, int, str], None]


@dataclass(frozen=True, eq=False)
class Merged:
    """Two maps that are one now.

    Attributes:
        map: both, in the world of the first.
        rig: the sensors they were made with.
        sensors: stereo, rgbd or mono.
        loops: the places that were compared, accepted or not, by keyframes of the map.
        num_places: how many of them are in common.
        T_first_second: (4, 4) the second's world in the first's.
        scale: units of the first per unit of the second; 1 unless made with one camera.
        landmarks_fused: landmarks of the second that are one with some of the first.
    """

    map: "Map"
    rig: "Rig"
    sensors: str
    loops: "tuple[Loop, ...]"
    num_places: int
    T_first_second: NDArray[np.float64]
    scale: float
    landmarks_fused: int

    @property
    def summary(self) -> str:
        """What was found, in one line."""
        from odomap.evaluation.match import rotation_angle

        T, is_metric = self.T_first_second, self.sensors != "mono"
        moved, turned = np.linalg.norm(T[:3, 3]), np.degrees(rotation_angle(T[:3, :3]))
        unit = " m" if is_metric else " units of the first"
        scaled = "" if is_metric else f", scaled by {self.scale:.4g}"
        return (
            f"{self.num_places} places in common, the second map moved by {moved:.3g}{unit} and "
            f"{turned:.3g}°{scaled}, {self.landmarks_fused} landmarks fused"
        )


def merge_maps(
    first: "SavedMap | Map | str | Path",
    second: "SavedMap | Map | str | Path",
    out: str | Path | None = None,
    *,
    rig: "Rig | None" = None,
    vocabulary: "VocabularyTree | str | Path | None" = None,
    progress: Tell | None = None,
) -> Merged:
    """Merge two maps of one place.

    Args:
        first: a map file, the folder of a run, or a map; its world stays.
        second: another, which is brought to it.
        out: file for the merged map; None writes nothing.
        rig: the sensors both were made with, for maps that do not say.
        vocabulary: makes the words by which places are recognised, or a file of one; default that
            of odomap.
        progress: called with steps done, steps in all, and what is being done.

    Returns:
        The merged map and what was found. Neither of the two is changed.

    Raises:
        InputError: a map is broken, holds no places that could be recognised, or was made with
            other cameras than the other; the file to be written is one of them.
        TrackingFailed: they have no place in common.
        OutputError: the merged map cannot be written.

    Example:
        >>> merged = merge_maps("runs/morning", "runs/evening", "home.odomap")  # doctest: +SKIP
        >>> merged.num_places  # doctest: +SKIP
        17
    """
    tell = progress or (lambda *_: None)
    _check_out(out, first, second)
    a, b = SavedMap.of(first), SavedMap.of(second)
    rig, sensors = _common_rig(a, b, rig)
    config = _config(sensors, vocabulary)
    for saved in (a, b):
        saved.check(rig, config)
    _warm_up(tell)
    merger = _merger(rig, config, None if isinstance(vocabulary, str | Path) else vocabulary)
    found = merger.merge(a.map, b.map, tell)
    if found.reason:
        raise TrackingFailed(f"{b.name}: has no place in common with {a.name}: {_why(found)}")
    if sensors != "mono":
        _adjust(found.map, rig, config, tell)
    merged = Merged(
        found.map,
        rig,
        sensors,
        found.loops,
        found.num_places,
        found.T_first_second,
        found.scale,
        found.num_fused,
    )
    if out is not None:
        tell(0, 0, "writing")
        make_folder(Path(out).parent)
        save_map(out, merged.map, rig, settings=map_settings(config))
    return merged


def _why(found: "Merging") -> str:
    """Say what came nearest to being a place in common."""
    refused = max(found.loops, key=lambda loop: loop.num_inliers, default=None)
    if refused is None:
        return f"none of {len(found.absorbed.keyframe_ids)} keyframes looks like one of the other's"
    return f"{found.reason}; at best: {refused.reason}"


def _check_out(out: str | Path | None, *given: object) -> None:
    """Make sure that the result replaces neither input, and that both are not the same."""
    files = [map_file(each) for each in given if isinstance(each, str | Path)]
    if len(files) == 2 and _are_same(*files):
        raise InputError(f"{files[0]}: is both maps: give two")
    if out is None:
        return
    for file in files:
        if _are_same(Path(out), file):
            raise InputError(f"{out}: is one of the maps to be merged: choose another file")
    obstacle = find_obstacle(out)
    if obstacle is not None:
        raise InputError(f"{out}: cannot be written: {obstacle}")


def _are_same(a: Path, b: Path) -> bool:
    return a.exists() and b.exists() and a.samefile(b)


def _common_rig(a: SavedMap, b: SavedMap, given: "Rig | None") -> "tuple[Rig, str]":
    """Return the rig and the sensors that two maps were made with.

    Raises:
        InputError: they were not made with the same, or do not say.
    """
    for saved in (a, b):
        if saved.rig is None and given is None:
            raise InputError(
                f"{saved.name}: does not say which cameras it was made with: give them as a rig"
            )
        if saved.sensors in ("lidar", "lidar2d"):
            raise InputError(
                f"{saved.name}: was made with {KINDS[saved.sensors]}: maps of cameras alone can be "
                "merged; 'odomap continue' goes on with a map in another recording"
            )
    there, here = (saved.rig or given for saved in (a, b))
    assert there is not None
    assert here is not None
    if a.sensors and b.sensors and a.sensors != b.sensors:
        raise InputError(
            f"{b.name}: was made with {KINDS[b.sensors]}, {a.name} with {KINDS[a.sensors]}: only "
            "maps of the same cameras can be merged"
        )
    sensors = a.sensors or b.sensors or a.usual_preset(there)
    for difference in rig_differences(there, here, sensors):
        raise InputError(
            f"{b.name}: was made with another rig than {a.name}: {difference}: only maps of the "
            "same cameras can be merged"
        )
    return there, sensors


def _config(sensors: str, vocabulary: "VocabularyTree | str | Path | None") -> "Config":
    from odomap.system.config import preset
    from odomap.system.placeindex import PlacesConfig

    named = str(vocabulary) if isinstance(vocabulary, str | Path) else ""
    return replace(preset(sensors), places=PlacesConfig(vocabulary=named))


def _merger(rig: "Rig", config: "Config", words: "VocabularyTree | None") -> "Merger":
    from odomap.files.vocabulary import Vocabulary
    from odomap.system.closing import SideVerifier
    from odomap.system.merging import Merger
    from odomap.system.visual import Sight

    eye, with_scale = Sight.of(rig, config).eye, config.tracking.sensors == "mono"
    verifier = SideVerifier(
        eye.camera,
        eye.T_body_camera,
        config.noise.feature_px,
        config.orb.scale,
        with_scale,
        config.matching,
    )
    if words is None:
        words = Vocabulary.load(config.places.vocabulary or None)
    return Merger(words, verifier, with_scale, config.closing)


def _adjust(map: "Map", rig: "Rig", config: "Config", tell: Tell) -> None:
    """Bring the whole map into agreement with all that was seen, where depth was measured.

    Of one camera's maps one came out better and one worse: they stay as loops have left them.
    """
    from odomap.system.globaladjustment import GlobalAdjuster
    from odomap.system.visual import Sight

    sight = Sight.of(rig, config)
    if not config.adjusting.enabled or sight.ranger is None:
        return
    tell(0, 0, "adjusting")
    job = GlobalAdjuster(
        map,
        sight.eye.camera,
        sight.eye.T_body_camera,
        config.noise.feature_px,
        config.orb.scale,
        sight.ranger.sigma,
        sight.depth_bias(config.noise),
        config.mapping.gate,
        config.bundle,
        config.adjusting,
    ).whole()
    job.read()
    job.solve().write(map)


def _warm_up(tell: Tell) -> None:
    """Compile, or load from the cache, the kernels of what compares places."""
    import odomap.system.globaladjustment  # (these load the modules whose kernels are needed)
    import odomap.system.merging  # noqa: F401
    from odomap.compiling import compile_modules
    from odomap.kernels import needed_modules

    compile_modules(
        needed_modules(), lambda done, total, name: tell(done, total, f"compiling {name}")
    )
