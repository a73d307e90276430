"""Draw the pictures of chapter 4: `python docs/lesson/images/make_figures_4.py [NAME ...]`.

All of them come from simulated worlds and from the examples, so that anyone gets the same.
"""

import sys
from collections.abc import Callable

import numpy as np
from make_figures import BLUE, GREEN, GREY, INK, ORANGE, RED, example, save_figures
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon
from scipy.ndimage import maximum_filter

import odomap
from odomap.geometry.lie import se2_inverse, se2_log
from odomap.geometry.planar import to_plane, transform_planar
from odomap.lidar.grid import beside
from odomap.lidar.scans import Beams
from odomap.views.style import PALETTE, dress, new_figure

Array = np.ndarray
LIGHT = PALETTE["band"]


def laser_scan() -> Figure:
    """What a laser says, as ranges and as points."""
    world = odomap.open("sim:hall?sensors=laser&seed=1&beams=271").world
    mount, k = world.rig.lidars[0], 450
    angles, ranges = np.linspace(*mount.angles), world.frame(k).scan
    T = (world.truth.pose(k) @ mount.T_body_lidar).matrix
    points = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    figure = new_figure(9.6, 3.5)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1, 1.25]})
    dress(left, "what it says: a range for each beam", "direction of the beam, degrees", "range, m")
    left.plot(np.degrees(angles), ranges, ".", color=BLUE, ms=2.5)
    lost = np.isnan(ranges)
    left.plot(
        np.degrees(angles[lost]), np.zeros(lost.sum()), "|", color=RED, ms=9, label="lost (NaN)"
    )
    left.legend(loc="upper left", fontsize=8, frameon=False, labelcolor=INK)
    dress(right, "what it means: points in the laser's frame", "x, m (ahead)", "y, m (left)")
    walls = world.plan.walls.reshape(-1, 2, 2) - T[:2, 3]
    right.add_collection(LineCollection(walls @ T[:2, :2], color=GREY, lw=3, alpha=0.45))
    for p in points[::6]:
        right.plot([0, p[0]], [0, p[1]], color=LIGHT, lw=0.6, zorder=0)
    right.plot(*points.T, ".", color=BLUE, ms=3)
    robot(right, np.zeros(3), INK)
    right.set_aspect("equal", adjustable="datalim")
    return figure


def robot(ax: Axes, x: Array, colour: str, size: float = 0.35, **how: object) -> None:
    """Draw a triangle that points ahead."""
    shape = size * np.array([[1.3, 0.0], [-0.8, 0.8], [-0.8, -0.8]])
    c, s = np.cos(x[2]), np.sin(x[2])
    corners = shape @ np.array([[c, s], [-s, c]]) + x[:2]
    ax.add_patch(Polygon(corners, closed=True, fc=colour, ec="none", zorder=4, **how))


def steps_of_icp(way: str, shown: tuple[int, ...]) -> Figure:
    """Draw two scans before the first step of ICP and after some, with the pairs."""
    names = example("30_icp_step_by_step")
    source, target, T_true = names["two_scans"]()
    steps = list(names["icp"](source, target, names[way]))
    figure = new_figure(9.6, 5.9)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.95)
    axes = figure.subplots(2, 3, gridspec_kw={"wspace": 0.03, "hspace": 0.12})
    for ax, k in zip(axes.flat, shown):
        T, p, q = steps[k]
        x, y, turn = se2_log(se2_inverse(T_true) @ T)
        off = f"{1000 * np.hypot(x, y):.0f} mm, {np.degrees(abs(turn)):.1f}°"
        after = f"after {k} step" + "s" * (k != 1)
        dress(ax, f"{after if k else 'as they came'}: {off} off")
        ax.plot(*target.hits.T, "o", color=GREY, ms=3.2, mew=0)
        ax.add_collection(LineCollection(np.stack([p, q], axis=1), color=ORANGE, lw=1.2))
        ax.plot(*(source.hits @ T[:2, :2].T + T[:2, 2]).T, ".", color=BLUE, ms=2.6)
        ax.set_aspect("equal")
        ax.tick_params(labelbottom=False, labelleft=False, length=0)
    return figure


def icp_steps() -> Figure:
    """Points onto points."""
    return steps_of_icp("onto_points", (0, 2, 5, 10, 20, 40))


def icp_line_steps() -> Figure:
    """Points onto lines, every step."""
    return steps_of_icp("onto_lines", (0, 1, 2, 3, 4, 5))


def icp_convergence() -> Figure:
    """How far off ICP is after each step, points onto points and onto lines."""
    names = example("30_icp_step_by_step")
    source, target, T_true = names["two_scans"]()
    figure = new_figure(7.2, 2.9)
    ax = figure.subplots()
    for way, colour, mark in (("onto_points", BLUE, "o"), ("onto_lines", ORANGE, "s")):
        xi = [
            se2_log(se2_inverse(T_true) @ T) for T, _, _ in names["icp"](source, target, names[way])
        ]
        off = 1000 * np.linalg.norm(np.array(xi)[:, :2], axis=1)
        ax.semilogy(off, mark + "-", color=colour, ms=3.5, lw=1.4, label=way.replace("_", " "))
    dress(ax, "off by, mm", "step")
    ax.set_xlim(-0.5, 40.5)
    ax.legend(loc="upper right", fontsize=9, frameon=False, labelcolor=INK)
    return figure


def compose() -> Figure:
    """One step ahead, read in two frames; and exact motions put together in four ways."""
    names = example("31_compose_motions")
    poses = names["drive"]()
    truth = np.array([T.t for T in poses])
    figure = new_figure(9.6, 4.6)
    grid = figure.add_gridspec(2, 3, width_ratios=[0.8, 1, 1], wspace=0.16, hspace=0.4)
    one_step(figure.add_subplot(grid[:, 0]))
    for n, (name, way) in enumerate(names["WAYS"].items()):
        ax = figure.add_subplot(grid[n // 2, 1 + n % 2])
        path = names["chained"](poses, way)
        is_right = np.linalg.norm(path - truth, axis=1).max() < 1e-6
        colour = BLUE if is_right else RED
        dress(ax, name)
        ax.plot(*truth.T, color=GREY, lw=5, alpha=0.45)
        ax.plot(*path.T, color=colour, lw=1.4)
        ax.plot(*path[0], "o", color=INK, ms=5)
        ax.plot(*path[-1], "s", color=colour, ms=6)
        ax.set_aspect("equal", adjustable="datalim")
    return figure


def one_step(ax: Axes) -> None:
    """Draw a robot that looks north-west, and where "1 m ahead" takes it."""
    dress(ax, "“1 m ahead”", "x, m", "y, m")
    x = np.array([1.0, 0.6, np.radians(120)])
    ahead = x[:2] + np.array([np.cos(x[2]), np.sin(x[2])])
    robot(ax, x, INK, 0.13)
    for end, colour in ((ahead, BLUE), (x[:2] + np.array([1.0, 0.0]), RED)):
        ax.annotate("", end, x[:2], arrowprops={"arrowstyle": "->", "color": colour, "lw": 2})
    words = "in the frame of\nthe previous pose"
    x_text, y_text = ahead + np.array([-0.1, 0.07])
    ax.text(x_text, y_text, words, color=BLUE, fontsize=9, ha="center", va="bottom")
    ax.text(1.55, 0.5, "added in the\nworld frame", color=RED, fontsize=9, ha="center", va="top")
    ax.set_aspect("equal")
    ax.set(xlim=(-0.4, 2.2), ylim=(0.0, 2.1))


def scan_to_map() -> Figure:
    """Paths of a laser in a building, by what scans were laid onto."""
    names = example("32_scan_to_map")
    scans, truth = names["walk"]()
    figure = new_figure(9.6, 3.6)
    left, right = figure.subplots(1, 2, gridspec_kw={"wspace": 0.2})
    start = truth.pose(0).inverse()
    true = np.array([(start @ truth.pose(k)).t for k in range(len(truth))])
    way_m = np.append(0, np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1)))
    left.plot(*true[:, :2].T, color=GREY, lw=5, alpha=0.45)
    for way, colour in (("last scan", RED), ("keyframe", ORANGE), ("map", BLUE)):
        path = names["follow"](scans, way)[:, :3, 3]
        left.plot(*path[:, :2].T, color=colour, lw=1.5)
        off = 100 * np.linalg.norm(path - true, axis=1)
        right.plot(way_m, off, color=colour, lw=1.6, label=f"onto the {way}")
    dress(left, "as seen from the start", "x, m", "y, m")
    left.set_aspect("equal", adjustable="datalim")
    dress(right, "off by, cm", "way, m")
    right.set(xlim=(0, way_m[-1]), ylim=(0, None))
    right.legend(loc="upper left", fontsize=9, frameon=False, labelcolor=INK)
    return figure


def corridor() -> Figure:
    """Two scans in a hall and in a corridor, and how sure the motion between them is."""
    names = example("33_corridor")
    figure = new_figure(9.6, 4.2)
    axes = figure.subplots(
        2, 2, gridspec_kw={"wspace": 0.2, "hspace": 0.5, "width_ratios": [1.3, 1]}
    )
    for (ax, sure), kind in zip(axes, ("hall", "corridor")):
        first, second, T_true, T_wheels = names["two_scans"](kind)
        found = odomap.register(second, first, "plane", max_distance=1.0)
        T = found.se2
        dress(ax, f"{kind}: the scans, registered")
        ax.plot(*first.T, "o", color=GREY, ms=3.5, mew=0)
        ax.plot(*(second @ T[:2, :2].T + T[:2, 2]).T, ".", color=BLUE, ms=2.5)
        for pose, colour in ((np.eye(3), GREY), (T, BLUE), (T_true, GREEN)):
            robot(ax, to_planar(pose), colour, 0.4)
        ax.set_aspect("equal")
        ax.set(xlim=(-4, 10.5), ylim=(-3, 4))
        dress(sure, "where it has gone, m", "along", "across")
        for name, centre, P, colour in (
            ("wheels", T_wheels, names["WHEELS"], ORANGE),
            ("scans", T, None, BLUE),
        ):
            if P is None:
                P = np.linalg.inv(found.information + 1e-3 * np.eye(3))
            sure.add_patch(ellipse(centre[:2, 2], P[:2, :2], colour))
            sure.plot(*centre[:2, 2], ".", color=colour, ms=6, label=name)
        both = names["fused"](T_wheels, T, found.information)
        P = np.linalg.inv(np.linalg.inv(names["WHEELS"]) + found.information)
        sure.add_patch(ellipse(both[:2, 2], P[:2, :2], INK))
        sure.plot(*both[:2, 2], ".", color=INK, ms=6, label="both")
        sure.plot(*T_true[:2, 2], "+", color=GREEN, ms=13, mew=2, label="truth")
        sure.set(xlim=(-0.12, 0.68), ylim=(-0.05, 0.05))
    axes[0, 1].legend(loc="center left", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def to_planar(T: Array) -> Array:
    """Return x, y, heading of a (3, 3) pose."""
    return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])


def ellipse(centre: Array, P: Array, colour: str) -> Ellipse:
    """Return where 95 of 100 are."""
    values, vectors = np.linalg.eigh(P)
    width, height = 2 * np.sqrt(5.99 * np.maximum(values, 1e-9))
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse(centre, width, height, angle=angle, fc=colour, ec=colour, alpha=0.25, lw=1.2)


def log_odds() -> Figure:
    """A wall's cell looked at forty times; how many cells are wrong; a door that opens."""
    names = example("34_log_odds")
    rng = np.random.default_rng(3)
    figure = new_figure(9.6, 3.0)
    axes = figure.subplots(1, 3, gridspec_kw={"wspace": 0.24})
    hits = rng.random((1, 40)) < names["HIT_WALL"]
    is_wall = np.arange(4000) % 2 == 0
    many = (
        rng.random((4000, 100)) < np.where(is_wall, names["HIT_WALL"], names["HIT_FREE"])[:, None]
    )
    door = np.arange(160)[None] < 100
    for name, colour in (("tenths", RED), ("log-odds", GREY), ("with limit", BLUE)):
        believed = names["believed"]
        axes[0].plot(believed(name, hits)[0], "-", color=colour, lw=1.8)
        wrong = 100 * np.mean((believed(name, many) > 0.5) != is_wall[:, None], axis=0)
        axes[1].plot(np.arange(1, 101), wrong[1:], color=colour, lw=1.8)
        axes[2].plot(
            np.arange(161) - 100, believed(name, door)[0], color=colour, lw=1.8, label=name
        )
    axes[0].plot(np.flatnonzero(hits[0]) + 1, np.full(hits.sum(), 1.06), "|", color=INK, ms=6)
    dress(axes[0], "p of a cell of a wall", "looks (ticks: hits)")
    dress(axes[1], "cells that are wrong, %", "looks")
    axes[1].set(xlim=(1, 100), ylim=(-1, 52))
    dress(axes[2], "p of a door", "looks since it opened")
    axes[2].set_xlim(-10, 60)
    axes[2].legend(loc="center right", fontsize=9, frameon=False, labelcolor=INK)
    return figure


def shown_grid(ax: Axes, grid: odomap.OccupancyGrid, title: str) -> None:
    """Draw what is believed: white free, black occupied, grey unknown."""
    part = grid.cropped()
    high = part.origin + part.resolution * np.array(part.log_odds.shape[::-1])
    grey = np.choose(np.sign(part.log_odds).astype(int) + 1, (1.0, 0.8, 0.0))
    extent = (part.origin[0], high[0], part.origin[1], high[1])
    dress(ax, title)
    shown = {"cmap": "gray", "vmin": 0, "vmax": 1, "interpolation": "antialiased"}
    ax.imshow(grey, extent=extent, origin="lower", **shown)
    ax.grid(False)
    ax.set_aspect("equal")


def rays() -> Figure:
    """The grid of a hall where people walk, by what of the beams is used."""
    names = example("35_rays")
    source = odomap.open(names["HALL"])
    frames = list(source)
    figure = new_figure(9.6, 6.1)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.95)
    axes = figure.subplots(2, 2, gridspec_kw={"wspace": 0.03, "hspace": 0.1})
    for ax, (name, options) in zip(axes.flat, names["CASES"].items()):
        shown_grid(ax, names["grid_of"](source, frames, **options), name)
        ax.set(xlim=(-11, 11), ylim=(-6.6, 6.6))
        ax.tick_params(labelbottom=False, labelleft=False, length=0)
    return figure


def grid_loops() -> Figure:
    """The grid of a building without loops and with them, and where it begins."""
    names = example("36_laser_slam")
    source = odomap.open(names["WORLD"])
    figure = new_figure(9.6, 6.4)
    figure.subplots_adjust(left=0.03, right=0.995, bottom=0.05, top=0.95)
    sizes = {"wspace": 0.1, "hspace": 0.12, "height_ratios": [1.1, 1.0]}
    axes = figure.subplots(2, 2, gridspec_kw=sizes).ravel()
    for n, (title, closing) in enumerate((("without loops", False), ("with loops", True))):
        result, _ = names["run"](source, closing)
        grid = odomap.occupancy_grid(result.map, source.rig)
        path = result.trajectory.positions[:, :2]
        for ax, words in ((axes[n], title), (axes[2 + n], "the beginning, " + title)):
            shown_grid(ax, grid, words)
            ax.plot(*path.T, color=BLUE, lw=1.0)
        axes[n].set(xlim=(path[:, 0].min() - 4, path[:, 0].max() + 4))
        axes[2 + n].set(xlim=(-0.5, 10.5), ylim=(-3.2, 2.2))
    return figure


def branch_and_bound() -> Figure:
    """The bound of squares of shifts, ever smaller, at the right heading."""
    names = example("37_branch_and_bound")
    source = odomap.open("sim:hall?sensors=laser&seed=1&beams=181&rate_hz=2")
    walls, corner = source.world.plan.occupied(names["CELL"])
    points = Beams(source.rig.lidars[0]).points(source.frame(40).scan).hits
    x = to_plane(source.truth.Ts_world_body[40])
    cells = np.floor(transform_planar(np.array([0, 0, x[2]]), points) / names["CELL"]).astype(int)
    m = np.pad(np.where(walls, 1.0, 0.5 * beside(walls)), 256)
    figure = new_figure(7.6, 5.5)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.95)
    axes = figure.subplots(2, 2, gridspec_kw={"wspace": 0.04, "hspace": 0.1})
    height, width = walls.shape
    for ax, h in zip(axes.flat, (5, 4, 3, 0)):
        level = maximum_filter(m, size=1 << h, origin=-((1 << h) // 2) if h else 0)
        side = 1 << h
        columns, rows = (256 + cells[:, k] for k in (0, 1))
        score = np.array([
            [level[rows + v, columns + u].mean() for u in range(0, width, side)]
            for v in range(0, height, side)
        ])  # fmt: skip
        extent = (0, side * score.shape[1], 0, side * score.shape[0])
        ax.imshow(
            score,
            cmap="Blues",
            vmin=0,
            vmax=1,
            origin="lower",
            extent=extent,
            interpolation="nearest",
        )
        at = (x[:2] - corner) / names["CELL"]
        ax.plot(*at, "o", ms=12, mfc="none", mec=RED, mew=1.6)
        words = f"bounds, squares of {side} cells" if h else "scores of all shifts"
        dress(ax, f"{words}: {score.max():.2f} at most")
        ax.grid(False)
        ax.tick_params(labelbottom=False, labelleft=False, length=0)
        ax.set(xlim=(0, width), ylim=(0, height))
    return figure


def exercise_3() -> Figure:
    """What the solution of the exercise finds."""
    names = example("exercise_3_solution")
    figure: Figure = names["draw"](*names["answer"]()[1:])
    return figure


def exercise_4() -> Figure:
    """What the solution of the exercise finds."""
    names = example("exercise_4_solution")
    grid, source, _ = names["answer"]()
    figure: Figure = names["draw"](grid, source.world.plan.walls)
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    laser_scan, icp_steps, icp_line_steps, icp_convergence, compose, scan_to_map, corridor,
    log_odds, rays, grid_loops, branch_and_bound, exercise_3, exercise_4,
)  # fmt: skip


if __name__ == "__main__":
    save_figures(FIGURES, sys.argv[1:])
