"""`odomap run`: from a recording to its path, map, numbers and report."""

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from odomap.cli.progress import TrackingProgress

if TYPE_CHECKING:
    from odomap.run import RunResult
    from odomap.savedmap import SavedMap
    from odomap.system.config import Config
    from odomap.viewing import View

__all__ = ["Run", "conclude", "track"]

Overrides = Annotated[tuple[tuple[str, str], ...], tyro.conf.Suppress]


@dataclass(frozen=True)
class Run:
    """Track a recording; write its path, map, numbers and a report.

    Writes trajectory.tum, trajectory_live.tum, keyframes.tum, map.odomap, metrics.json, config.yaml
    and report.html, and loops.json where loops are looked for. Any field that `odomap config`
    prints can be set as --section.field VALUE.
    """

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """A recording (EuRoC, KITTI, TUM RGB-D), a video, a folder of images, camera:0, or a simulated
    world ('sim:room?seed=3&frames=100')."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the outputs; default runs/NAME."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """A preset; default the one for the cameras there are; `odomap config --list` names them."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A config file, read over the preset."""
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rig.yaml: which sensors there are and where they are mounted."""
    rhythm: Literal["inline", "lockstep", "live"] = "lockstep"
    """How stages follow each other: inline, each in turn; lockstep, mapping beside tracking, and
    still the same bytes on every run; live, at the pace of the sensor, dropping late frames."""
    odometry_only: bool = False
    """Follow the path alone, by optical flow: what is behind is forgotten."""
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Stop after this many frames."""
    quiet: bool = False
    """No progress."""
    view: bool = False
    """Show the run in the browser while it goes on, and afterwards until Ctrl-C."""
    view_host: str = "127.0.0.1"
    """Address of the view's page; 0.0.0.0 lets other machines look."""
    view_port: int = 8080
    """Port of the view's page; if it is taken, the next free one."""
    overrides: Overrides = ()

    def execute(self) -> int:
        """Track, write, and say where everything is."""
        from odomap.run import chosen_config
        from odomap.sources.open import open as open_source
        from odomap.system.config import odometry_preset
        from odomap.views.liveserver import check_viewer

        if self.view:
            check_viewer()
        chosen_config(self.preset, self.config, self.overrides)  # names are checked first
        source = open_source(self.data, self.rig)
        preset = self.preset
        if preset is None and self.odometry_only:
            preset = odometry_preset(source.rig)
        config = chosen_config(preset, self.config, self.overrides, source.rig)
        out = self.out or Path("runs") / folder_name(source.name)
        command: dict[str, object] = {"data": self.data}
        if self.preset:
            command["preset"] = self.preset
        if self.rig:
            command["rig"] = str(self.rig)
        with self._view() as view:
            code, _ = track(
                source,
                out,
                config,
                command,
                self.max_frames,
                self.quiet,
                self.rhythm,
                view,
                odometry_only=self.odometry_only,
            )
            if view is not None and code != 130:
                view.wait()
        return code

    def _view(self) -> "AbstractContextManager[View | None]":
        if not self.view:
            return nullcontext()
        from odomap.viewing import View

        return View(self.view_host, self.view_port)


def folder_name(name: str) -> str:
    """Return a source's name as the name of a folder."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name).strip("._") or "run"


def track(
    source: object,
    out: Path,
    config: "Config",
    origin: dict[str, object],
    max_frames: int | None,
    quiet: bool,
    rhythm: str = "lockstep",
    view: "View | None" = None,
    map: "SavedMap | None" = None,
    is_mapping: bool = True,
    odometry_only: bool = False,
) -> "tuple[int, RunResult]":
    """Run with progress, print the conclusion, and return the exit code with the result."""
    from odomap.run import Interrupted, run

    code = 0
    try:
        with TrackingProgress(quiet) as progress:
            result = run(
                source,  # type: ignore[arg-type]
                out,
                config=config,
                rhythm=rhythm,
                max_frames=max_frames,
                progress=progress.show,
                origin=origin,
                view=view or False,
                map=map,
                is_mapping=is_mapping,
                odometry_only=odometry_only,
            )
    except Interrupted as stop:
        result, code = stop.result, 130
        print(f"odomap: interrupted after {result.metrics['frames']} frames", file=sys.stderr)
    conclude(result)
    if code == 0 and result.failure:
        print(f"odomap: {result.failure}", file=sys.stderr)
        code = 1
    return code, result


def conclude(result: "RunResult") -> None:
    """Print the numbers that matter and where the rest is."""
    for warning in result.warnings:
        print(f"odomap: warning: {warning}", file=sys.stderr)
    for name, value in rows(result):
        print(f"{name:<16} {value}")
    if result.out is not None:
        print(f"{'outputs':<16} {result.out}")
        for name in result.written:
            print(f"{'':<16} {result.out / name}")


def rows(result: "RunResult") -> list[tuple[str, str]]:
    """Return the lines of the conclusion, name and value."""
    m = result.metrics
    ms = m["ms_per_frame"]
    placed = "tracked" if m["is_mapping"] else "localised"
    counts = [f"{m['tracked']} {placed}", f"{m['lost']} lost"]
    if m["frames_dropped"]:
        counts.append(f"{m['frames_dropped']} dropped")
    if m["skipped"]:
        counts.append(f"{m['skipped']} skipped")
    lines = [("frames", f"{m['frames']}: {', '.join(counts)}")]
    if m["frames"]:
        rate = f"{m['real_time_factor']:.2f} x real time" if m["real_time_factor"] else ""
        lines.append(("ms per frame", f"{ms['median']:.1f} median, {ms['p95']:.1f} p95  {rate}"))
        landmarks = f", {m['landmarks']} landmarks" if m["landmarks"] else ""
        own, all_of_them = m["keyframes"], m["map_keyframes"]
        new = f" ({own} of this run)" if own < all_of_them and m["is_mapping"] else ""
        lines.append(("map", f"{all_of_them} keyframes{new}{landmarks}"))
        if m["loops_closed"] or m["loops_rejected"]:
            lines.append(("loops", loops_text(m["loops_closed"], m["loops_rejected"])))
        unit = "m" if m["is_metric"] else "units (no scale)"
        lines.append(("path", f"{m['path_m']:.3f} {unit} in {m['duration_s']:.2f} s"))
    if m.get("ate_rmse_m") is not None:
        path = m["path_m"] * m["ate"]["scale"]
        percent = 100 * m["ate_rmse_m"] / path if path else 0.0
        share = f" ({percent:.{2 if percent >= 0.1 else 4}f} % of the path)" if path else ""
        fitted = "" if m["is_metric"] else ", scale fitted"
        lines.append(("ATE RMSE", f"{m['ate_rmse_m']:.4f} m{share}{fitted}"))
    lines.append(("peak memory", f"{m['peak_memory_mb']:.0f} MB"))
    return lines


def loops_text(closed: int, rejected: int) -> str:
    """Say how many candidates for loops were believed, and how many were not.

    Example:
        >>> loops_text(3, 1)
        '3 closed, 1 candidate rejected'
    """
    return f"{closed} closed, {rejected} candidate{'' if rejected == 1 else 's'} rejected"
