"""The part of a report that shows the map: from above, how it grew, and what mapping did to it."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from odomap.views.page import image, table, text
from odomap.views.record import Growth, Report
from odomap.views.scene import AXES, scene

if TYPE_CHECKING:
    from odomap.views.covisibility import MapView

__all__ = ["map_section"]


def map_section(report: Report) -> str:
    """Return the section as HTML; empty where a run tells nothing about its map."""
    if report.cloud_png:
        shown = _cloud(report.cloud_png)
    else:
        shown = _grid(report.grid_png) if report.grid_png else _plan(report)
    return "\n".join(filter(None, [shown, _growth(report), _counts(report.mapping)]))


def _grid(png: bytes) -> str:
    """Return a map as a grid: what lasers leave instead of landmarks."""
    drawn = image(png, "png", "Occupancy grid: walls, free space, what was not seen, and the path")
    caption = (
        "Walls are dark, free space is white, grey was never seen; the line is the path. The same "
        "grid is in grid.yaml and grid.pgm, which map_server loads."
    )
    return f"<figure>{drawn}<figcaption>{text(caption)}</figcaption></figure>"


def _cloud(png: bytes) -> str:
    """Return a map as a cloud: what LiDARs leave."""
    drawn = image(png, "png", "Cloud from above: the ground, what stands on it, and the path")
    caption = (
        "From above: the ground is pale, what stands on it is the darker the higher it is; the "
        "line is the path. The points are in cloud.ply, with intensities; grid.yaml and grid.pgm "
        "are the slice of it that is in a robot's way."
    )
    return f"<figure>{drawn}<figcaption>{text(caption)}</figcaption></figure>"


def _plan(report: Report) -> str:
    view, place = report.map, scene(report.trajectory, report.truth)
    if view is None or place is None or not (len(view.keyframes) or len(view.landmarks)):
        return ""
    from odomap.views.plan import plan_axes, plan_figure
    from odomap.views.style import figure_svg

    axes = plan_axes(place)
    along = AXES[next(k for k in range(3) if k not in axes)]
    is_side = place.up_axis in axes
    where = "the side" if is_side else "above"
    why = ", the axis along which the path extends least" if is_side else ""
    against = " and the truth" if place.truth is not None else ""
    svg = figure_svg(
        plan_figure(place, view, report.unit),
        f"Landmarks, keyframes, the path{against}, from {where}",
    )
    caption = f"Seen from {where}, along {along}{why}. {_joined(view)}{_tied(view)}"
    return f"<figure>{svg}<figcaption>{text(caption)}</figcaption></figure>"


def _joined(view: "MapView") -> str:
    """Say what the lines between keyframes are."""
    if not view.num_pairs:
        return f"No two keyframes share {view.least} landmarks."
    pairs = "1 pair" if view.num_pairs == 1 else f"{view.num_pairs:,} pairs"
    drawn = (
        "" if len(view.pairs) == view.num_pairs else f", the strongest {len(view.pairs):,} drawn"
    )
    return (
        f"Green lines join keyframes that share {view.least} landmarks or more, the stronger the "
        f"more they share ({pairs}{drawn})."
    )


def _tied(view: "MapView") -> str:
    """Say what loops and gaps are, where there are any."""
    words = ""
    if len(view.loops):
        words += " A loop leads from where it came back (dot) to where it had been (ring)."
    if len(view.gaps):
        words += " Dotted lines join pieces whose place to each other was never measured."
    return words


def _growth(report: Report) -> str:
    growth = report.growth
    if growth is None:
        return ""
    from odomap.views.growing import growth_figure
    from odomap.views.style import figure_svg

    figure = growth_figure(report.estimates, growth)
    if figure is None:
        return ""
    is_counted = len(growth.keyframes) > 0
    what = "Keyframes, landmarks and memory" if is_counted else "Memory"
    svg = figure_svg(figure, f"{what} over time")
    words = _grown(report, growth) if is_counted else ""
    caption = f"<figcaption>{text(words)}</figcaption>" if words else ""
    title = "How it grew" if is_counted else "Memory"
    return f"<h3>{title}</h3>\n<figure>{svg}{caption}</figure>"


def _grown(report: Report, growth: Growth) -> str:
    """Say what became of the keyframes that were made."""
    there = growth.before(report.estimates)
    before = f"in the map before, {there:,}; " if there else ""
    made = int(growth.made(report.estimates)[-1])
    left = int(growth.keyframes[-1])
    return (
        f"Keyframes: {before}made, {made:,}; in the map after the last frame, {left:,}. "
        "Where the lines are flat, what was seen was known."
    )


def _counts(mapping: Mapping[str, int]) -> str:
    if not mapping:
        return ""
    rows = [[text(name.replace("_", " ")), f"{int(count):,}"] for name, count in mapping.items()]
    return f"<h3>What mapping did</h3>\n{table([], rows, numbers=[1])}"
