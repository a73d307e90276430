"""Draw the pictures of chapter 3c: `python docs/lesson/images/make_figures_3c.py [NAME ...]`.

All of them come from simulated worlds and from the examples, so that anyone gets the same.
"""

import sys
from collections.abc import Callable

import numpy as np
from make_figures import BLUE, GREEN, GREY, INK, MUTED, ORANGE, RED, example, panels, save_figures
from make_figures_3 import arrow, box
from matplotlib.figure import Figure

from odomap import covariances, solve
from odomap.views.style import PALETTE, dress, new_figure


def loop_steps() -> Figure:
    """From a new keyframe to a corrected map, and who may say no."""
    figure = Figure(figsize=(9.6, 2.3), facecolor=PALETTE["paper"])
    ax = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    ax.set(xlim=(0, 19.2), ylim=(0.5, 5.1))
    ax.axis("off")
    steps = (
        ("words:\ncandidates", GREEN, "looks like\nnothing"),
        ("pairs of\nlandmarks", BLUE, "few\nmatches"),
        ("similarity,\nRANSAC", BLUE, "few\ninliers"),
        ("guided\nsearch", BLUE, "narrow, or\nlittle there"),
        ("odometry,\nother loops", ORANGE, "contra-\ndiction"),
        ("correct,\nfuse", INK, ""),
        ("adjust\nall", INK, ""),
    )
    for k, (words, colour, refusal) in enumerate(steps):
        x = 0.2 + 2.75 * k
        box(ax, x, 2.9, 2.2, 1.5, words, colour)
        if k:
            arrow(ax, (x - 0.55, 3.65), (x, 3.65), INK)
        if refusal:
            arrow(ax, (x + 1.1, 2.9), (x + 1.1, 1.75), RED)
            ax.text(x + 1.1, 1.6, refusal, fontsize=9, color=RED, ha="center", va="top")
    for x, width, words in ((0.2, 2.2, "looks"), (2.95, 7.7, "geometry of two sides"),
                            (11.2, 2.2, "the path"), (13.95, 4.95, "the map")):  # fmt: skip
        ax.plot([x, x + width], [4.62, 4.62], color=MUTED, lw=1.0)
        ax.text(x + width / 2, 4.68, words, fontsize=9, color=MUTED, ha="center", va="bottom")
    return figure


def scale_drift() -> Figure:
    """A ring walked with one camera: no loop, a loop of poses, a loop of similarities."""
    names = example("26_scale_drift")
    true = names["walk"]()[0][:, :3, 3]
    figure, axes = panels(3, 9.6, 3.5, 0.2)
    for ax, (name, (_, _, found)) in zip(axes, names["main"]().items()):
        ax.plot(*np.append(true, true[:1], 0)[:, [0, 2]].T, color=GREY, lw=5, alpha=0.45)
        ax.plot(*found[:, [0, 2]].T, "o-", color=BLUE, ms=2.4, lw=1.2)
        dress(ax, name, "x, m")
        ax.set_aspect("equal", adjustable="datalim")
    axes[0].set_ylabel("z, m", fontsize=9, color=MUTED)
    return figure


def surer() -> Figure:
    """The standard deviation of positions along a ring, without and with its loop."""
    ring = example("27_surer_after_a_loop")["ring"]
    figure = new_figure(7.2, 3.2)
    ax = figure.subplots()
    for loops, colour, label in ((0, MUTED, "odometry"), (1, BLUE, "one loop")):
        P = covariances(solve(ring(0, loops)[0]).graph)
        sigma = np.sqrt(np.trace(P[:, :2, :2], axis1=1, axis2=2))
        off = np.zeros((30, len(P)))
        for seed in range(30):
            graph, Ts = ring(seed, loops)
            off[seed] = np.linalg.norm((solve(graph).Ts_world_node - Ts)[:, :2, 2], axis=1)
        ax.plot(off.T, color=colour, lw=0.5, alpha=0.3)
        ax.plot(sigma, color=colour, lw=2.6, label=label)
    dress(ax, "position off by, m", "pose")
    ax.set(xlim=(0, 59), ylim=(0, None))
    ax.legend(loc="upper left", fontsize=9, frameon=False, labelcolor=INK)
    return figure


def exercise_5() -> Figure:
    """What the solution of the exercise finds."""
    names = example("exercise_5_solution")
    figure: Figure = names["draw"](*names["answer"]()[1:])
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (loop_steps, scale_drift, surer, exercise_5)


if __name__ == "__main__":
    save_figures(FIGURES, sys.argv[1:])
