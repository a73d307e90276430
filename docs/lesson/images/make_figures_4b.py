"""Draw the pictures of chapter 4's second part: `python docs/lesson/images/make_figures_4b.py`.

All of them come from simulated worlds and from the examples, so that anyone gets the same.
"""

import sys
from collections.abc import Callable

import numpy as np
from make_figures import BLUE, GREEN, GREY, INK, ORANGE, RED, example, panels, save_figures
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

import odomap
from odomap.geometry.lie import se3_inverse
from odomap.lidar.deskew import deskew
from odomap.lidar.featureconfig import LegoConfig
from odomap.lidar.featurepicking import EDGE, PLANE
from odomap.lidar.loam import LoamFrontEnd
from odomap.lidar.rangeimage import find_clusters, find_ground, range_image
from odomap.lidar.scanlines import scan_lines
from odomap.lidar.sweeps import points_of
from odomap.maps.cloudmap import cloud_of_map
from odomap.views.style import dress, new_figure

Array = np.ndarray


def sweep_patterns() -> Figure:
    """When and where the beams of two patterns go, and a sweep from above."""
    figure, axes = panels(3, 9.6, 3.3, 0.28)
    turning = odomap.open("sim:street?sensors=lidar3d&beams=16&seed=1").frame(5).cloud
    prisms = odomap.open("sim:street?sensors=lidar3d&beams=6&seed=1&pattern=solid_state")
    p = turning.points[turning.points[:, 2] > -1.2]
    dress(axes[0], "a sweep from above", "x, m (ahead)", "y, m (left)")
    t = turning.times[turning.points[:, 2] > -1.2]
    axes[0].scatter(p[:, 0], p[:, 1], c=t, s=1.2, cmap="viridis", lw=0)
    axes[0].plot(0, 0, "s", color=RED, ms=5)
    axes[0].set_aspect("equal")
    axes[0].set(xlim=(-32, 32), ylim=(-32, 32))
    for ax, cloud, name in (
        (axes[1], turning, "rotating, 16 beams"),
        (axes[2], prisms.frame(5).cloud, "solid-state, 6 beams"),
    ):
        dress(ax, name, "azimuth, degrees", "elevation, degrees")
        flat = np.hypot(cloud.points[:, 0], cloud.points[:, 1])
        elevation = np.degrees(np.arctan2(cloud.points[:, 2], flat))
        azimuth = np.degrees(np.arctan2(cloud.points[:, 1], cloud.points[:, 0]))
        ax.scatter(azimuth, elevation, c=1000 * cloud.times, s=0.8, cmap="viridis", lw=0)
        ax.set(xlim=(185, -185) if ax is axes[1] else (45, -45), ylim=(-45, 45))
    axes[1].set_xticks([180, 90, 0, -90, -180])
    return figure


def deskewing() -> Figure:
    """Walls at a corner, of six sweeps at their true poses, as they came and deskewed."""
    names = example("39_deskew")
    source, k = odomap.open(names["TOWN"]), names["PLACES"]["round a corner"]
    figure, axes = panels(2, 9.6, 4.5, 0.12)
    Ts = source.truth.Ts_world_body
    for ax, title in zip(axes, ("as they came", "deskewed")):
        dress(ax, title, "x, m", "y, m" if ax is axes[0] else "")
        for j, colour in zip(range(k - 5, k + 6, 5), (ORANGE, BLUE, GREEN)):
            cloud = source.frame(j).cloud
            p = cloud.points
            if title == "deskewed":
                p = deskew(p, cloud.times, names["twist"](source, j))
            T = se3_inverse(Ts[k]) @ Ts[j]
            p = p @ T[:3, :3].T + T[:3, 3]
            p = p[(p[:, 2] > 0.3) & (p[:, 2] < 2.5)]
            ax.plot(p[:, 0], p[:, 1], ".", color=colour, ms=1.3)
            ax.plot(*T[:2, 3], "s", color=colour, ms=5, mec=INK)
        ax.set_aspect("equal")
        ax.set(xlim=(-30, 30), ylim=(-26, 26))
    return figure


def ndt_cells() -> Figure:
    """Cells of a sweep as ellipses, and the score over where the other sweep is put."""
    names = example("40_ndt")
    source = odomap.open(names["TOWN"])
    target, points = names["seen_from"](source, 20, 20), names["seen_from"](source, 24, 20)[::8]
    figure = new_figure(9.6, 3.6)
    left, right = figure.subplots(1, 2, gridspec_kw={"wspace": 0.2, "width_ratios": [1.35, 1]})
    dress(left, "cells of 2 m, from above", "x, m (ahead)", "y, m (left)")
    high = target[target[:, 2] > -1.2]
    left.plot(high[:, 0], high[:, 1], ".", color=INK, ms=0.8, zorder=4)
    for mean, inverse in names["distributions"](high, 2.0).values():
        values, axes = np.linalg.eigh(np.linalg.inv(inverse)[:2, :2])
        turn = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
        wide, thin = 4 * np.sqrt(values[::-1])
        left.add_patch(Ellipse(mean[:2], wide, thin, angle=turn, fc=BLUE, ec="none", alpha=0.4))
    left.set_aspect("equal")
    left.set(xlim=(-14, 16), ylim=(1, 17))
    dress(right, "score of the other sweep", "moved ahead by, m")
    for size, colour in ((4.0, GREEN), (2.0, BLUE), (1.0, ORANGE)):
        cells = names["distributions"](target, size)
        shifts = names["SHIFTS"]
        scores = [names["score"](points + x * names["AHEAD"], cells, size) for x in shifts]
        right.plot(shifts, scores, color=colour, lw=1.8, label=f"cells of {size:.0f} m")
    right.set(xlim=(-6, 6), ylim=(0, None))
    right.legend(loc="upper left", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def voxel_planes() -> Figure:
    """Planes of voxels from above, and how far off a sweep is after each step onto them."""
    names = example("42_planes_in_voxels")
    source, last = odomap.open(names["TOWN"]), names["LAST"]
    *before, sweep = (names["seen_from_last"](source, k) for k in range(last - 12, last + 1))
    planes = names["planes_of"](np.concatenate(before))
    figure = new_figure(9.6, 3.6)
    left, right = figure.subplots(1, 2, gridspec_kw={"wspace": 0.2, "width_ratios": [1.5, 1]})
    dress(left, "voxels with a plane, from above", "x, m (ahead)", "y, m (left)")
    ground, walls = [], []
    for mean, n in planes.values():
        n = n / np.linalg.norm(n)
        if abs(n[2]) > 0.8:
            ground.append(mean[:2])
        elif abs(n[2]) < 0.3:
            along = 0.5 * np.array([-n[1], n[0]])
            walls.append([mean[:2] - along, mean[:2] + along])
    left.plot(*np.array(ground).T, ".", color=GREY, ms=2.2, alpha=0.7)
    left.add_collection(LineCollection(walls, color=BLUE, lw=1.4))
    left.plot(0, 0, "s", color=RED, ms=5)
    left.set_aspect("equal")
    left.set(xlim=(-35, 35), ylim=(-22, 22))
    dress(right, "off by, mm", "step")
    for (name, limits), colour in zip(
        {"squares": 9 * [1e9], "robust": [100.0, 25.0, *7 * [9.0]]}.items(), (RED, BLUE)
    ):
        T, off = names["se3_exp"](np.array([0.4, -0.3, 0.1, 0.0, 0.0, 0.026])), []
        for k in limits:
            off.append(1000 * np.linalg.norm(T[:3, 3]))
            T = names["step"](planes, sweep[::3], T, k)
        right.semilogy(off, "o-", color=colour, ms=3.5, lw=1.4, label=name)
    right.legend(loc="upper right", fontsize=9, frameon=False, labelcolor=INK)
    return figure


def around(ax: Axes, p: Array, rows: Array, true: Array, title: str) -> None:
    """Draw chosen points of a sweep over all of it: true edges, and what is none."""
    dress(ax, title, "x, m (ahead)", "y, m (left)")
    ax.plot(p[::2, 0], p[::2, 1], ".", color=GREY, ms=0.7, alpha=0.5)
    for which, colour, words in ((~true, RED, "no edge"), (true, BLUE, "edge")):
        some = rows[which[rows]]
        ax.plot(p[some, 0], p[some, 1], ".", color=colour, ms=4.5, label=f"{len(some)} {words}")
    ax.legend(loc="lower left", fontsize=8, frameon=True, labelcolor=INK)
    ax.set_aspect("equal")
    ax.set(xlim=(-27, 27), ylim=(-20, 20))


def sharp_edges() -> Figure:
    """The sharpest points of rings, and odomap's edges."""
    names = example("43_edges_and_planes")
    source = odomap.open(names["TOWN"])
    sweep = points_of(source.frame(20).cloud, source.rig.lidars[0])
    true = source.world.sweep_truth(20, reach=3)
    right = true.is_edge | (true.kinds == 3)  # of leaves nobody can say
    figure, axes = panels(2, 9.6, 3.9, 0.15)
    chosen = names["sharpest"](sweep, False)
    around(axes[0], sweep.points, chosen, right, "the sharpest by the formula")
    marks = LoamFrontEnd().prepare(sweep).marks
    around(axes[1], sweep.points, np.flatnonzero(marks == EDGE), right, "edges of odomap")
    flat = sweep.points[marks == PLANE]
    axes[1].plot(flat[:, 0], flat[:, 1], ".", color=GREEN, ms=1.5, zorder=1)
    axes[1].set_ylabel("")
    return figure


def ground_and_things() -> Figure:
    """A sweep as an image: how far, what is ground, and what are things."""
    source = odomap.open("sim:street?sensors=lidar3d&seed=2&beams=64")
    sweep = points_of(source.frame(20).cloud, source.rig.lidars[0])
    lines, rules = scan_lines(sweep, np.eye(4)), LegoConfig().ground
    image = range_image(lines, np.eye(3))
    ground = find_ground(image, rules.slope)
    things = find_clusters(image, ground, rules.same, rules.smallest, rules.narrow)
    seen = image.owner >= 0
    ranges = np.where(seen, np.linalg.norm(image.points[image.owner], axis=2), np.nan)
    rng = np.random.default_rng(4)
    colours = rng.uniform(0.25, 0.95, (int(things.max()) + 1, 3))
    labels = np.ones((*seen.shape, 3))
    labels[seen] = 0.25  # dropped
    labels[ground] = 0.78
    labels[things >= 0] = colours[things[things >= 0]]
    figure = new_figure(9.6, 3.3)
    figure.subplots_adjust(left=0.05, right=0.995, bottom=0.03, top=0.93)
    axes = figure.subplots(2, 1, gridspec_kw={"hspace": 0.2})
    shown = {"origin": "lower", "aspect": "auto", "interpolation": "nearest"}
    dress(axes[0], "how far: dark is near", "", "ring")
    axes[0].imshow(np.log(ranges[:, ::-1]), cmap="viridis", **shown)
    dress(axes[1], "light grey: ground; colours: things; dark grey: dropped", "", "ring")
    axes[1].imshow(labels[:, ::-1], **shown)
    for ax in axes:
        ax.grid(False)
        ax.tick_params(labelbottom=False, length=0)
    return figure


def scan_contexts() -> Figure:
    """Three contexts, and their distances over all turns."""
    names = example("46_scan_context")
    source, context = odomap.open(names["TOWN"]), names["context"]
    places = source.truth.Ts_world_body[:, :3, 3]
    now = 835
    first = int(np.argmin(np.linalg.norm(places[:700] - places[now], axis=1)))
    shown = {
        "first round": context(source.frame(first).cloud.points),
        "second round, turned": context(source.frame(now).cloud.points @ names["AROUND"]),
        "elsewhere": context(source.frame(300).cloud.points),
    }
    figure = new_figure(9.6, 3.0)
    axes = figure.subplots(1, 4, gridspec_kw={"wspace": 0.25, "width_ratios": [1, 1, 1, 1.3]})
    for ax, (title, C) in zip(axes, shown.items()):
        dress(ax, title, "sector", "ring" if ax is axes[0] else "")
        ax.imshow(C, cmap="Blues", origin="lower", aspect="auto", vmin=0, vmax=0.8)
        ax.grid(False)
    one, *others = shown.values()
    dress(axes[3], "distance to the first", "turned by, degrees")
    sectors = names["SECTORS"]
    for other, colour, words in zip(others, (BLUE, GREY), ("same place", "elsewhere")):
        alike = [np.mean(np.sum(other * np.roll(one, -n, axis=1), axis=0)) for n in range(sectors)]
        turns = 360.0 * np.arange(sectors) / sectors
        axes[3].plot(turns, 1.0 - np.array(alike), color=colour, lw=1.8, label=words)
    axes[3].set(xlim=(0, 350), ylim=(0, 1))
    axes[3].legend(loc="lower left", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def seen_by(result: odomap.Result, ids: Array) -> Array:
    """Return what some keyframes saw on the road, in the world."""
    parts = []
    for k in ids.tolist():
        T, cloud = result.map.T_world_body(k), result.map.keyframe(k).cloud
        if cloud is not None:
            p = cloud[(np.abs(cloud[:, 1]) < 6.0) & (np.abs(cloud[:, 0]) < 15.0), :3]
            parts.append(p @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(parts)


def cloud_loops() -> Figure:
    """The cloud of a circuit from above, and a street that was seen twice, from the side."""
    names = example("47_cloud_map")
    source = odomap.open(names["TOWN"])
    frames = list(source)
    figure = new_figure(9.6, 3.4)
    axes = figure.subplots(1, 3, gridspec_kw={"wspace": 0.14, "width_ratios": [1.7, 1, 1]})
    for ax, closing in ((axes[1], False), (axes[2], True)):
        result, _ = names["run"](source.rig, frames, closing)
        error, ids = odomap.ate(result.trajectory, source.truth), result.map.keyframe_ids
        T = error.T_reference_estimate
        dress(ax, "with loops" if closing else "without loops", "x, m", "" if closing else "z, m")
        for some, colour in ((ids[:20], BLUE), (ids[-32:], ORANGE)):
            p = seen_by(result, some) @ T.R.T + T.t
            ax.plot(p[:, 0], p[:, 2], ".", color=colour, ms=1.6)
        middle = result.map.T_world_body(int(ids[8]))[:3, 3] @ T.R.T + T.t
        ax.set(xlim=middle[0] + np.array([-10, 10]), ylim=middle[2] + np.array([-3, 4]))
    cloud = cloud_of_map(result.map, source.rig)
    p, path = cloud.points @ T.R.T + T.t, cloud.path @ T.R.T + T.t
    dress(axes[0], "the cloud from above, yellow: high")
    some = np.random.default_rng(0).permutation(len(p))[:150_000]
    some = some[np.argsort(p[some, 2])]
    axes[0].scatter(p[some, 0], p[some, 1], c=p[some, 2], s=0.2, cmap="viridis", lw=0, vmax=8)
    axes[0].plot(path[:, 0], path[:, 1], color=RED, lw=1.0)
    axes[0].plot(*middle[:2], "o", ms=14, mfc="none", mec=INK, mew=1.4)
    axes[0].set(xlim=(-130, 130), ylim=(-85, 85))
    axes[0].set_aspect("equal")
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    sweep_patterns, deskewing, ndt_cells, voxel_planes, sharp_edges, ground_and_things,
    scan_contexts, cloud_loops,
)  # fmt: skip


if __name__ == "__main__":
    save_figures(FIGURES, sys.argv[1:])
