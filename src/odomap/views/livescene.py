"""The scene of the live view: path, map, keyframes, sensor, and a panel beside them.

The world of a run knows no up, since nobody told it of gravity; but cameras are seldom upside down.
So up is what was up in the first image (y points down there), or on the body of a LiDAR, and the
first look is from where the sensor says (`views.livesensor`), as far away as what it sees. Lines
are a few pixels thick, whatever the scale. Everything of one kind is one node of the scene: 3,000
keyframes are one set of lines, sent as one array.

Nothing here reads a map or a clock; whoever calls decides how often (`odomap.viewing`).
"""

import html
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.views.livefigure import LOST, SENSOR
from odomap.views.livemap import Shown
from odomap.views.livesensor import Sensor
from odomap.views.scene import thin

__all__ = ["LiveScene", "Panel"]

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

PATH: Colour = (86, 180, 233)
KEYFRAME: Colour = (230, 159, 0)
LANDMARK: Colour = (150, 160, 176)
SEEN: Colour = (240, 228, 66)
LOOP: Colour = (255, 105, 210)
TOLD: Colour = (84, 104, 130)
GAP: Colour = (110, 118, 132)
STATUS_COLOURS = {"tracking": SENSOR, "recovered": SEEN, "initializing": PATH, "lost": LOST}

PATH_POINTS = 5000
KEYFRAMES = 2000
"""At most so many are drawn, spread evenly."""

DASHES = 12
"""Of a gap."""

END_SIZE = 0.009
"""Of a loop's ends, as a share of the distance to what the sensor sees."""


@dataclass(frozen=True)
class Panel:
    """What the panel says.

    Attributes:
        status: of the last frame.
        reason: what is wrong; empty when nothing is.
        rows: further lines, name and value.
        news: what has just happened; empty when nothing has.
    """

    status: str
    reason: str
    rows: tuple[tuple[str, str], ...]
    news: str = ""


class LiveScene:
    """What is shown, on a server of pages.

    Args:
        server: from `liveserver.open_server`.
        sensor: that is followed.
        frames: makes a slider over so many frames; 0 for none.

    Attributes:
        figure: the sensor where it is now.
        reach: distance to what the sensor sees, world units; sizes follow it.
    """

    def __init__(self, server: Any, sensor: Sensor, frames: int = 0) -> None:
        self._server, self._sensor = server, sensor
        self.reach = 1.0
        server.scene.reset()
        server.gui.reset()
        self._make_panel(frames)
        self._make_nodes()
        self.figure = sensor.figure(server)

    def _make_panel(self, frames: int) -> None:
        gui = self._server.gui
        self._words = gui.add_html("")
        self._slider = None
        if frames:
            self._slider = gui.add_slider("frame", 0, max(frames - 1, 1), 1, frames - 1)
        self._follow = gui.add_checkbox(f"follow {self._sensor.name}", True)
        self._shows_keyframes = gui.add_checkbox("keyframes", True)
        self._shows_loops = gui.add_checkbox("loops", True)
        self._shows_told = gui.add_checkbox("path before loops", True)
        self._point_size = gui.add_slider("point size", 0.2, 5.0, 0.1, 1.0)

    def _make_nodes(self) -> None:
        scene = self._server.scene
        self._world = scene.add_frame("/run", show_axes=False)

        def lines(name: str, colour: Colour, thickness: float) -> Any:
            return scene.add_line_segments(
                name,
                np.zeros((0, 2, 3), np.float32),
                colour,
                thickness=thickness,
                thickness_units="screen",
            )

        self._path = {
            lost: lines(f"/run/path/{name}", colour, 3.0)
            for lost, name, colour in ((False, "known", PATH), (True, "lost", LOST))
        }
        self._tail = lines("/run/path/newest", PATH, 3.0)
        self._told = lines("/run/path/told", TOLD, 2.0)
        self._loops = lines("/run/loops/lines", LOOP, 4.0)
        self._gaps = lines("/run/loops/gaps", GAP, 1.5)
        self._keyframes = lines("/run/keyframes", KEYFRAME, 1.5)

        def dots(name: str, colour: Colour) -> Any:
            return scene.add_point_cloud(
                name,
                np.zeros((0, 3), np.float32),
                colour,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )

        self._loop_ends = dots("/run/loops/ends", LOOP)
        self._points = {
            seen: dots(f"/run/map/{name}", colour)
            for seen, name, colour in ((False, "known", LANDMARK), (True, "in sight", SEEN))
        }

    # ---- what is shown ----

    def face(self, T_world_sensor: Array, reach: float) -> None:
        """Choose up and the first look from where the sensor is and how far it sees.

        Args:
            T_world_sensor: (4, 4) at first.
            reach: distance to what it sees, world units.
        """
        self.reach = reach
        R_world_look = (T_world_sensor @ self._sensor.T_sensor_look)[:3, :3]
        self._server.scene.set_up_direction(-R_world_look[:, 1])
        start = self._server.initial_camera
        start.position = reach * (R_world_look @ self._sensor.eye)
        start.look_at = np.zeros(3)
        start.near, start.far = 1e-3 * reach, 1e4 * reach
        self.figure.resize(reach)

    def show_path(self, positions: Array, is_lost: NDArray[np.bool_]) -> None:
        """Draw the path so far.

        Args:
            positions: (N, 3) of the sensor in the world.
            is_lost: (N,) frames without a pose of their own.
        """
        keep = thin(len(positions), PATH_POINTS)
        segments = np.stack([positions[keep[:-1]], positions[keep[1:]]], axis=1)
        missing = np.concatenate([[0], np.cumsum(is_lost)])
        lost = missing[keep[1:] + 1] > missing[keep[:-1]] if len(keep) else np.zeros(0, np.bool_)
        with self._server.atomic():
            for wanted, node in self._path.items():
                node.points = segments[lost == wanted].astype(np.float32)
            self._tail.points = np.zeros((0, 2, 3), np.float32)

    def show_tail(self, positions: Array) -> None:
        """Draw the (N, 3) newest positions, from the end of the path on."""
        self._tail.points = np.stack([positions[:-1], positions[1:]], axis=1).astype(np.float32)

    def show_map(self, shown: Shown, Ts_world_sensor: Array) -> None:
        """Draw the points of a map, and keyframes.

        Args:
            shown: the points.
            Ts_world_sensor: (K, 4, 4) of the keyframes.
        """
        keep = thin(len(Ts_world_sensor), KEYFRAMES)
        with self._server.atomic():
            for wanted, node in self._points.items():
                node.points = shown.points[shown.is_seen == wanted].astype(np.float32)
            if shown.colours is not None:  # what is in sight stands out by its own
                self._points[False].colors = shown.colours[~shown.is_seen]
            self._keyframes.points = self._sensor.marks(Ts_world_sensor[keep], self.reach)

    def show_loops(self, loops: Array, gaps: Array, told: Array) -> None:
        """Draw places that were seen before, and the path as it was until that was known.

        Args:
            loops: (L, 2, 3) ends of those that were closed.
            gaps: (G, 2, 3) ends of what was never measured.
            told: (N, 3) the path as it was told frame by frame; none draws none.
        """
        keep = thin(len(told), PATH_POINTS)
        segments = np.stack([told[keep[:-1]], told[keep[1:]]], axis=1)
        with self._server.atomic():
            self._loops.points = loops.astype(np.float32)
            self._loop_ends.points = loops.reshape(-1, 3).astype(np.float32)
            self._gaps.points = dashes(gaps)
            self._told.points = segments.astype(np.float32)

    def show_sensor(
        self, T_world_sensor: Array, wxyz: Array, sight: NDArray[Any] | None, is_lost: bool
    ) -> None:
        """Draw the sensor where it is now.

        Args:
            T_world_sensor: (4, 4).
            wxyz: (4,) its rotation.
            sight: what it sees, as `Sensor.sight` tells; None keeps what was there before.
            is_lost: whether it has no pose of its own.
        """
        with self._server.atomic():
            self.figure.show(T_world_sensor, wxyz, sight, is_lost)

    def say(self, panel: Panel) -> None:
        """Write the panel."""
        self._words.content = panel_html(panel)

    # ---- who looks, and what they want ----

    @property
    def has_viewers(self) -> bool:
        """Whether a page is open."""
        return bool(self._server.get_clients())

    @property
    def frame(self) -> int:
        """The frame that the slider is at, 0 without one."""
        return 0 if self._slider is None else int(self._slider.value)

    def obey(self) -> None:
        """Do what the controls say that needs nothing but the scene."""
        self._keyframes.visible = bool(self._shows_keyframes.value)
        for node in (self._loops, self._loop_ends, self._gaps):
            node.visible = bool(self._shows_loops.value)
        self._told.visible = bool(self._shows_told.value)
        self._loop_ends.point_size = END_SIZE * self.reach
        for seen, node in self._points.items():
            size = self._sensor.grain * self.reach * float(self._point_size.value)
            node.point_size = 1.5 * size if seen else size
        self.figure.resize_points(size)

    def follow(self, T_world_sensor: Array) -> None:
        """Keep the sensor where every page looks, by moving the world under the viewers' eyes.

        Their eyes are their own: they turn and come closer as they like, and nothing pulls at them.
        """
        if self._follow.value:
            self._world.position = -T_world_sensor[:3, 3]


def dashes(ends: Array) -> NDArray[np.float32]:
    """Return the (D G, 2, 3) dashes between the ends (G, 2, 3) of gaps."""
    at = np.arange(2 * DASHES).reshape(DASHES, 2) / (2 * DASHES - 1)
    start, step = ends[:, None, None, 0], (ends[:, 1] - ends[:, 0])[:, None, None]
    return np.asarray((start + at[..., None] * step).reshape(-1, 2, 3), np.float32)


def panel_html(panel: Panel) -> str:
    """Return the panel as a small table; what is not ours to know is escaped."""
    colour = "#{:02x}{:02x}{:02x}".format(*STATUS_COLOURS.get(panel.status, LANDMARK))
    head = f'<b style="color:{colour}">&#9679; {html.escape(panel.status)}</b>'
    if panel.reason:
        head += f'<div style="opacity:.8">{html.escape(panel.reason)}</div>'
    if panel.news:
        loop = "#{:02x}{:02x}{:02x}".format(*LOOP)
        head += f'<div style="color:{loop}">{html.escape(panel.news)}</div>'
    lines = "".join(
        f'<tr><td style="opacity:.7;padding-right:1em">{html.escape(name)}</td>'
        f"<td>{html.escape(value)}</td></tr>"
        for name, value in panel.rows
    )
    box = "padding:.3em 1em;font-size:.85em;font-variant-numeric:tabular-nums"
    return f'<div style="{box}">{head}<table>{lines}</table></div>'
