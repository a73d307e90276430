"""The live view beside a run, and the same view of a run that is over.

    view = View()                       prints the address of its page
    view.watch(slam, source.rig, config)
    for frame in source:
        view.see(frame)
        slam.track(frame)
    view.wait()

A view is an observer. In the tracker's thread it only drops what it is given into a mailbox of
limited size, some microseconds; a thread of its own empties that a few times per second, reads the
map a little at a time (`views.livemap`), and draws for whoever has the page open; where nobody
looks it draws nothing. It decides nothing, and nothing in a run waits for it: the files of a run
are the same bytes with it and without. If drawing fails the view stays as it is and says so once.
"""

import logging
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.feed import Mailbox
from odomap.views.livemap import LivePath, sketch
from odomap.views.livescene import LiveScene, Panel
from odomap.views.livesensor import Sensor, tracked_sensor
from odomap.views.liveserver import HOST, PORT, check_viewer, close_server, open_server

if TYPE_CHECKING:
    from odomap.system.config import Config
    from odomap.system.stages import Loop, MapState
    from odomap.system.worker import Worker

__all__ = ["View", "check_view", "serve", "watching"]

Array = NDArray[np.float64]

DRAW_EVERY_S = 0.08
MAP_EVERY_S = 0.5
REST = 5.0
"""The thread of the view rests for so many times as long as it has drawn."""
MESSAGES = 1024
"""Estimates that may wait to be drawn."""
RECENT = 4
"""Frames kept until their estimate comes."""
NEWS_FOR_S = 20.0
"""What has just happened is said for so long."""
PATIENCE_S = 5.0
"""How long drawing may take when it is no longer wanted."""


class Watched(Protocol):
    """What can be watched: a map, and a worker that tells of it."""

    map: Map
    worker: "Worker"


class View:
    """A page in the browser that shows a run while it goes on.

    Args:
        host: address to listen on; the default lets nobody in from outside.
        port: port wanted; the next free one is taken.

    Attributes:
        url: address of the page.

    Raises:
        MissingExtra: viser is not installed.
        InputError: no such address, or no free port.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        self._server, self.url = open_server(host, port)
        print(f"odomap: view: {self.url}", file=sys.stderr, flush=True)
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def watch(self, system: Watched, rig: Rig, config: "Config") -> None:
        """Show a system from now on, in place of one before.

        Args:
            system: a SLAM system or odometry.
            rig: of its frames.
            config: its configuration, which says the sensors that it tracks.
        """
        self._stop()
        sensors = config.tracking.sensors
        unit = "units" if sensors == "mono" else "m"
        self._drawing = _Drawing(self._server, system.map, tracked_sensor(rig, sensors), unit)
        self._frames: tuple[Frame, ...] = ()
        worker = system.worker
        worker.on_estimate.append(self._on_estimate)
        worker.on_keyframe.append(self._on_keyframe)
        worker.on_map.append(self._on_map)
        worker.on_loop.append(self._on_loop)
        self._over = threading.Event()
        # A daemon: a program that ends without closing its view ends all the same.
        self._thread = threading.Thread(target=self._draw_on, name="odomap view", daemon=True)
        self._thread.start()

    def see(self, frame: Frame) -> None:
        """Remember the frame that is tracked next, for its image."""
        self._frames = (*self._frames[1 - RECENT :], frame)

    def wait(self) -> None:
        """Keep the page open until Ctrl-C; without a terminal, return at once."""
        if not sys.stderr.isatty():
            return
        print(f"odomap: the view stays open: {self.url} (Ctrl-C ends it)", file=sys.stderr)
        serve(lambda: None)

    def close(self) -> None:
        """Close the page and end its threads."""
        self._stop()
        close_server(self._server)

    def _stop(self) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join(PATIENCE_S)
            self._thread = None

    # ---- in the tracker's thread ----

    def _on_estimate(self, estimate: Estimate) -> None:
        frame = next((f for f in reversed(self._frames) if f.id == estimate.frame_id), None)
        self._drawing.tell(estimate, frame)

    def _on_keyframe(self, keyframe: Keyframe) -> None:
        self._drawing.is_stale = True

    def _on_map(self, state: "MapState") -> None:
        self._drawing.is_stale = True

    def _on_loop(self, loop: "Loop") -> None:
        if loop.is_accepted:
            self._drawing.closed.append(loop)

    # ---- in the thread of the view ----

    def _draw_on(self) -> None:
        drawing, over = self._drawing, self._over
        try:
            pause = DRAW_EVERY_S
            while not over.wait(pause):
                start = time.perf_counter()
                drawing.go_on(start)
                # Where the machine is busy, a run comes before its picture.
                pause = max(DRAW_EVERY_S, REST * (time.perf_counter() - start))
        except Exception as error:
            logging.getLogger(__name__).error(
                "the view has stopped; the run goes on", exc_info=error
            )


class _Drawing:
    """What is known of a run, and drawn from."""

    def __init__(self, server: Any, map: Map, sensor: Sensor, unit: str = "m") -> None:
        self.is_stale = True
        self.closed: list[Loop] = []
        self._unit, self._news_s, self._num_told = unit, -np.inf, 0
        self._map, self._sensor, self._T_body_sensor = map, sensor, sensor.T_body_sensor
        self._mailbox: Mailbox[Estimate] = Mailbox(MESSAGES)
        self._scene = LiveScene(server, sensor)
        self._path = LivePath(self._T_body_sensor.t)
        self._sample = sensor.sample(map)
        self._latest: tuple[Estimate, Frame | None] | None = None
        self._first: SE3 | None = None
        self._drawn: Estimate | None = None
        self._said: Panel | None = None
        self._read_s = -np.inf
        self._is_facing = False
        self._tail: list[Array] = []
        self._laps: deque[float] = deque(maxlen=30)
        self._num_points = self._num_keyframes = self._num_loops = 0

    def tell(self, estimate: Estimate, frame: Frame | None) -> None:
        """Take note of an estimate; from the tracker's thread."""
        self._mailbox.put(estimate)
        self._latest = estimate, frame

    def go_on(self, now_s: float) -> None:
        """Take in what has come, and draw it if somebody looks."""
        while (estimate := self._mailbox.take(0.0)) is not None:
            self._take_in(estimate)
        if not self._scene.has_viewers:
            return
        if self.is_stale and now_s - self._read_s >= MAP_EVERY_S:
            self.is_stale, self._read_s = False, now_s
            self._show_map()
        self._show_frame(now_s)
        self._scene.obey()

    def _take_in(self, estimate: Estimate) -> None:
        self._path.add(estimate)
        self._laps.append(sum(estimate.timing.values()))
        if estimate.keyframe_id < 0:
            return
        T_world_sensor = estimate.T_world_body @ self._T_body_sensor
        if self._first is None:
            self._first = T_world_sensor
        self._tail.append(T_world_sensor.t)
        self._tail = self._tail[-MESSAGES:]

    def _show_map(self) -> None:
        seen = sketch(self._map, self._sample, self._T_body_sensor.t)
        if not self._sample.is_whole:
            self.is_stale = True
        self._num_points, self._num_keyframes = seen.shown.count, len(seen.Ts_world_body)
        if not self._is_facing and self._first is not None:
            reach = seen.distance_seen(self._T_body_sensor.t)
            if reach is not None:
                self._is_facing = True
                self._scene.face(self._first.matrix, reach)
        Ts_world_sensor = seen.Ts_world_body @ self._T_body_sensor.matrix
        self._scene.show_map(seen.shown, Ts_world_sensor)
        positions, is_lost = self._path.positions(self._map)
        self._scene.show_path(positions, is_lost)
        told = self._path.told if self.closed else positions[:0]
        self._scene.show_loops(seen.loops, seen.gaps, told)
        self._num_loops = len(seen.loops)
        self._tail = list(positions[-1:])

    def _show_frame(self, now_s: float) -> None:
        if self._latest is None:
            return
        estimate, frame = self._latest
        T_world_sensor = estimate.T_world_body @ self._T_body_sensor
        panel = self._panel(estimate, now_s)
        if panel != self._said:
            self._said = panel
            self._scene.say(panel)
        if estimate is not self._drawn:
            self._drawn = estimate
            sight = None if frame is None else self._sensor.sight(frame, estimate)
            is_lost = estimate.status == Status.LOST
            self._scene.show_sensor(
                T_world_sensor.matrix, T_world_sensor.quaternion, sight, is_lost
            )
            if len(self._tail) > 1:
                self._scene.show_tail(np.array(self._tail))
        self._scene.follow(T_world_sensor.matrix)

    def _panel(self, estimate: Estimate, now_s: float) -> Panel:
        rows = [("frame", str(estimate.frame_id))]
        if self._laps:
            rows.append(("ms per frame", f"{np.median(self._laps):.1f}"))
        rows.append(("inliers", str(estimate.num_inliers)))
        rows.append(("keyframes", str(self._num_keyframes)))
        rows.append((self._sensor.remembers, str(self._num_points)))
        if self._num_loops:
            rows.append(("loops", str(self._num_loops)))
        return Panel(estimate.status.value, estimate.reason, tuple(rows), self._news(now_s))

    def _news(self, now_s: float) -> str:
        """Say what the last loop did, for some seconds."""
        if len(self.closed) > self._num_told:
            self._num_told, self._news_s = len(self.closed), now_s
        if now_s - self._news_s > NEWS_FOR_S:
            return ""
        loop = self.closed[-1]
        what = "two pieces of the map are one" if loop.merges else "loop"
        return (
            f"{what}: keyframe {loop.keyframe_id} is back at {loop.matched_id}, path moved by "
            f"{loop.moved:.2g} {self._unit}"
        )


def serve(go_on: Callable[[], object]) -> None:
    """Call a function, some ten times per second, until Ctrl-C."""
    try:
        while True:
            go_on()
            time.sleep(DRAW_EVERY_S)
    except KeyboardInterrupt:
        return


def check_view(view: View | bool) -> None:
    """Make sure that a view can be opened, where one is to be.

    Raises:
        MissingExtra: viser is not installed.
    """
    if view is True:
        check_viewer()


@contextmanager
def watching(
    view: View | Literal[True], system: Watched, rig: Rig, config: "Config"
) -> Iterator[Callable[[Frame], object]]:
    """Let a view watch a run; one that is made here ends with it.

    Args:
        view: a view, True for one of its own.
        system: what tracks.
        rig: of the frames.
        config: of the system.

    Yields:
        What to call with each frame before it is tracked.
    """
    shown = View() if isinstance(view, bool) else view
    try:
        shown.watch(system, rig, config)
        yield shown.see
    finally:
        if view is True:
            shown.close()
