"""One call from a recording to its results: source → system → files, report, numbers.

    result = odomap.run("MH_01_easy", "runs/mh01")
    result.trajectory, result.metrics["ate_rmse_m"], result.failure

The output folder is tested before the first frame is tracked. While frames come, live poses are
appended to ``trajectory_live.tum.part``, so that even a power cut leaves the path so far; at the
end every output is written atomically, the path first, and what cannot be written does not keep
the others from being. Ctrl-C ends tracking after the frame at hand, writes everything, and is then
raised again as `Interrupted` with the result inside. The same recording gives the same
trajectory.tum, byte for byte, unless it is played live: nothing on the way to it reads a clock.
"""

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from odomap.choice import SystemChoice
from odomap.errors import CalibrationError, InputError
from odomap.figures import figures
from odomap.geometry.trajectory import Trajectory
from odomap.logbook import Logbook, spread
from odomap.loopbook import LoopBook
from odomap.maps.estimate import Estimate
from odomap.settings import override, read_config

if TYPE_CHECKING:
    from odomap.maps.map import Map
    from odomap.outputs import Outputs
    from odomap.savedmap import SavedMap
    from odomap.sensors.frame import Frame
    from odomap.sensors.rig import Rig
    from odomap.sources.source import Source
    from odomap.system.config import Config
    from odomap.system.system import Result, System
    from odomap.system.worker import Worker
    from odomap.viewing import View

__all__ = ["Interrupted", "Progress", "RunResult", "chosen_config", "run"]


RHYTHM = "lockstep"
"""How stages follow each other where nobody says."""


@dataclass(frozen=True)
class Progress:
    """Where a run stands.

    Attributes:
        stage: what is being done: "compiling", "tracking", "writing".
        done: steps behind: modules, frames.
        total: steps to expect; 0 when unknown.
        estimate: the last estimate while tracking.
        frames_per_second: rate of tracking over the last frames.
        text: what is being done at this step, where it has a name.
    """

    stage: str
    done: int
    total: int
    estimate: Estimate | None = None
    frames_per_second: float = 0.0
    text: str = ""


@dataclass(frozen=True)
class RunResult:
    """What a run found.

    Attributes:
        trajectory: T_world_body of every tracked frame, with the final map.
        trajectory_live: the same as first emitted.
        map: the map.
        estimates: one per frame, without tracks.
        metrics: the content of metrics.json.
        out: folder of the outputs, or None if none were asked for.
        written: names of the files written there.
        failure: why there is no usable path; empty when there is one.
        warnings: what a person should know, one sentence each.
    """

    trajectory: Trajectory
    trajectory_live: Trajectory
    map: "Map"
    estimates: tuple[Estimate, ...]
    metrics: dict[str, Any]
    out: Path | None
    written: tuple[str, ...]
    failure: str
    warnings: tuple[str, ...]


class Interrupted(KeyboardInterrupt):
    """Ctrl-C ended a run; what was tracked until then is written, and in `result`."""

    def __init__(self, result: RunResult) -> None:
        super().__init__("interrupted")
        self.result = result


def run(
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
    view: "View | bool" = False,
    map: "SavedMap | Map | str | Path | None" = None,
    is_mapping: bool = True,
    odometry_only: bool = False,
) -> RunResult:
    """Track and map a recording from end to end, and write its results.

    Args:
        data: a recording's folder, a world.yaml, "sim:room?seed=3&frames=100", or a `Source`.
        out: folder for the outputs; None writes nothing.
        preset: name of a preset; default the one for what the recording carries: rgbd, stereo
            or mono.
        config: a `Config`, or a file to read over the preset.
        rig: a rig or rig.yaml, for recordings that do not say what is mounted where.
        rhythm: how stages follow each other: "lockstep", mapping beside tracking, the same bytes on
            every run; "inline", each in turn; "live", frames dropped where they come too fast.
        max_frames: stop after this many frames.
        progress: called with a `Progress` as the run goes on.
        origin: extra keys for the head of config.yaml.
        view: True shows the run in the browser while it lasts; a `View` stays open.
        map: a map, or a file of one, to begin with; default a new one.
        is_mapping: False only places frames in the map, which stays as it is.
        odometry_only: True follows the path alone: what is behind is forgotten, no place is known
            again.

    Returns:
        Trajectories, map, metrics; `failure` says why there is no usable path.

    Raises:
        InputError: the recording, its calibration or the config is wrong.
        OutputError: the folder cannot be written, told before tracking; or a result could not be,
            after all others were.
        Interrupted: Ctrl-C; the result so far is written and inside.

    Example:
        >>> result = run("sim:room?seed=3&frames=30")  # doctest: +SKIP
        >>> result.metrics["lost"]  # doctest: +SKIP
        0
    """
    from odomap.outputs import Outputs
    from odomap.savedmap import SavedMap
    from odomap.sources.source import Source
    from odomap.system.worker import deferred_interrupt

    _check(view, max_frames)
    chosen_config(preset, config)  # a wrong name is told before anything is opened
    saved = None if map is None else SavedMap.of(map)
    choice = SystemChoice(rhythm, saved, is_mapping, odometry_only)
    source = data if isinstance(data, Source) else _opened(data, rig)
    usual = preset or choice.usual_preset(source.rig)
    settings = chosen_config(usual, config, rig=source.rig)
    choice.check(source.rig, settings)
    head: dict[str, object] = {"data": source.name if isinstance(data, Source) else str(data)}
    head |= ({"preset": preset} if preset else {}) | dict(origin or {}) | choice.head()
    outputs = Outputs(out, settings, head) if out is not None else None

    tell = progress or (lambda _: None)
    logbook = Logbook(_expected(source, max_frames))
    system = choice.make(source.rig, settings, head["data"])
    logbook.map, logbook.loops = None if odometry_only else system.map, LoopBook.of(system.worker)
    shown = _watching(view, system, source.rig, settings)
    compile_s = _warm_up(tell)
    with deferred_interrupt() as interrupt, closing(system.worker), shown as see:
        try:
            broken = _track(source, system, logbook, outputs, max_frames, tell, interrupt, see)
        except CalibrationError as error:  # found while tracking: say of which recording
            raise CalibrationError(f"{head['data']}: {error}") from error
        result = system.finish()
        state: dict[str, object] = {"compile_s": compile_s, "interrupted": interrupt.is_set()}
        state |= {"rhythm": rhythm, "is_mapping": is_mapping} | _beside(system.worker)
        if broken is not None:
            state["failure"] = f"tracking stopped: {broken}"
        notes = choice.notes(settings)
        done = _concluded(source, logbook, result, outputs, state, notes, tell)
    if broken is not None:
        kept = "" if outputs is None else f"; what was tracked before is in {outputs.folder}"
        raise type(broken)(f"{head['data']}: {broken}{kept}") from broken
    if interrupt.is_set():
        raise Interrupted(done)
    return done


def chosen_config(
    preset: str | None = None,
    config: "Config | str | Path | None" = None,
    overrides: Sequence[tuple[str, str]] = (),
    rig: "Rig | None" = None,
) -> "Config":
    """Return a preset, with a file read over it and single fields changed.

    Args:
        preset: name of a preset; default the one for the rig, or the first.
        config: a `Config`, which replaces the preset, or a file that is read over it.
        overrides: pairs such as ``("tracking.min_inliers", "20")``.
        rig: what the recording carries.

    Raises:
        ConfigError: an unknown preset, section or field, or a value that cannot be.
        CalibrationError: there is no preset for the rig: it has no camera.
    """
    from odomap.system.config import PRESETS, Config, preset_for
    from odomap.system.config import preset as named_preset

    name = preset or (next(iter(PRESETS)) if rig is None else preset_for(rig))
    chosen = config if isinstance(config, Config) else named_preset(name)
    if isinstance(config, str | Path):
        chosen = read_config(config, chosen)
    return override(chosen, overrides)


def _check(view: "View | bool", max_frames: int | None) -> None:
    """Make sure that a view can be opened, where one is to be, and that frames are asked for."""
    if view is True:
        from odomap.viewing import check_view

        check_view(view)
    if max_frames is not None and max_frames < 1:
        raise InputError(f"max_frames is {max_frames}: at least 1 expected")


def _opened(data: str | Path, rig: "Rig | str | Path | None") -> "Source":
    from odomap.sources.open import open as open_source

    return open_source(data, rig)


def _watching(
    view: "View | bool", system: "System", rig: "Rig", config: "Config"
) -> AbstractContextManager["Callable[[Frame], object]"]:
    """Let a view watch a run; where nobody looks, what draws is not even loaded."""
    if view is False:
        return nullcontext(lambda _: None)
    from odomap.viewing import watching

    return watching(view, system, rig, config)


def _warm_up(tell: Callable[[Progress], None]) -> float:
    """Compile, or load from the cache, the kernels of what is imported; return the seconds.

    By now the source is open and the system made: what it needs it has imported.
    """
    from odomap.compiling import compile_modules
    from odomap.kernels import needed_modules

    start = time.perf_counter()
    compile_modules(
        needed_modules(),
        lambda done, total, name: tell(Progress("compiling", done, total, text=name)),
    )
    return time.perf_counter() - start


def _track(
    source: "Source",
    system: "System",
    logbook: Logbook,
    outputs: "Outputs | None",
    max_frames: int | None,
    tell: Callable[[Progress], None],
    interrupt: threading.Event,
    see: "Callable[[Frame], object]",
) -> CalibrationError | None:
    """Track frame after frame until the source, the limit or the user ends it.

    Returns:
        What a frame in the middle said against the rig, for which the path so far is not to blame.

    Raises:
        CalibrationError: the same, before there is a path.
    """
    total = _expected(source, max_frames)
    # Closed in the end: a camera is let go, and says what there is to say of it.
    with closing(system.worker.frames(source, interrupt)) as frames:
        for frame in frames:
            see(frame)
            start = time.perf_counter()
            try:
                estimate = system.worker.advance(frame)
            except CalibrationError as error:
                if logbook.placed:
                    return error
                raise
            logbook.add(frame, estimate, time.perf_counter() - start)
            if outputs is not None:
                outputs.append(estimate)
            done = len(logbook.estimates)
            tell(Progress("tracking", done, total, estimate, logbook.frames_per_second))
            if interrupt.is_set() or done == max_frames:
                break
    return None


def _beside(worker: "Worker") -> dict[str, object]:
    """Return what a worker left out to keep up, nothing unless live, and what ran beside frames."""
    return {
        "beside_ms": {
            name: {"count": len(ms), **spread(ms)} for name, ms in worker.beside_ms.items()
        },
        "frames_dropped": worker.frames_dropped,
        "jobs_skipped": worker.jobs_skipped,
        "messages_dropped": worker.messages_dropped,
    }


def _expected(source: "Source", max_frames: int | None) -> int:
    """Return how many frames there are to track; 0 where nobody knows, as with a live camera."""
    return min((n for n in (len(source), max_frames) if n), default=0)


def _concluded(
    source: "Source",
    logbook: Logbook,
    result: "Result",
    outputs: "Outputs | None",
    state: Mapping[str, object],
    notes: Sequence[str],
    tell: Callable[[Progress], None],
) -> RunResult:
    """Make the numbers, write what is asked for."""
    metrics, found = figures(source, logbook, result, bool(state["is_mapping"]))
    metrics["warnings"] = warnings = [*notes, *found]
    metrics |= state
    if metrics["frames_dropped"]:
        came = metrics["frames"] + metrics["frames_dropped"]
        why = "tracking is slower than they come"
        warnings.append(f"{metrics['frames_dropped']} of {came} frames were dropped: {why}")
    if outputs is not None:
        tell(Progress("writing", 0, 0))
        outputs.write(source, result, logbook, metrics, warnings)
    return RunResult(
        trajectory=result.trajectory,
        trajectory_live=result.trajectory_live,
        map=result.map,
        estimates=tuple(logbook.estimates),
        metrics=metrics,
        out=outputs.folder if outputs else None,
        written=outputs.written if outputs else (),
        failure=metrics["failure"],
        warnings=tuple(warnings),
    )


class _CallableModule(ModuleType):
    """Let `odomap.run` be called, whether it is the function or, once imported, this module."""

    def __call__(self, *args: Any, **kwargs: Any) -> RunResult:
        return run(*args, **kwargs)


sys.modules[__name__].__class__ = _CallableModule
