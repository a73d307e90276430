"""Draw the pictures of the lesson: `python docs/lesson/images/make_figures.py [NAME ...]`.

All of them come from simulated worlds and from the examples, so that anyone gets the same.
"""

import io
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image

from odomap import SE2, SE3, Trajectory, World, ate
from odomap.geometry.leastsquares import levenberg_marquardt
from odomap.geometry.twoview import essential_matrix, relative_pose
from odomap.views.style import PALETTE, dress, figure_jpeg, figure_png, legend, new_figure

HERE = Path(__file__).parent
BLUE, GREY, RED, GREEN = (PALETTE[name] for name in ("estimate", "truth", "lost", "good"))
ORANGE, INK, MUTED = (PALETTE[name] for name in ("keyframe", "ink", "muted"))


def example(name: str) -> dict[str, Any]:
    """Return the names of an example."""
    return runpy.run_path(str(HERE.parents[2] / "examples" / f"{name}.py"))


def panels(count: int, width: float = 9.6, height: float = 3.2, gap: float = 0.25) -> Any:
    """Return a figure and its axes side by side."""
    figure = new_figure(width, height)
    return figure, figure.subplots(1, count, gridspec_kw={"wspace": gap})


def save_figures(figures: tuple[Callable[[], Figure], ...], names: list[str]) -> None:
    """Draw all figures, or those named, and keep them beside this file."""
    for draw in figures:
        if names and draw.__name__ not in names:
            continue
        if draw is epipolar:  # a photograph
            (HERE / "epipolar.jpg").write_bytes(figure_jpeg(draw(), 85))
            continue
        picture = Image.open(io.BytesIO(figure_png(draw(), 110))).convert("RGB")
        small = picture.quantize(128, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        small.save(HERE / f"{draw.__name__}.png", optimize=True)


def factor_graph() -> Figure:
    """Poses, landmarks, and what was measured between them."""
    figure = Figure(figsize=(8.4, 3.0), facecolor=PALETTE["paper"])
    ax = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    ax.set(xlim=(-0.95, 8.95), ylim=(-0.75, 2.95))
    ax.set_aspect("equal")
    ax.axis("off")
    poses = np.column_stack([np.arange(5) * 2.1, np.zeros(5)])
    landmarks = np.array([[0.9, 2.1], [3.4, 2.3], [5.9, 2.1], [8.2, 2.25]])
    seen = [(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (3, 2), (3, 1), (4, 2), (4, 3), (3, 3)]
    for pose, landmark in seen:
        factor(ax, poses[pose], landmarks[landmark], GREEN)
    for k in range(4):
        factor(ax, poses[k], poses[k + 1], BLUE)
    ax.plot([-0.7, 0], [0, 0], color=MUTED, lw=1.2, zorder=1)
    ax.plot(-0.7, 0, "s", color=INK, ms=6)
    ax.annotate(
        "", poses[4] + [0, -0.33], poses[0] + [0, -0.33],
        arrowprops={"arrowstyle": "-", "color": RED, "lw": 1.4,
                    "connectionstyle": "arc3,rad=0.06"},
    )  # fmt: skip
    ax.plot(4.2, -0.61, "s", color=RED, ms=6)
    for k, (x, y) in enumerate(poses):
        node(ax, x, y, f"$T_{k}$", "white", INK)
    for k, (x, y) in enumerate(landmarks):
        node(ax, x, y, f"$p_{k}$", "#e7f5ef", GREEN)
    for x, y, colour, words in (
        (-0.85, 0.62, INK, "prior:\nwhere the\nworld is"),
        (0.62, 0.22, BLUE, "odometry"),
        (1.6, 1.35, GREEN, "observation"),
        (5.1, -0.68, RED, "loop: the place of $T_0$ seen again"),
    ):
        ax.text(x, y, words, color=colour, fontsize=9, va="center")
    return figure


def node(ax: Axes, x: float, y: float, name: str, fill: str, edge: str) -> None:
    """Draw an unknown."""
    ax.plot(x, y, "o", ms=25, mfc=fill, mec=edge, mew=1.4, zorder=3)
    ax.text(x, y, name, ha="center", va="center", fontsize=11, color=INK, zorder=4)


def factor(ax: Axes, a: np.ndarray, b: np.ndarray, colour: str) -> None:
    """Draw a measurement between two unknowns."""
    ax.plot(*zip(a, b), color=colour, lw=1.2, zorder=1)
    ax.plot(*((a + b) / 2), "s", color=colour, ms=6, zorder=2)


def loop() -> Figure:
    """Drift of a chain of motions, its covariance, and what one loop does to both."""
    count, sigma = 60, np.array([0.03, 0.03, 0.03])
    rng = np.random.default_rng(7)
    step = SE2.from_parts(2 * np.pi / count, [0.5, 0.0])
    true = [SE2.identity()]
    for _ in range(count):
        true.append(true[-1] @ step)
    measured = [step @ SE2.exp(sigma * rng.standard_normal(3)) for _ in range(count)]
    odometry = [SE2.identity()]
    for motion in measured:
        odometry.append(odometry[-1] @ motion)
    edges = [(k, k + 1, motion, sigma) for k, motion in enumerate(measured)]
    again = (0, count, true[-1] @ SE2.exp(0.01 * rng.standard_normal(3)), np.full(3, 0.01))
    figure, axes = panels(2, 9.6, 3.9, 0.12)
    titles = ("odometry alone: errors add up", "one loop, and all poses share the correction")
    for ax, known, title in zip(axes, (edges, [*edges, again]), titles):
        poses, covariances = solve_graph(odometry, known)
        path = np.array([T.t for T in poses])
        truth = np.array([T.t for T in true])
        ax.plot(*truth.T, color=GREY, lw=4, alpha=0.45, label="truth")
        ax.plot(*path.T, color=BLUE, lw=1.6, label="estimate")
        for k in range(10, count + 1, 10):
            ax.add_patch(ellipse(poses[k], covariances[k - 1]))
        if len(known) > count:
            ax.plot(*path[[0, -1]].T, color=RED, lw=2)
        ax.plot(*path[0], "o", color=INK, ms=5)
        ax.plot(*path[-1], "s", color=BLUE, ms=6)
        error = np.sqrt(np.mean(np.sum((path - truth) ** 2, axis=1)))
        dress(ax, title, "x, m")
        ax.text(0.5, 0.5, f"error {error:.2f} m", transform=ax.transAxes, ha="center", color=INK)
        ax.set_aspect("equal")
        ax.set(xlim=(-7.5, 8.5), ylim=(-2.2, 12.2))
    axes[0].set_ylabel("y, m", fontsize=9, color=MUTED)
    axes[0].legend(loc="lower right", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def ellipse(T: SE2, covariance: np.ndarray) -> Ellipse:
    """Return where the position is in 95 of 100 cases."""
    values, vectors = np.linalg.eigh(T.R @ covariance[:2, :2] @ T.R.T)
    width, height = 2 * np.sqrt(5.99 * values)
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse(T.t, width, height, angle=angle, fc="#bcd9ec80", ec=BLUE, lw=0.8)


def solve_graph(start: list[SE2], edges: list[Any]) -> tuple[list[SE2], np.ndarray]:
    """Solve a small pose graph, the first pose held; return poses and their (N, 3, 3)."""
    size = 3 * (len(start) - 1)

    def moved(poses: list[SE2], delta: np.ndarray) -> list[SE2]:
        steps = delta.reshape(-1, 3)
        return [poses[0], *(T @ SE2.exp(d) for T, d in zip(poses[1:], steps))]

    def residual(T_a: SE2, T_b: SE2, T_a_b: SE2, sigma: np.ndarray) -> np.ndarray:
        return (T_a_b.inverse() @ T_a.inverse() @ T_b).log() / sigma

    def linearise(poses: list[SE2]) -> tuple[np.ndarray, np.ndarray]:
        r, J = np.zeros((len(edges), 3)), np.zeros((len(edges), 3, size + 3))
        for e, (a, b, *measured) in enumerate(edges):
            r[e] = residual(poses[a], poses[b], *measured)
            for k, d in enumerate(1e-6 * np.eye(3)):
                shift = SE2.exp(d)
                J[e, :, 3 * a + k] = (residual(poses[a] @ shift, poses[b], *measured) - r[e]) / 1e-6
                J[e, :, 3 * b + k] = (residual(poses[a], poses[b] @ shift, *measured) - r[e]) / 1e-6
        return r.ravel(), J.reshape(-1, size + 3)[:, 3:]

    result = levenberg_marquardt(linearise, start, moved, max_iterations=15)
    blocks = result.covariance.reshape(size // 3, 3, size // 3, 3)
    return result.x, np.array([blocks[k, :, k] for k in range(size // 3)])


def drifting() -> tuple[Trajectory, Trajectory]:
    """Return a path with drift in its own frame and unit, as of a monocular odometry; the truth."""
    truth = World.make(kind="room", seed=3, frames=560, sensors=("mono",)).truth
    T_world_camera, poses = SE3.exp([1.0, 0.5, 0.2, 0.1, 0.5, 0.9]), []
    for k in range(len(truth)):
        if k:
            true_step = truth.pose(k - 1).inverse() @ truth.pose(k)
            drift = SE3.exp([0, 0, 0, 0.0002, 0.0006, 0.0001])
            step = SE3.from_parts(true_step.R, true_step.t * 0.45 * (1 - 0.0005 * k)) @ drift
            T_world_camera = T_world_camera @ step
        poses.append(T_world_camera)
    return Trajectory.of_poses(truth.stamps_ns, poses), truth


def alignment() -> Figure:
    """The same estimate, aligned in three ways."""
    estimate, truth = drifting()
    figure, axes = panels(3, 9.6, 3.5, 0.12)
    ways = (("none", "as it came"), ("se3", "rigid (SE3)"), ("sim3", "with scale (Sim3)"))
    for ax, (way, title) in zip(axes, ways):
        error = ate(estimate, truth, align=way)
        path = estimate.transformed(error.T_reference_estimate).positions
        ax.plot(*truth.positions[:, :2].T, color=GREY, lw=4, alpha=0.45, label="truth")
        ax.plot(*path[:, :2].T, color=BLUE, lw=1.6, label="estimate")
        for k in range(0, len(path), 40):
            ax.plot(*np.stack([path[k], truth.positions[k]])[:, :2].T, color=RED, lw=0.7)
        dress(ax, f"{title}: {error.rmse:.2f} m", "x, m")
        ax.set_aspect("equal")
        ax.set(xlim=(-2.9, 3.3), ylim=(-2.7, 2.7))
    axes[0].set_ylabel("y, m", fontsize=9, color=MUTED)
    axes[0].legend(loc="lower left", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def epipolar() -> Figure:
    """Two images with matches, and the lines on which they must lie."""
    world = World.make(kind="room", seed=4, frames=9, sensors=("mono",))
    camera = world.rig.cameras[0].camera
    start, end = example("02_two_views")["matches"](world, 0, 8)
    first, second = camera.undistort(start), camera.undistort(end)
    found = relative_pose(first, second, 1.0 / camera.fx)
    E = essential_matrix(found.T_second_first)
    chosen = np.flatnonzero(found.inliers)[:: found.num_inliers // 9][:9]
    figure, axes = panels(2, 9.6, 3.25, 0.03)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.92)
    figure.set_dpi(100)
    colours = [PALETTE[f"stage{1 + k % 6}"] for k in range(len(chosen))]
    titles = ("first view: nine corners", "second view: their epipolar lines E x₁, and the matches")
    for ax, index, at, title in zip(axes, (0, 8), (start, end), titles):
        ax.imshow(world.frame(index).images[0], cmap="gray", vmin=0, vmax=255)
        ax.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK)
        ax.axis("off")
        for k, colour in zip(chosen, colours):
            ax.plot(*at[k], "o", ms=7, mfc="none", mec=colour, mew=2)
    for k, colour in zip(chosen, colours):
        line = np.linalg.inv(camera.K).T @ E @ np.append(first[k], 1.0)
        u = np.array([0.0, camera.width - 1.0])
        axes[1].plot(u, -(line[0] * u + line[2]) / line[1], color=colour, lw=1.2)
    axes[1].set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5))
    return figure


def triangulation() -> Figure:
    """Where a point at 4 m is, from three baselines."""
    draw = example("03_points_and_pnp")["triangulated"]
    figure, axes = panels(3, 9.6, 2.9, 0.28)
    for ax, baseline in zip(axes, (0.05, 0.2, 0.8)):
        points, angle = draw(baseline, 4.0, 600)
        ax.plot(points[:, 2], 1000 * points[:, 1], ".", ms=3, color=BLUE, alpha=0.5)
        ax.plot(4.0, 0.0, "+", ms=12, mew=2, color=RED)
        dress(ax, f"baseline {baseline:.2f} m, parallax {angle:.1f}°", "depth z, m")
        ax.set(xlim=(2.4, 6.9), ylim=(-15, 15))
    axes[0].set_ylabel("sideways y, mm", fontsize=9, color=MUTED)
    return figure


def stereo_depth() -> Figure:
    """Errors of stereo depth against depth, and the law they follow."""
    names = example("05_stereo_depth")
    rooms = [names["measure"](seed) for seed in range(4)]
    (z, measured), fb = np.concatenate([depths for depths, _ in rooms]).T, rooms[0][1]
    sigma_d = names["sigma"](fb / measured - fb / z)
    figure, axes = panels(2, 9.6, 3.2, 0.2)
    grid = np.linspace(1.0, 6.5, 100)
    law = 1000 * grid**2 / fb * sigma_d
    dress(axes[0], "corners of four rooms", "true depth z, m", "error of stereo depth, mm")
    axes[0].fill_between(grid, -2 * law, 2 * law, color=PALETTE["band"], label="± 2 z² σ / (f b)")
    axes[0].plot(z, 1000 * (measured - z), ".", ms=3, color=BLUE, alpha=0.6)
    axes[0].set(xlim=(1.0, 6.5), ylim=(-250, 250))
    legend(axes[0])
    dress(axes[1], "200 points, all at one depth", "their depth, m", "")
    depths = np.geomspace(2.0, 300.0, 12)
    sigmas = np.array([names["pose_sigma"](d) for d in depths])
    axes[1].loglog(depths, sigmas[:, 0], "o-", color=BLUE, ms=4, label="position, mm")
    axes[1].loglog(depths, 1000 * sigmas[:, 1], "s-", color=ORANGE, ms=4, label="rotation, 0.001°")
    axes[1].set_ylim(1, 1000)
    axes[1].legend(loc="upper left", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def pitfall_paths() -> Figure:
    """Right motions, chained wrongly and rightly."""
    names = example("06_pitfalls_path")
    walk = World.make(kind="room", seed=0, frames=600, sensors=("mono",)).truth
    truth = walk.rows(np.unique((599 * np.linspace(0, 1, 120) ** 2).astype(int)))
    steps = names["motions"](truth)
    figure, axes = panels(3, 9.6, 3.5, 0.12)
    cases = (
        ("T_prev_cur: right", names["inverted"](steps)),
        ("T_cur_prev as given: wrong", names["as_given"](steps)),
        ("each step 1 long: wrong", names["inverted"](names["of_length_one"](steps))),
    )
    for ax, (title, poses) in zip(axes, cases):
        path = Trajectory.of_poses(truth.stamps_ns, poses)
        error = ate(path, truth, align="sim3")
        shown = path.transformed(error.T_reference_estimate)
        ax.plot(*truth.positions[:, :2].T, color=GREY, lw=4, alpha=0.45, label="truth")
        ax.plot(*shown.positions[:, :2].T, ".-", color=BLUE, lw=1.2, ms=3, label="estimate")
        for T, colour in ((truth, GREY), (shown, RED)):
            at, ahead = T.positions[::10, :2], T.Ts_world_body[::10, :2, 2]
            ax.quiver(*at.T, *ahead.T, color=colour, scale=12, width=0.005, zorder=3)
        dress(ax, title, "x, m")
        ax.set_aspect("equal")
        ax.set(xlim=(-3.6, 3.6), ylim=(-2.6, 2.6))
    axes[0].set_ylabel("y, m", fontsize=9, color=MUTED)
    axes[0].legend(loc="center", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def exercise_1() -> Figure:
    """What the solution of the exercise finds."""
    run = example("exercise_1_solution")["run"]
    figure, axes = panels(2, 9.6, 3.6, 0.2)
    cases = (
        ("room", "sim:room?seed=0&frames=300&sensors=mono"),
        ("street", "sim:street?seed=0&frames=60&sensors=mono"),
    )
    for ax, (name, data) in zip(axes, cases):
        estimate, truth = run(data)
        error = ate(estimate, truth, align="sim3")
        shown = estimate.transformed(error.T_reference_estimate).positions
        ax.plot(*truth.positions[:, :2].T, color=GREY, lw=4, alpha=0.45, label="truth")
        ax.plot(*shown[:, :2].T, color=BLUE, lw=1.4, label="estimate")
        dress(ax, f"{name}: {error.percent:.2f} % of {error.path_m:.1f} m", "x, m", "y, m")
        ax.set_aspect("equal", adjustable="datalim")
    axes[0].legend(fontsize=8, frameon=False, labelcolor=INK)
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    factor_graph, loop, alignment, epipolar, triangulation, stereo_depth, pitfall_paths, exercise_1,
)  # fmt: skip


if __name__ == "__main__":
    save_figures(FIGURES, sys.argv[1:])
