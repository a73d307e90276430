"""The part of a report that shows the map: from above, how it grew, and what mapping did to it."""

from collections.abc import Mapping

from odomap.views.covisibility import MapView
from odomap.views.page import table, text
from odomap.views.record import Report
from odomap.views.scene import AXES, scene

__all__ = ["map_section"]


def map_section(report: Report) -> str:
    """Return the section as HTML; empty where a run tells nothing about its map."""
    return "\n".join(filter(None, [_plan(report), _growth(report), _counts(report.mapping)]))


def _plan(report: Report) -> str:
    view, place = report.map, scene(report.trajectory, report.truth)
    if view is None or place is None or not (len(view.keyframes) or len(view.landmarks)):
        return ""
    from odomap.views.plan import plan_axes, plan_figure
    from odomap.views.style import figure_svg

    against = " and the truth" if place.truth is not None else ""
    svg = figure_svg(
        plan_figure(place, view, report.unit),
        f"Landmarks, keyframes, the path{against}, from above",
    )
    least = next(k for k in range(3) if k not in plan_axes(place))
    caption = f"Seen along {AXES[least]}, the axis along which the path extends least."
    return f"<figure>{svg}<figcaption>{text(f'{caption} {_joined(view)}')}</figcaption></figure>"


def _joined(view: MapView) -> str:
    """Say what the lines between keyframes are."""
    if not view.num_pairs:
        return f"No two keyframes share {view.least} landmarks."
    pairs = "1 pair" if view.num_pairs == 1 else f"{view.num_pairs:,} pairs"
    drawn = (
        "" if len(view.pairs) == view.num_pairs else f", the strongest {len(view.pairs):,} drawn"
    )
    return (
        f"Green lines join keyframes that share {view.least} landmarks or more, the more the "
        f"darker ({pairs}{drawn})."
    )


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
    words = []
    if is_counted:
        made = sum(e.is_keyframe for e in report.estimates)
        left = int(growth.keyframes[-1])
        words.append(f"{made:,} keyframes were made, {left:,} are in the map after the last frame.")
        words.append("Where the lines are flat, the camera found what it knew.")
    svg = figure_svg(figure, f"{what} over time")
    return (
        f"<h3>{'How it grew' if is_counted else 'Memory'}</h3>\n<figure>{svg}"
        f"<figcaption>{text(' '.join(words))}</figcaption></figure>"
    )


def _counts(mapping: Mapping[str, int]) -> str:
    if not mapping:
        return ""
    rows = [[text(name.replace("_", " ")), f"{int(count):,}"] for name, count in mapping.items()]
    return f"<h3>What mapping did</h3>\n{table([], rows, numbers=[1])}"
