"""Draw the pictures of chapter 5: `python docs/lesson/images/make_figures_5.py [NAME ...]`.

All of them come from the examples and from blocks of the chapter, so that anyone gets the same.
"""

import sys
from collections.abc import Callable

import numpy as np
from make_figures import BLUE, GREEN, GREY, INK, MUTED, ORANGE, RED, example, panels, save_figures
from matplotlib.figure import Figure

from odomap import Loss, PoseGraph, Trajectory, ate, solve
from odomap.backend.graphs.initialization import spanning_tree
from odomap.backend.sparse.blocks import BlockPattern
from odomap.geometry.lie import se2_exp
from odomap.views.style import PALETTE, dress, new_figure


def spread_drift() -> Figure:
    """One walk, five ways to correct it, and where each of them puts the error of heading."""
    names = example("12_spread_the_drift")
    _, paths = names["walk"](1)
    truth = paths["truth"]
    figure = new_figure(9.6, 5.6)
    axes = figure.subplots(2, 3, gridspec_kw={"wspace": 0.16, "hspace": 0.42}).ravel()
    for ax, (name, path) in zip(axes, list(paths.items())[1:]):
        ax.plot(*truth[:, :2, 2].T, color=GREY, lw=4, alpha=0.45, label="truth")
        ax.plot(*path[:, :2, 2].T, color=BLUE, lw=1.6, label="estimate")
        ax.plot(*path[40, :2, 2], "D", color=ORANGE, ms=5)
        ax.plot(*path[0, :2, 2], "o", color=INK, ms=5)
        ax.plot(*path[-1, :2, 2], "s", color=BLUE, ms=5)
        dress(ax, f"{name}: {names['ate'](path, truth):.2f} m")
        ax.set_aspect("equal")
        ax.set(xlim=(-4, 40), ylim=(-20, 15))
    axes[0].text(21.5, -2.2, "the corner", fontsize=8, color=MUTED)
    axes[0].legend(loc="lower right", fontsize=8, frameon=False, labelcolor=INK)
    axes[3].set_xlabel("x, m", fontsize=9, color=MUTED)
    colours = {"gap spread": MUTED, "motion spread": ORANGE, "graph": BLUE}
    ax, metres = axes[5], 0.5 * np.arange(len(truth))
    true = heading(truth) - heading(paths["odometry"])
    ax.plot(metres, true, color=GREY, lw=4, alpha=0.45, label="needed")
    for name, colour in colours.items():
        added = heading(paths[name]) - heading(paths["odometry"])
        ax.plot(metres, added, color=colour, lw=1.6, label=name)
    dress(ax, "turn added to odometry, degrees", "way, m")
    ax.legend(
        loc="lower right", bbox_to_anchor=(1.0, 0.08), fontsize=8, frameon=False, labelcolor=INK
    )
    return figure


def heading(Ts: np.ndarray) -> np.ndarray:
    """Return headings along a path, degrees, without jumps."""
    return np.degrees(np.unwrap(np.arctan2(Ts[:, 1, 0], Ts[:, 0, 0])))


def elimination() -> Figure:
    """The blocks of a normal matrix and of its factor, in two orders."""
    names = example("14_sparsity")
    pattern = names["city"](250)
    orders = names["orders"](pattern)
    figure, axes = panels(2, 9.6, 4.9, 0.08)
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.06, top=0.9)
    titles = ("numbered as they came", "in order of minimum degree")
    for ax, title, order in zip(axes, titles, (orders["as they came"], orders["minimum degree"])):
        given, filled = fill(pattern, order)
        n = len(order)
        size = (72 * 4.4 / n) ** 2
        for (row, column), colour, label in (
            (np.nonzero(np.tril(filled & ~given)), ORANGE, "fill: in L only"),
            (np.nonzero(given), BLUE, "in H"),
        ):
            ax.scatter(column, row, s=size, marker="s", lw=0, color=colour, label=label)
        blocks = int(np.tril(filled).sum())
        dress(ax, f"{title}: {blocks:,} blocks in L")
        ax.grid(False)
        ax.set_aspect("equal")
        ax.set(xlim=(-2, n + 1), ylim=(n + 1, -2), xticks=[], yticks=[])
    axes[0].legend(loc="lower left", fontsize=8, frameon=False, labelcolor=INK, markerscale=3)
    return figure


def fill(pattern: BlockPattern, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which blocks of H, permuted, are given, and which its elimination fills."""
    n, place = len(order), np.argsort(order)
    given = np.eye(n, dtype=bool)
    i, j = place[pattern.first], place[pattern.second]
    given[i, j] = given[j, i] = True
    filled = given.copy()
    for k in range(n):
        later = k + 1 + np.flatnonzero(filled[k + 1 :, k])
        filled[np.ix_(later, later)] = True  # its neighbours come to know each other
    return given, filled


def winding() -> Figure:
    """A ring that begins with one round too many, and cannot get rid of it."""
    figure, axes = panels(3, 9.6, 3.5, 0.1)
    count = 48
    k = np.arange(count)
    steps = np.tile(se2_exp([1.0, 0.0, 2 * np.pi / count]), (count, 1, 1))
    information = np.tile(np.diag([100.0, 100.0, 400.0]), (count, 1, 1))
    Ts = se2_exp(np.stack([0 * k, 0 * k, 4 * np.pi * k / count], axis=1))
    Ts[:, :2, 2] = -count / (4 * np.pi) * Ts[:, :2, 1]
    Ts = Ts @ se2_exp(np.random.default_rng(0).normal(0.0, [0.3, 0.3, 0.2], (count, 3)))
    graph = PoseGraph("SE2", Ts, k, (k + 1) % count, steps, information)
    twice, once = (solve(graph, initial=start) for start in ("given", "chordal"))
    cases = (
        ("a start: twice round", Ts),
        (f"from there: cost {twice.cost_after:.0f}, converged", twice.Ts_world_node),
        (f"from the chordal start: cost {once.cost_after:.0f}", once.Ts_world_node),
    )
    for ax, (title, found) in zip(axes, cases):
        at = found[:, :2, 2] - found[:, :2, 2].mean(axis=0)
        ax.plot(*np.vstack([at, at[:1]]).T, ".-", color=BLUE, lw=1.2, ms=4)
        ax.quiver(*at[::3].T, *found[::3, :2, 0].T, color=RED, scale=11, width=0.008, zorder=3)
        dress(ax, title, "x, m")
        ax.set_aspect("equal")
        ax.set(xlim=(-9.5, 9.5), ylim=(-9.5, 9.5))
    axes[1].text(
        0, 0, "two rounds,\none on the other", ha="center", va="center", color=MUTED, fontsize=8
    )
    axes[0].set_ylabel("y, m", fontsize=9, color=MUTED)
    return figure


def spheres() -> Figure:
    """A noisy sphere: a poor start, where it ends, and where a good one ends."""
    names = example("15_start_and_proof")
    graph, truth = names["sphere"](0.2, 0.25)
    poor, good = (solve(graph, initial=start) for start in ("spanning_tree", "chordal"))
    cases = (
        ("start: a spanning tree", spanning_tree(graph), None),
        ("from there: a local minimum", poor.Ts_world_node, poor.chi2),
        ("from the chordal start", good.Ts_world_node, good.chi2),
    )
    figure = new_figure(9.6, 3.6)
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.9, wspace=0.0)
    for k, (title, Ts, chi2) in enumerate(cases):
        ax = figure.add_subplot(1, 3, k + 1, projection="3d")
        error = ate(Trajectory(truth.stamps_ns, Ts), truth)
        at = error.T_reference_estimate @ Ts[:, :3, 3]
        for e in range(graph.num_edges):
            is_bad = chi2 is not None and chi2[e] > 22.5  # one of a thousand with six numbers
            colour = RED if is_bad else (PALETTE["stage2"] if graph.is_loop[e] else BLUE)
            width = 2.0 if is_bad else (0.5 if graph.is_loop[e] else 0.9)
            ax.plot(*at[[graph.first[e], graph.second[e]]].T, color=colour, lw=width)
        ax.set_title(f"{title}: {error.rmse:.2f} m", fontsize=10, fontweight="bold", color=INK)
        ax.set_axis_off()
        ax.set_facecolor("none")
        ax.view_init(elev=-25, azim=-60)
        reach = 10.5 if k else 18.0
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
        ax.set_box_aspect((1, 1, 1), zoom=1.45)
    return figure


def losses() -> Figure:
    """Losses, and how much an edge then counts."""
    figure, axes = panels(2, 9.6, 3.0, 0.16)
    r = np.linspace(0.0, 8.0, 300)
    shown = (
        ("quadratic", MUTED), ("huber", BLUE), ("cauchy", GREEN), ("geman_mcclure", ORANGE),
        ("truncated", RED),
    )  # fmt: skip
    for name, colour in shown:
        loss = Loss(name)
        axes[0].plot(r, loss.cost(r * r), color=colour, lw=1.6, label=name)
        axes[1].plot(r, loss.weight(r * r), color=colour, lw=1.6)
    dress(axes[0], "ρ(r²)", "residual r, standard deviations")
    dress(axes[1], "weight ρ'(r²)", "residual r, standard deviations")
    axes[0].set(ylim=(0, 25), xlim=(0, 8))
    axes[1].set(xlim=(0, 8))
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="upper right", bbox_to_anchor=(0.98, 0.85),
        fontsize=8, frameon=False, labelcolor=INK,
    )  # fmt: skip
    return figure


def false_loops() -> Figure:
    """A city with forty false loops, solved in three ways, and one with a single one."""
    names = example("16_false_loops")
    figure, axes = panels(4, 9.6, 2.75, 0.06)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.02, top=0.9)
    cases = ((1, "quadratic"), (40, "quadratic"), (40, "cauchy"), (40, "gnc"))
    for ax, (num_false, way) in zip(axes, cases):
        graph, truth = names["city"](4, num_false)
        found = solve(graph, **names["WAYS"][way])
        error = names["ate"](found.Ts_world_node, truth)
        at, true = ((Ts - Ts.mean(axis=0))[:, :2, 2] for Ts in (found.Ts_world_node, truth))
        angle = np.angle(np.vdot(at @ [1, 1j], true @ [1, 1j]))
        at = at @ se2_exp([0.0, 0.0, angle])[:2, :2].T
        is_false = np.arange(graph.num_edges) >= graph.num_edges - num_false
        ax.plot(*true.T, color=GREY, lw=3, alpha=0.45)
        ax.plot(*at.T, color=BLUE, lw=1.1)
        for e in np.flatnonzero(is_false):
            shown = (
                {"color": MUTED, "lw": 0.5, "ls": ":"}
                if way == "gnc"
                else {"color": RED, "lw": 0.8}
            )
            ax.plot(*at[[graph.first[e], graph.second[e]]].T, **shown)
        title = {"quadratic": "no loss", "cauchy": "Cauchy", "gnc": "GNC"}[way]
        dress(ax, f"{num_false} false, {title}: {error:.1f} m")
        ax.set_aspect("equal")
        ax.set(xlim=(-20, 10), ylim=(-15, 15), xticks=[], yticks=[])
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    spread_drift, elimination, winding, spheres, losses, false_loops,
)  # fmt: skip


if __name__ == "__main__":
    save_figures(FIGURES, sys.argv[1:])
