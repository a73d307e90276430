"""The part of a report that shows loops: what they are, where they were, and what they did.

Who never saw a loop should understand the picture; who looks for a false one, or for one that was
missed, needs the numbers and the reasons. So the picture comes first, then the loops that were
closed, then the candidates that came nearest to it, and all others folded away: a laser closes
hundreds.
"""

import math
from collections.abc import Sequence

from odomap.files.loops import LoopLog, LoopRecord, nearest
from odomap.views.loopview import LoopView
from odomap.views.page import folded, table, text
from odomap.views.record import Report, length, significant
from odomap.views.scene import scene

__all__ = ["loops_section"]

FIRST = 10
"""Closed loops that are shown at once."""
FEW = 8
"""Rejected candidates that are."""
MOST = 500
"""Rows of a table at most."""
WHAT = (
    "A loop is a place that was passed before. Until the path comes back there, small errors add "
    "up unnoticed; there they show, and closing the loop moves the path so that both visits agree."
)
NONE = "No place looked like one seen before, but for those that tracking knew again by itself."
INLIERS = (
    "Points of both visits, or beams of a laser, that agree with how the two lie to each other"
)


def loops_section(report: Report) -> str:
    """Return the section as HTML; empty where no loops were looked for."""
    view = report.loops
    if view is None:
        return ""
    log = view.log
    if not log.records:
        return f'<p>{NONE}</p><p class="note">{WHAT}</p>'
    parts = [f'<p class="note">{WHAT}</p>', _plan(report, view)]
    if log.closed:
        parts.append(_closed(log, view.scale, report.unit))
    if log.rejected:
        parts.append(_rejected(log))
    return "\n".join(filter(None, parts))


def _plan(report: Report, view: LoopView) -> str:
    place = scene(report.trajectory, report.truth)
    if place is None or not view.log.closed or not len(view.live):
        return "" if view.log.closed else "<p>No loop was closed.</p>"
    from odomap.views.loopplan import loops_figure
    from odomap.views.plan import plan_axes
    from odomap.views.style import figure_svg

    figure = loops_figure(place, view, plan_axes(place), report.unit)
    svg = figure_svg(figure, "The path before and after its loops were closed")
    caption = (
        "On the left the path as it was tracked, until the last loop was found; on the right as it "
        "is known at the end, with what it was before as a pale line. A dot is where it came back, "
        "and a ring where it had been."
    )
    return (
        f"<p>{text(_summary(view, report.unit))}</p>"
        f"<figure>{svg}<figcaption>{caption}</figcaption></figure>"
    )


def _summary(view: LoopView, unit: str) -> str:
    """Say in a sentence what the loop that moved the path most did."""
    log, n = view.log, view.largest
    loop = log.closed[n]
    head = f"{len(log.closed)} loops were closed. Loop {n + 1} moved the path most"
    head = "One loop was closed" if len(log.closed) == 1 else head
    back = f"at {log.seconds(loop.stamp_ns):.1f} s it was back where it had been"
    when = (
        "in the map before"
        if loop.matched_frame < 0
        else f"at {log.seconds(loop.matched_stamp_ns):.1f} s"
    )
    by = _length(view.scale * loop.moved, unit)
    return f"{head}: {back} {when}; the path moved by {by} there."


def _length(metres: float, unit: str) -> str:
    return length(metres) if unit == "m" else f"{significant(metres, 2)} {unit}"


def _closed(log: LoopLog, scale: float, unit: str) -> str:
    """Return the loops that were closed: the first ones at once, all of them folded."""
    closed = log.closed
    title = f"<h3>Closed ({len(closed):,})</h3>"
    if len(closed) <= FIRST:
        return f"{title}{_moves(log, closed, scale, unit)}"
    everything = _moves(log, closed[:MOST], scale, unit) + _more(len(closed))
    first = f'<p class="note">The first {FIRST}:</p>{_moves(log, closed[:FIRST], scale, unit)}'
    return f"{title}{first}{folded(f'All {len(closed):,}', everything)}"


def _moves(log: LoopLog, records: Sequence[LoopRecord], scale: float, unit: str) -> str:
    """Return what the first of the closed loops did."""
    rows = []
    for n, loop in enumerate(records, 1):
        merged = ["two pieces of the map became one"] if loop.merges else []
        said = "; ".join([*merged, *log.remarks(loop)])
        moved = _length(scale * loop.moved, unit), f"{math.degrees(loop.turned):.2g}°"
        rescaled = [] if log.is_metric else [f"{100.0 * (loop.rescaled - 1.0):+.1f} %"]
        cells = [f"{loop.num_inliers:,}", *moved, *rescaled, said]
        rows.append([str(n), *_ends(log, loop), *map(text, cells)])
    head = ["", "Back at", "had been there at", _inliers(), "path moved", "turned"]
    head += [] if log.is_metric else ["rescaled"]
    return table([*head, ""], rows, numbers=range(3, len(head)))


def _more(count: int) -> str:
    hidden = count - MOST
    return f'<p class="note">… and {hidden:,} more, in loops.json.</p>' if hidden > 0 else ""


def _rejected(log: LoopLog) -> str:
    """Return the rejected candidates: the nearest to it at once, the others folded."""
    refused = log.rejected
    near = nearest(refused, FEW)
    note = (
        "Places that looked like one seen before, but did not agree in geometry, or not with the "
        "path. "
    )
    title = f"<h3>Rejected ({len(refused):,})</h3>"
    if len(refused) <= FEW:
        return f'{title}<p class="note">{note}</p>{_reasons(log, refused)}'
    note += f"Those {FEW} with the most inliers:"
    everything = _reasons(log, refused[:MOST]) + _more(len(refused))
    everything = folded(f"All {len(refused):,}", everything)
    return f'{title}<p class="note">{note}</p>{_reasons(log, near)}{everything}'


def _reasons(log: LoopLog, records: Sequence[LoopRecord]) -> str:
    rows = [[*_ends(log, r), f"{r.num_inliers:,}", text(r.reason)] for r in records]
    return table(["Came by at", "looked like", _inliers(), "Why not"], rows, numbers=[2])


def _inliers() -> str:
    return f'<abbr title="{text(INLIERS)}">inliers</abbr>'


def _ends(log: LoopLog, loop: LoopRecord) -> list[str]:
    """Return when it came back, and when it had been there."""
    return [
        _end(log, loop.frame, loop.stamp_ns, loop.keyframe_id),
        _end(log, loop.matched_frame, loop.matched_stamp_ns, loop.matched_id),
    ]


def _end(log: LoopLog, frame: int, stamp_ns: int, keyframe_id: int) -> str:
    if frame < 0:
        return text(f"keyframe {keyframe_id} of the map before")
    return _unbroken(f"{log.seconds(stamp_ns):.2f} s (frame {frame})")


def _unbroken(words: str) -> str:
    return f'<span class="unbroken">{text(words)}</span>'
