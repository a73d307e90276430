"""The view of a run that is over: its map and its path, and the sensor at any frame of it.

A run's folder holds the map (`map.odomap`) and the path (`trajectory.tum`); one of them is enough,
and a map file alone will do, whose path is that of its keyframes. A slider moves the sensor along
the path. Frames that were lost have no row in the path: where it pauses for much longer than from
frame to frame, it is drawn as lost. Nothing is written, and no recording is opened.

Cost: O(map) once, then O(1) per look.
"""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.mapfile import SUFFIX, MapFile
from odomap.files.trajectories import read_tum
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.maps.map import Map
from odomap.viewing import serve
from odomap.views.livemap import Sketch, sketch
from odomap.views.livescene import LiveScene, Panel
from odomap.views.livesensor import CameraSensor, Sensor, tracked_sensor, usual_sensors
from odomap.views.liveserver import HOST, PORT, close_server, open_server

__all__ = ["PastRun", "review"]

Array = NDArray[np.float64]

PATH_FILE, LIVE_FILE, MAP_FILE = "trajectory.tum", "trajectory_live.tum", "map.odomap"
PAUSE = 5.0
"""A path pauses where two of its frames are so many usual steps apart."""


@dataclass(frozen=True, eq=False)
class PastRun:
    """What a run has left.

    Attributes:
        name: for people.
        trajectory: T_world_body of its frames, or of the keyframes where there is no path.
        map: what is remembered; an empty one where there is no map.
        told: (N, 3) the path as it was told frame by frame; none where nobody says.
        sensor: that was followed; a camera of no known kind where nobody says.
    """

    name: str
    trajectory: Trajectory
    map: Map
    sensor: Sensor
    told: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def read(cls, path: str | Path) -> "PastRun":
        """Read a run's folder, or a map file.

        Raises:
            InputError: there is nothing to show, or it cannot be read.
        """
        place = Path(path)
        is_map = place.suffix == SUFFIX and not place.is_dir()
        if not is_map and not place.is_dir():
            raise InputError(f"{place}: no such run: give the folder of a run, or a map.odomap")
        map_file = place if is_map else place / MAP_FILE
        path_file = place / PATH_FILE
        has_map, has_path = is_map or map_file.is_file(), not is_map and path_file.is_file()
        if not (has_map or has_path):
            raise InputError(f"{place}: neither {MAP_FILE} nor {PATH_FILE} is there: is it a run?")
        found, sensor = _map(map_file) if has_map else (Map(), CameraSensor())
        trajectory = read_tum(path_file) if has_path else _keyframes(found)
        if not len(trajectory):
            raise InputError(f"{place}: there is no pose in it")
        live = place / LIVE_FILE
        told = read_tum(live) if has_path and live.is_file() else trajectory.rows(np.arange(0))
        Ts = told.Ts_world_body @ sensor.T_body_sensor.matrix
        name = place.name or str(place)
        return cls(name, trajectory, found, sensor, Ts[:, :3, 3])


def review(path: str | Path, host: str = HOST, port: int = PORT) -> None:
    """Show a run that is over until Ctrl-C.

    Args:
        path: the folder of a run, or a map file.
        host: address to listen on.
        port: port wanted; the next free one is taken.

    Raises:
        InputError: there is nothing to show, or no place to show it.
    """
    past = PastRun.read(path)
    server, url = open_server(host, port)
    try:
        print(f"odomap: view: {url} (Ctrl-C ends it)", file=sys.stderr, flush=True)
        serve(Review(past, LiveScene(server, past.sensor, len(past.trajectory))).go_on)
    finally:
        close_server(server)


class Review:
    """Draws a past run, and its sensor where the slider is.

    Args:
        past: the run.
        scene: where it is drawn.
    """

    def __init__(self, past: PastRun, scene: LiveScene) -> None:
        self._past, self._scene, self._frame = past, scene, -1
        T_body_sensor = past.sensor.T_body_sensor
        self._Ts = past.trajectory.Ts_world_body @ T_body_sensor.matrix
        seen = sketch(past.map, past.sensor.whole(past.map), T_body_sensor.t)
        self._counts: tuple[tuple[str, str], ...] = (
            ("keyframes", str(len(seen.Ts_world_body))),
            (past.sensor.remembers, str(seen.shown.count)),
        )
        scene.face(self._Ts[0], self._reach(seen))
        unseen = replace(seen.shown, is_seen=np.zeros(len(seen.shown.points), np.bool_))
        scene.show_map(unseen, seen.Ts_world_body @ T_body_sensor.matrix)
        scene.show_path(self._Ts[:, :3, 3], pauses(past.trajectory.stamps_ns))
        told = past.told if len(seen.loops) else past.told[:0]
        scene.show_loops(seen.loops, seen.gaps, told)
        if len(seen.loops):
            self._counts += (("loops", str(len(seen.loops))),)

    def go_on(self) -> None:
        """Look where the slider is, and draw the sensor there."""
        if self._scene.frame != self._frame:
            self._frame = self._scene.frame
            pose = SE3(self._Ts[self._frame])
            self._scene.show_sensor(pose.matrix, pose.quaternion, None, False)
            stamp = f"{1e-9 * self._past.trajectory.stamps_ns[self._frame]:.3f} s"
            where = f"{self._frame + 1} of {len(self._Ts)}"
            rows = (("frame", where), ("time", stamp), *self._counts)
            self._scene.say(Panel(self._past.name, "", rows))
        self._scene.follow(self._Ts[self._frame])
        self._scene.obey()

    def _reach(self, seen: Sketch) -> float:
        """Return how far the sensor sees, or a share of the path's size where that is unknown."""
        reach = seen.distance_seen(self._past.sensor.T_body_sensor.t)
        extent = float(np.linalg.norm(np.ptp(self._Ts[:, :3, 3], axis=0)))
        return reach or 0.2 * extent or 1.0


def pauses(stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (N,) which frames are the last before a pause."""
    is_last = np.zeros(len(stamps_ns), np.bool_)
    steps = np.diff(stamps_ns)
    if len(steps) > 1:
        is_last[:-1] = steps > PAUSE * np.median(steps)
    return is_last


def _map(path: Path) -> tuple[Map, Sensor]:
    with MapFile(path) as file:
        rig = file.rig
        if rig is None:
            return file.map(), CameraSensor()
        said = str(file.settings.get("sensors", usual_sensors(rig)))
        try:
            return file.map(), tracked_sensor(rig, said)
        except InputError:  # cameras that are no pair: the first one was tracked
            return file.map(), tracked_sensor(rig, "mono")


def _keyframes(map: Map) -> Trajectory:
    ids = map.keyframe_ids
    stamps = np.array([map.keyframe(k).stamp_ns for k in ids.tolist()], np.int64)
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], map.Ts_world_body(ids)[order])
