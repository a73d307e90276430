"""What a run leaves in its folder, and what of it survives a disk that fills up.

The folder is made and tried before tracking. Live poses are appended as they come; everything else
is written at the end, each file whole or not at all, the path first because it matters most. If
one file cannot be written the others still are, and then one error says which are missing and
which are there.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from odomap.errors import OutputError
from odomap.files.atomic import make_folder, write_bytes, write_text
from odomap.files.loops import LOOPS_FILE, LoopLog, write_loops
from odomap.files.mapfile import save_map
from odomap.files.trajectories import write_tum
from odomap.logbook import Logbook
from odomap.maps.estimate import Estimate, Status
from odomap.savedmap import map_settings
from odomap.sensors.sync import format_stamp
from odomap.settings import config_to_yaml
from odomap.version import __version__

if TYPE_CHECKING:
    from odomap.maps.map import Map
    from odomap.sources.source import Source
    from odomap.system.config import Config
    from odomap.system.system import Result
    from odomap.views.loopview import LoopView
    from odomap.views.record import Report

__all__ = ["Outputs"]

REPORTED = (
    "frames",
    "tracked",
    "lost",
    "skipped",
    "rhythm",
    "frames_dropped",
    "ms_per_frame",
    "real_time_factor",
    "duration_s",
    "path_m",
    "keyframes",
    "landmarks",
    "loops_closed",
    "loops_rejected",
    "cpu_s",
    "compile_s",
    "peak_memory_mb",
    "memory_mb",
    "map_bytes",
)
"""Metrics that the report shows."""

GRID_FILE = "grid.yaml"
"""Name of the grid in the folder of a run; its pictures are beside it."""
CLOUD_FILE = "cloud.ply"
"""Name of the cloud in the folder of a run; its picture is beside it."""
OF_THE_MAP = ("keyframes.tum", "map.odomap", GRID_FILE, CLOUD_FILE)
"""What is not written where frames are only placed in a map."""

MOST_CELLS = 2000
"""Cells of a grid along the way of a LiDAR: streets need no finer ones."""
FLUSH_EVERY = 25
"""Frames after which the live path is handed to the operating system."""


class Outputs:
    """The output folder of one run.

    Args:
        folder: where to; made if it does not exist.
        config: what the run is configured with.
        head: keys for the head of config.yaml, such as the source.

    Attributes:
        folder: where to.
        written: names of the files written so far.

    Raises:
        OutputError: the folder cannot be made or written to.
    """

    def __init__(self, folder: str | Path, config: "Config", head: Mapping[str, object]) -> None:
        self.folder = make_folder(folder)
        self.written: tuple[str, ...] = ()
        self._config = config_to_yaml(config, {"odomap": __version__} | dict(head))
        self._data = str(head.get("data", ""))
        self._settings, self._map = map_settings(config), str(head.get("map", ""))
        self._scan, self._picture, self._cloud_picture = config.scan, b"", b""
        self._is_mapping = bool(head.get("is_mapping", True))
        self._part = self.folder / "trajectory_live.tum.part"
        self._live: TextIO | None = None
        self._lines = 0

    def append(self, estimate: Estimate) -> None:
        """Append a live pose; lost frames have no row."""
        if estimate.status == Status.LOST or estimate.keyframe_id < 0:
            return
        try:
            if self._live is None:
                self._live = self._part.open("w", encoding="ascii", newline="\n")
            self._live.write(_row(estimate))
            self._lines += 1
            if self._lines % FLUSH_EVERY == 0:
                self._live.flush()
        except OSError:
            # A full disk does not stop tracking: the path is in memory, and the files written at
            # the end say what is wrong. Until then there may be space again.
            self._forget_live()

    def write(
        self,
        source: "Source",
        result: "Result",
        logbook: Logbook,
        metrics: dict[str, Any],
        warnings: list[str],
    ) -> None:
        """Write every output, whatever happens to the others.

        Raises:
            OutputError: at least one could not be written; the message says which there are.
        """
        self._close_live()
        failures: list[OutputError] = []
        metrics["mapping"] = {name: int(n) for name, n in result.mapping.items()} or None
        metrics["map_bytes"] = None  # until the map is there
        jobs: list[tuple[str, Callable[[], object]]] = [
            ("trajectory.tum", lambda: write_tum(self._at("trajectory.tum"), result.trajectory)),
            (
                "trajectory_live.tum",
                lambda: write_tum(self._at("trajectory_live.tum"), result.trajectory_live),
            ),
            ("keyframes.tum", lambda: write_tum(self._at("keyframes.tum"), result.keyframes)),
            ("map.odomap", lambda: self._write_map(source, result, metrics)),
            *self._grid(source, result),
            *self._cloud(source, result),
            *self._loops(source, result, logbook),
            ("config.yaml", lambda: write_text(self._at("config.yaml"), self._config)),
            ("metrics.json", lambda: write_text(self._at("metrics.json"), as_json(metrics))),
            (
                "report.html",
                lambda: self._write_report(
                    self._report(source, result, logbook, metrics, warnings)
                ),
            ),
        ]
        if not self._is_mapping:
            jobs = [job for job in jobs if job[0] not in OF_THE_MAP]
        for name, job in jobs:
            try:
                job()
            except OutputError as error:
                failures.append(error)
            else:
                self.written += (name,)
                self._forget_live()  # the path is safe: give its space to the other files
        if failures:
            there = f"written: {', '.join(self.written)}" if self.written else "nothing is written"
            raise OutputError(f"{failures[0]}; {there}")

    def _at(self, name: str) -> Path:
        return self.folder / name

    def _command(self) -> str:
        """Return the command that does it again."""
        verb = "continue" if self._is_mapping else "localize"
        head = f"odomap {verb} {self._map}" if self._map else "odomap run"
        return f"{head} {self._data} --config {self.folder / 'config.yaml'}"

    def _loops(
        self, source: "Source", result: "Result", logbook: Logbook
    ) -> list[tuple[str, Callable[[], object]]]:
        """Return the job of writing what became of loops, where they were looked for."""
        file = self._at(LOOPS_FILE)
        if logbook.loops is None:
            remove(file)  # that of another run
            return []
        loops = loop_log(source, result, logbook)
        return [(LOOPS_FILE, lambda: write_loops(file, loops))]

    def _grid(self, source: "Source", result: "Result") -> list[tuple[str, Callable[[], object]]]:
        """Return the job of writing a grid, where a laser or a LiDAR made the map."""
        if self._settings["sensors"] not in ("lidar2d", "lidar") or not _has_seen(result.map):
            return []
        return [(GRID_FILE, lambda: self._write_grid(source, result))]

    def _write_grid(self, source: "Source", result: "Result") -> None:
        from odomap.maps.occupancy import GridConfig, grid_of_map
        from odomap.views.gridpicture import write_grid

        config = GridConfig(scan=self._scan)
        if self._settings["sensors"] == "lidar":
            places = result.map.Ts_world_body(result.map.keyframe_ids)[:, :3, 3]
            wide = float(np.ptp(places, axis=0).max())
            config = replace(config, resolution=max(config.resolution, wide / MOST_CELLS))
        made = grid_of_map(result.map, source.rig, config)
        *_, picture = write_grid(self._at(GRID_FILE), made)
        self._picture = picture.read_bytes()

    def _cloud(self, source: "Source", result: "Result") -> list[tuple[str, Callable[[], object]]]:
        """Return the job of writing a cloud, where a LiDAR made the map."""
        if self._settings["sensors"] != "lidar" or not _has_seen(result.map):
            return []
        return [(CLOUD_FILE, lambda: self._write_cloud(source, result))]

    def _write_cloud(self, source: "Source", result: "Result") -> None:
        from odomap.files.cloudfiles import write_cloud
        from odomap.maps.cloudmap import cloud_of_map
        from odomap.views.cloudpicture import cloud_png

        made = cloud_of_map(result.map, source.rig)
        write_cloud(self._at(CLOUD_FILE), made.columns())
        self._cloud_picture = cloud_png(made)
        write_bytes(self._at(CLOUD_FILE).with_suffix(".png"), self._cloud_picture)

    def _write_map(self, source: "Source", result: "Result", metrics: dict[str, Any]) -> None:
        file = self._at("map.odomap")
        save_map(file, result.map, source.rig, settings=self._settings)
        metrics["map_bytes"] = file.stat().st_size

    def _report(
        self,
        source: "Source",
        result: "Result",
        logbook: Logbook,
        metrics: dict[str, Any],
        warnings: list[str],
    ) -> "Report":
        """Gather what the report shows."""
        from odomap.geometry.pose import Sim3
        from odomap.views.covisibility import MapView
        from odomap.views.record import Report, Sample, Scale

        # A path without a scale is drawn at that of the truth, where there is one.
        scale = metrics["ate"]["scale"] if metrics["ate"] and not result.is_metric else 1.0
        fitted: Scale = "fitted" if metrics["ate"] else "free"
        numbers = {name: metrics[name] for name in REPORTED}
        if not result.is_metric:
            numbers["path_units"] = numbers.pop("path_m")
        shown = Sim3.from_parts(scale, np.eye(3), np.zeros(3))
        return Report(
            title=source.name,
            source=self._data,
            version=__version__,
            command=self._command(),
            config=self._config,
            rig=rig_text(source),
            estimates=logbook.estimates,
            trajectory=result.trajectory.transformed(shown),
            truth=None if source.truth is None else result.truth(source.truth),
            scores={"ATE": metrics["ate"]} if metrics["ate"] else {},
            metrics=numbers,
            samples=[
                Sample(frame.images[0], estimate)
                for frame, estimate in logbook.samples
                if frame.images and frame.images[0] is not None
            ],
            warnings=warnings,
            scale="metric" if result.is_metric else fitted,
            skipped=[(item.stamp_ns, item.file, item.reason) for item in source.skipped],
            points=scale * result.map.points_world(result.map.landmark_ids),
            map=MapView.of(result.map, scale),
            growth=logbook.growth(),
            mapping=metrics["mapping"] or {},
            beside_ms=metrics.get("beside_ms", {}),
            loops=self._loop_view(source, result, logbook, scale),
            grid_png=self._picture,
            cloud_png=self._cloud_picture,
        )

    def _loop_view(
        self, source: "Source", result: "Result", logbook: Logbook, scale: float
    ) -> "LoopView | None":
        """Return what the report shows of loops."""
        if logbook.loops is None:
            return None
        from odomap.views.loopview import LoopView

        log = loop_log(source, result, logbook)
        return LoopView.of(log, result.trajectory_live, result.map, scale)

    def _write_report(self, report: "Report") -> None:
        from odomap.views.report import write_report

        try:
            write_report(self.folder, report)
        except OSError as error:
            mend = f"{error.strerror or error}: choose another folder with --out"
            raise OutputError(f"{self._at('report.html')}: cannot be written: {mend}") from error

    def _close_live(self) -> None:
        if self._live is not None:
            try:
                self._live.close()
            except OSError:
                self._forget_live()

    def _forget_live(self) -> None:
        """Give up the appended path, and the space it took."""
        self._live = None
        remove(self._part)


def loop_log(source: "Source", result: "Result", logbook: Logbook) -> LoopLog:
    """Return what was decided on loops, where they were looked for."""
    assert logbook.loops is not None
    start = logbook.estimates[0].stamp_ns if logbook.estimates else 0
    decided = logbook.loops.records(logbook.estimates)
    return LoopLog(source.name, result.is_metric, start, decided)


def remove(path: Path) -> None:
    """Remove a file that says nothing any more, if that can be done."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return  # nothing more can be done with it, and the other files do not need it


def _row(estimate: Estimate) -> str:
    x, y, z = estimate.T_world_body.t.tolist()
    qw, qx, qy, qz = estimate.T_world_body.quaternion.tolist()
    numbers = " ".join(f"{value:.9f}" for value in (x, y, z, qx, qy, qz, qw))
    return f"{format_stamp(estimate.stamp_ns)} {numbers}\n"


def as_json(values: Mapping[str, Any]) -> str:
    """Return JSON with a null for every number that is not finite."""
    return json.dumps(_finite(values), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def rig_text(source: "Source") -> str:
    """Describe a rig in a few lines."""
    lines = []
    for mount in source.rig.cameras:
        camera = mount.camera
        lines.append(
            f"camera {mount.name}: {camera.model}, {camera.width}x{camera.height}, "
            f"fx {camera.fx:.2f} fy {camera.fy:.2f} cx {camera.cx:.2f} cy {camera.cy:.2f}, "
            f"distortion {[round(float(k), 6) for k in camera.distortion]}"
        )
    if source.rig.imu:
        lines.append(f"imu: {source.rig.imu.rate_hz:g} Hz")
    lines += [f"lidar {mount.name}: {mount.rate_hz:g} Hz" for mount in source.rig.lidars]
    return "\n".join(lines)


def _has_seen(map: "Map") -> bool:
    """Say whether keyframes of a map have a scan or a cloud."""
    keyframes = (map.keyframe(k) for k in map.keyframe_ids.tolist())
    return any(keyframe.scan is not None or keyframe.cloud is not None for keyframe in keyframes)
