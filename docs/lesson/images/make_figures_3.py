"""Draw the pictures of chapter 3: `python docs/lesson/images/make_figures_3.py [NAME ...]`.

All of them come from simulated worlds and from the examples, so that anyone gets the same.
"""

import sys
from collections.abc import Callable

import numpy as np
from make_figures import BLUE, GREEN, GREY, INK, MUTED, ORANGE, RED, example, panels, save_figures
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

import odomap
from odomap.views.covisibility import MapView
from odomap.views.style import PALETTE, dress
from odomap.vision.orb import OrbConfig, extract


def forgets() -> Figure:
    """Four rounds there and back: an odometry's error grows, and its keyframes; a map's do not."""
    names = example("18_odometry_forgets")
    results, rounds = names["main"](), np.arange(1, 5)
    figure, axes = panels(2, 9.6, 2.9, 0.2)
    for name, colour, label in (("RgbdVO", MUTED, "odometry"), ("Slam", BLUE, "SLAM")):
        off, keyframes, _ = np.array(results[name]).T
        axes[0].plot(rounds, off, "o-", color=colour, lw=1.8, label=label)
        axes[1].plot(rounds, keyframes, "o-", color=colour, lw=1.8, label=label)
    dress(axes[0], "off by, where the walk began, mm", "round")
    dress(axes[1], "keyframes", "round")
    for ax in axes:
        ax.set(xticks=rounds, ylim=(0, None))
    axes[0].legend(loc="upper left", fontsize=9, frameon=False, labelcolor=INK)
    return figure


def threads() -> Figure:
    """Three agents, one map: what is handed from one to the next."""
    figure = Figure(figsize=(9.6, 4.2), facecolor=PALETTE["paper"])
    ax = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    ax.set(xlim=(0, 19.2), ylim=(0, 8.4))
    ax.axis("off")
    rows = (
        (6.3, "tracking", "each frame", BLUE, (
            "features", "pose from\nthe last frame", "local map:\nsearch, pose", "keyframe?")),
        (3.35, "local mapping", "each keyframe", ORANGE, (
            "fuse", "create points", "adjust\nthe window", "cull points,\nkeyframes")),
        (0.4, "loop closing", "each keyframe\n(the next part)", GREEN, (
            "seen before?", "check by\ngeometry", "correct\nthe graph", "adjust all")),
    )  # fmt: skip
    for y, name, when, colour, steps in rows:
        ax.text(0.1, y + 1.05, name, fontsize=11, fontweight="bold", color=colour, va="center")
        ax.text(0.1, y + 0.4, when, fontsize=9, color=MUTED, va="center")
        for k, step in enumerate(steps):
            box(ax, 3.6 + 2.95 * k, y, 2.45, 1.5, step, colour)
            if k:
                arrow(ax, (3.1 + 2.95 * k, y + 0.75), (3.6 + 2.95 * k, y + 0.75), colour)
    arrow(ax, (2.6, 7.05), (3.6, 7.05), INK)
    ax.text(2.55, 7.95, "image", fontsize=9, color=INK, ha="center")
    arrow(ax, (13.6, 6.3), (4.9, 4.85), INK)
    ax.text(8.3, 5.75, "keyframe", fontsize=9, color=INK, ha="right")
    arrow(ax, (13.6, 3.35), (4.9, 1.9), INK)
    ax.text(8.3, 2.8, "keyframe", fontsize=9, color=INK, ha="right")
    box(ax, 16.5, 0.4, 2.5, 7.4, "the map\n\nkeyframes\nmap points\nwho sees\nwhat", INK)
    for y, colour in ((6.3, BLUE), (3.35, ORANGE), (0.4, GREEN)):
        arrow(ax, (16.45, y + 1.05), (14.95, y + 1.05), colour)
        arrow(ax, (14.95, y + 0.45), (16.45, y + 0.45), colour)
    ax.text(15.7, 7.55, "reads", fontsize=8, color=MUTED, ha="center")
    ax.text(15.7, 6.4, "writes", fontsize=8, color=MUTED, ha="center")
    return figure


def box(ax: Axes, x: float, y: float, w: float, h: float, words: str, colour: str) -> None:
    """Draw a box with words in it."""
    shape = FancyBboxPatch(
        (x, y), w, h, boxstyle="round,pad=0,rounding_size=0.18", fc="white", ec=colour, lw=1.4
    )
    ax.add_patch(shape)
    ax.text(x + w / 2, y + h / 2, words, ha="center", va="center", fontsize=9, color=INK)


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    """Draw an arrow."""
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.2})


def rhythms() -> Figure:
    """What runs when: inline, lockstep and live, for the same eight frames."""
    figure = Figure(figsize=(9.6, 4.4), facecolor=PALETTE["paper"])
    ax = figure.add_axes((0.135, 0.1, 0.85, 0.86))
    period, track, work = 50.0, 22.0, 75.0
    for y, name, words in (
        (4.6, "inline", "one thread"),
        (2.4, "lockstep", "the change is due\nbefore frame k + 1"),
        (0.2, "live", "the change comes\nwhen it is ready"),
    ):
        ax.text(-78, y + 0.95, name, fontsize=10, fontweight="bold", color=INK, va="center")
        ax.text(-78, y + 0.4, words, fontsize=8, color=MUTED, va="center")
        now, due = 0.0, None
        for n in range(8):
            shown = n * period
            ax.plot([shown, shown], [y - 0.05, y + 1.35], color=GREY, lw=0.7, alpha=0.6, zorder=0)
            if name == "live" and now > shown + period:
                continue
            if name == "lockstep" and due is not None:
                if due > max(now, shown):
                    bar(ax, max(now, shown), due, y + 0.75, "none", "", MUTED)
                now, due = max(now, shown, due), None
            start = max(now, shown)
            bar(ax, start, start + track, y + 0.75, BLUE, str(n), BLUE)
            now = start + track
            if n in (0, 4):
                if name == "inline":
                    bar(ax, now, now + work, y + 0.75, ORANGE, "map", ORANGE)
                    now += work
                else:
                    bar(ax, now, now + work, y + 0.1, ORANGE, "map", ORANGE)
                    due = now + work
                    after = due if name == "lockstep" else np.ceil(due / period) * period
                    ax.plot([after, after], [y + 0.1, y + 1.3], color=RED, lw=1.6)
    ax.set(xlim=(-80, 425), ylim=(-0.1, 6.2), yticks=[], xticks=np.arange(0, 401, 50))
    ax.tick_params(labelsize=8, colors=MUTED, length=0)
    ax.set_xlabel(
        "milliseconds; grey lines: images come; red: the change is written", fontsize=9, color=MUTED
    )
    for side in ax.spines.values():
        side.set_visible(False)
    return figure


def bar(ax: Axes, start: float, end: float, y: float, fill: str, word: str, edge: str) -> None:
    """Draw what a thread does from one time to another."""
    ax.barh(y + 0.25, end - start, 0.5, start, color=fill, ec=edge, lw=1.0, alpha=0.9)
    ax.text((start + end) / 2, y + 0.25, word, ha="center", va="center", fontsize=8, color="white")


def orb_features() -> Figure:
    """Features on an image: levels as circles, angles as strokes; and the strongest ones alone."""
    world = odomap.World.make(kind="room", seed=4, frames=1, sensors=("mono",))
    image = world.frame(0).images[0]
    found = extract(image, OrbConfig(count=300))
    from odomap.vision.fast import fast_corners

    corners = fast_corners(image, 7, 16)[0]
    strongest = corners[np.argsort(-corners[:, 2], kind="stable")[:300], :2]
    figure, axes = panels(2, 9.6, 3.3, 0.03)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.91)
    for ax in axes:
        ax.imshow(image, cmap="gray", vmin=0, vmax=330)
        ax.set(xticks=[], yticks=[])
    radius = 8 * 1.2 ** found.level.astype(float)
    turn = np.linspace(0, 2 * np.pi, 24)
    circles = found.keypoints[:, None] + radius[:, None, None] * np.stack(
        [np.cos(turn), np.sin(turn)], axis=1
    )
    angle = np.radians(found.angle)
    tips = found.keypoints + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    axes[0].add_collection(LineCollection(list(circles), colors=ORANGE, lw=0.8))
    strokes = list(np.stack([found.keypoints, tips], axis=1))
    axes[0].add_collection(LineCollection(strokes, colors=ORANGE, lw=0.8))
    axes[1].plot(*strongest.T, "o", ms=4, mfc="none", mec=ORANGE, mew=0.9)
    for ax, title in zip(
        axes, ("300 features, spread over cells and levels", "the 300 strongest corners")
    ):
        ax.set_title(title, fontsize=10, fontweight="bold", color=INK)
        ax.set(xlim=(0, 639), ylim=(399, 0))
    return figure


def covisibility() -> Figure:
    """The covisibility graph of a walk round a room, from above, and as a matrix."""
    source = odomap.open("sim:room?seed=4&frames=74&sensors=mono,depth&speed=4")
    system = odomap.Slam(source.rig)
    for frame in source:
        system.track(frame)
    view = MapView.of(system.map, least=15)
    first = source.truth.pose(0)
    keyframes, landmarks = first @ view.keyframes, first @ view.landmarks
    figure, axes = panels(2, 9.6, 4.0, 0.1)
    figure.subplots_adjust(left=0.05, right=0.95)
    ax = axes[0]
    wall = (landmarks[:, 2] > 0.2) & (landmarks[:, 2] < 2.4)
    ax.plot(*landmarks[wall, :2].T, ".", color=GREY, ms=1.2, alpha=0.5)
    strength = np.clip(view.shared / 300, 0.05, 1.0)
    order = np.argsort(strength)
    lines = LineCollection(
        list(keyframes[view.pairs[order], :2]), colors=GREEN, lw=0.3 + 2.2 * strength[order],
        alpha=0.55,
    )  # fmt: skip
    ax.add_collection(lines)
    ax.plot(*keyframes[:, :2].T, "o", color=BLUE, ms=4)
    dress(ax, f"{len(keyframes)} keyframes, {view.num_pairs} pairs share 15 points or more", "x, m")
    ax.set_aspect("equal")
    ids = system.map.keyframe_ids
    sees = np.array(
        [np.isin(system.map.landmark_ids, system.map.observations_of(k)[0]) for k in ids]
    )
    shared = sees.astype(int) @ sees.T.astype(int)
    np.fill_diagonal(shared, 0)
    image = axes[1].imshow(np.where(shared >= 15, shared, np.nan), cmap="Greens", vmin=0)
    figure.colorbar(image, ax=axes[1], fraction=0.046, pad=0.03).ax.tick_params(labelsize=8)
    dress(axes[1], "shared points, keyframe by keyframe")
    axes[1].grid(False)
    return figure


def local_window() -> Figure:
    """The bundle of a window: what moves, what holds it, and what is left out."""
    figure = Figure(figsize=(9.6, 3.1), facecolor=PALETTE["paper"])
    ax = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    ax.set(xlim=(0, 19.2), ylim=(-0.6, 5.6))
    ax.axis("off")
    poses = np.column_stack([1.6 + 2.3 * np.arange(8), np.full(8, 0.7)])
    points = np.column_stack([1.4 + 1.62 * np.arange(11), 3.9 + 0.35 * np.sin(2.4 * np.arange(11))])
    free = np.array([False] * 4 + [True] * 3 + [False])
    free[7], free[3] = True, False
    seen = [(k, j) for k in range(8) for j in range(11) if abs(poses[k, 0] - points[j, 0]) < 2.7]
    moved = {j for k, j in seen if free[k]}
    for k, j in seen:
        colour = BLUE if free[k] else (ORANGE if j in moved else GREY)
        ax.plot(*zip(poses[k], points[j]), color=colour, lw=1.1, alpha=0.9 if j in moved else 0.35)
    holds = {k for k, j in seen if j in moved and not free[k]}
    for j, p in enumerate(points):
        ax.plot(*p, "o", ms=11, mfc="white", mec=GREEN if j in moved else GREY, mew=1.6, zorder=3)
    for k, p in enumerate(poses):
        colour = BLUE if free[k] else (ORANGE if k in holds else GREY)
        ax.plot(*p, "^", ms=17, mfc="white", mec=colour, mew=1.8, zorder=3)
        ax.text(
            p[0], p[1] - 0.08, str(k), ha="center", va="center", fontsize=8, color=INK, zorder=4
        )
    for x, words, colour in (
        (3.9, "left out", MUTED), (8.5, "held where it is", ORANGE), (14.2, "adjusted", BLUE),
    ):  # fmt: skip
        ax.text(x, -0.35, words, ha="center", fontsize=10, color=colour)
    ax.text(
        14.4,
        5.1,
        "map points that an adjusted keyframe sees: adjusted",
        ha="center",
        fontsize=10,
        color=GREEN,
    )
    return figure


def hanging() -> Figure:
    """A loop closed: frames that kept their poses, and frames that hang from keyframes."""
    names = example("23_hang_from_keyframes")
    true, paths = names["walk"](0.0), names["main"]()
    figure, axes = panels(2, 9.6, 4.0, 0.12)
    for ax, (name, path) in zip(axes, paths.items()):
        ax.plot(*np.array([T.t for T in true])[:, :2].T, color=GREY, lw=5, alpha=0.45)
        ax.plot(*path[:, :2].T, color=BLUE, lw=0.9)
        ax.plot(*path[::4, :2].T, "o", color=ORANGE, ms=3)
        dress(ax, f"frames {name}", "x, m")
        ax.set_aspect("equal")
    axes[0].set_ylabel("y, m", fontsize=9, color=MUTED)
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    forgets, threads, rhythms, orb_features, covisibility, local_window, hanging,
)  # fmt: skip


if __name__ == "__main__":
    save_figures(FIGURES, sys.argv[1:])
