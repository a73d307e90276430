"""The report of a run: one HTML file that can be mailed, printed and opened in ten years.

It answers, in this order: did it work (one sentence), where did it go, how far is that from the
truth and did the tracker know, what did it see, where did the time go, what went wrong, and what
exactly was run. Plots are vector drawings in the page and follow its light or dark mode; long
recordings are thinned, so that the page stays below some megabytes.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.files.atomic import write_text
from odomap.maps.estimate import Estimate
from odomap.views.loopsection import loops_section
from odomap.views.mapsection import map_section
from odomap.views.page import details, image, page, section, swatch, table, text
from odomap.views.record import Report, Sample, lost_runs, significant, verdict
from odomap.views.words import cards, flat, value_text

__all__ = ["Report", "Sample", "render_report", "write_report"]

SAMPLES = 8
ROWS = 50
SCALES = {
    "metric": "",
    "fitted": "One camera cannot tell the scale: the path is drawn at that of the truth. ",
    "free": "One camera cannot tell the scale: lengths are in units of their own. ",
}
LEVELS = {"good": "Everything tracked", "warn": "Look at the problems", "bad": "It failed"}


def write_report(path: str | Path, report: Report) -> Path:
    """Write a report as one HTML file, whole or not at all.

    Args:
        path: the file, or a folder that is there, in which it is named report.html.
        report: what to show.

    Returns:
        The file written.

    Raises:
        OutputError: it cannot be written.
    """
    target = Path(path)
    if target.is_dir():
        target = target / "report.html"
    write_text(target, render_report(report))
    return target


def render_report(report: Report) -> str:
    """Render a report as the text of one HTML page."""
    parts = [
        ("path", "Path", _path(report)),
        ("loops", "Loops", loops_section(report)),
        ("map", "Map", map_section(report)),
        ("error", "Error over time", _error(report)),
        ("features", "Tracked features", _features(report)),
        ("timing", "Timing", _timing(report)),
        ("frames", "Frames and their tracks", _frames(report)),
        ("problems", "Problems", _problems(report)),
        ("run", "What was run", _run(report)),
    ]
    shown = [(name, title, body) for name, title, body in parts if body]
    links = "\n".join(f'<a href="#{name}">{text(title)}</a>' for name, title, _ in shown)
    sections = [
        section(*part, long=part[0] in ("loops", "frames", "problems", "run")) for part in shown
    ]
    body = "\n".join([_head(report), f'<nav aria-label="Sections">{links}</nav>', *sections])
    footer = f"<footer>Made by odomap {text(report.version)}.</footer>"
    return page(f"{report.title} · odomap", f"{body}\n{footer}", with_script=report.has_path)


def _head(report: Report) -> str:
    says = verdict(report)
    items = "".join(f"<li><b>{text(n)}</b><span>{text(c)}</span></li>" for n, c in cards(report))
    by = " · ".join(filter(None, [report.source, f"odomap {report.version}".strip()]))
    return f"""<h1>{text(report.title)}</h1>
<p class="by">{text(by)}</p>
<p class="verdict {says.level}"><b>{LEVELS[says.level]}</b>{text(says.text)}</p>
{f'<ul class="cards">{items}</ul>' if items else ""}"""


def _path(report: Report) -> str:
    from odomap.views.path3d import path3d_data
    from odomap.views.plots import figure_svg, path_figure
    from odomap.views.scene import scene

    place = scene(report.trajectory, report.truth)
    if place is None:
        return '<p class="note">There is no path to show: no frame was tracked.</p>'
    keyframes = np.array([e.stamp_ns for e in report.estimates if e.is_keyframe], np.int64)
    loops = None if report.loops is None else report.loops.after
    against = " against the true one" if place.truth is not None else ""
    label = f"The path{against}, from above and from the side"
    flat_view = figure_svg(
        path_figure(report.trajectory, report.truth, keyframes, report.unit, loops), label
    )
    caption = SCALES[report.scale] + (
        "The whole path is laid on the truth by the one rigid motion that fits best; "
        "its colour is the distance that remains."
        if place.truth is not None
        else "No ground truth: the path is shown in its own world frame."
    )
    coloured = place.distances is not None
    ties = np.zeros((0, 2, 3)) if loops is None else loops
    has_points = report.points is not None and len(report.points) > 0
    return f"""<figure>{flat_view}<figcaption>{caption}</figcaption></figure>
<h3>In three dimensions</h3>
<div class="view">
<canvas id="path3d" tabindex="0" role="img" aria-label="Interactive view of the path in three \
dimensions. Arrow keys turn it, plus and minus zoom, zero resets.">The interactive view needs a \
browser with canvas.</canvas>
<div class="controls"><button id="path3d-play" type="button">Play</button>
<input id="path3d-time" type="range" min="0" max="0" value="0" aria-label="Position along the path">
<output id="path3d-clock"></output></div>
</div>
{_legend3d(coloured, place.truth is not None, has_points, bool(len(ties)))}
<p class="note">Drag to turn, shift-drag to move, wheel to zoom, double-click to reset.</p>
<noscript><p class="note">The interactive view needs JavaScript; nothing is loaded.</p></noscript>
<script type="application/json" id="path3d-data">\
{path3d_data(place, keyframes, report.points, report.unit, ties)}</script>"""


def _legend3d(coloured: bool, has_truth: bool, has_points: bool, has_loops: bool) -> str:
    estimate = '<i class="ramp"></i>' if coloured else '<i style="color:var(--estimate)"></i>'
    items = [f"{estimate}estimate{', little to much error' if coloured else ''}"]
    if has_truth:
        items.append('<i style="color:var(--truth)"></i>truth')
    items.append('<i class="dot" style="color:var(--keyframe)"></i>keyframe')
    if has_loops:
        items.append('<i class="loop"></i>loop: a place seen before')
    if has_points:
        items.append('<i class="dot" style="color:var(--muted)"></i>landmark')
    return '<ul class="legend">' + "".join(f"<li>{item}</li>" for item in items) + "</ul>"


def _error(report: Report) -> str:
    if not report.has_path:
        return ""
    from odomap.views.patherror import PathError
    from odomap.views.plots import error_figure, figure_svg

    error = PathError.of(report.trajectory, report.truth)
    if error is None:
        label = "Three-sigma uncertainty of position and rotation over time"
        lead = "" if report.truth is None else "The ground truth shares no times with the path. "
        caption = f"{lead}Without ground truth only the claimed uncertainty can be shown."
    else:
        label = "Errors of position and rotation over time, with the three-sigma band claimed"
        caption = (
            "Errors in the axes of the body after laying the first poses on each other, because "
            "the covariance is relative to the first pose."
        )
        if error.sigmas is not None:
            caption += f" {_inside(error.errors, error.sigmas)}"
    svg = figure_svg(error_figure(report.trajectory, report.truth, report.unit), label)
    return f"<figure>{svg}<figcaption>{text(caption)}</figcaption></figure>{_scores(report)}"


def _inside(errors: NDArray[np.float64], sigmas: NDArray[np.float64]) -> str:
    known = np.isfinite(sigmas) & (sigmas > 0)
    if not known.any():
        return "No usable covariance was recorded."
    share = float((np.abs(errors[known]) <= 3 * sigmas[known]).mean())
    says = f"{100 * share:.1f} % of the errors lie within 3σ (99.7 % would be expected)"
    return f"{says}." if share > 0.9 else f"{says}: the uncertainty claimed is too small here."


def _scores(report: Report) -> str:
    groups = []
    for group, values in report.scores.items():
        words = [value_text(name, value) for name, value in values.items()]
        rows = [[text(label), text(shown)] for label, shown in words]
        groups.append(f"<div><h3>{text(group)}</h3>{table([], rows, numbers=[1])}</div>")
    return f'<div class="columns">{"".join(groups)}</div>' if groups else ""


def _features(report: Report) -> str:
    if not report.estimates:
        return ""
    from odomap.views.plots import figure_svg, inlier_figure

    counts = np.array([e.num_inliers for e in report.estimates])
    label = "Number of inliers of each frame over time"
    caption = (
        f"Observations that agree with the pose: median {np.median(counts):.0f}, fewest "
        f"{counts.min()}. Orange ticks are keyframes; shaded frames are lost."
    )
    svg = figure_svg(inlier_figure(report.estimates), label)
    return f"<figure>{svg}<figcaption>{text(caption)}</figcaption></figure>"


def _timing(report: Report) -> str:
    from odomap.views.plots import figure_svg, timing_figure
    from odomap.views.style import css_colour
    from odomap.views.timelines import stage_colours, stage_times

    stages = stage_times(report.estimates)
    if not stages:
        return ""
    svg = figure_svg(timing_figure(report.estimates), "Milliseconds of each stage, per frame")
    total = np.sum(list(stages.values()), axis=0)
    whole = max(float(total.sum()), 1e-12)
    colours = {name: css_colour(colour) for name, colour in stage_colours(stages).items()}
    rows = []
    for name, ms in [*stages.items(), ("all stages", total)]:
        ran = ms if name not in stages else ms[[name in e.timing for e in report.estimates]]
        figures = (np.median(ran), np.percentile(ran, 95), ran.max())
        numbers = [significant(float(v), 3) if v else "0" for v in figures]
        share = f"{100 * float(ms.sum()) / whole:.0f} %"
        rows.append([swatch(colours.get(name)) + text(name), f"{len(ran):,}", *numbers, share])
    head = ["Stage", "frames", "median ms", "p95 ms", "max ms", "share"]
    caption = (
        "What the tracker's thread did with each frame. The figures of a stage are those of the "
        "frames in which it ran; its share is that of all time."
    )
    return (
        f"<figure>{svg}<figcaption>{caption}</figcaption></figure>"
        f"{table(head, rows, numbers=[1, 2, 3, 4, 5])}{_beside(report)}"
    )


def _beside(report: Report) -> str:
    """Return what ran beside the frames, in threads of its own."""
    if not report.beside_ms:
        return ""
    rows = [
        [text(name), f"{ms['count']:,}", *(significant(ms[k], 3) for k in ("median", "p95", "max"))]
        for name, ms in report.beside_ms.items()
    ]
    head = ["Beside the frames", "times", "median ms", "p95 ms", "max ms"]
    return table(head, rows, numbers=[1, 2, 3, 4])


def _frames(report: Report) -> str:
    if not report.samples:
        return ""
    from odomap.views.plots import figure_jpeg, frame_figure
    from odomap.views.scene import thin

    chosen = [report.samples[k] for k in thin(len(report.samples), SAMPLES)]
    start = report.estimates[0].stamp_ns if report.estimates else chosen[0].estimate.stamp_ns
    figures = []
    for sample in chosen:
        words = _frame_words(sample.estimate, start)
        data = figure_jpeg(frame_figure(sample.image, sample.estimate.tracks))
        picture = image(data, "jpeg", f"{words}; with the tracked points drawn on the picture")
        figures.append(f"<figure>{picture}<figcaption>{text(words)}</figcaption></figure>")
    key = (
        "Each trail leads from where a point was in the frame it was tracked from to where it is. "
        "Green dots agree with the pose, orange crosses do not."
    )
    return f'<div class="frames">{"".join(figures)}</div><p class="note">{key}</p>'


def _frame_words(estimate: Estimate, start_ns: int) -> str:
    seconds = (estimate.stamp_ns - start_ns) * 1e-9
    words = f"Frame {estimate.frame_id}, {seconds:.2f} s: {estimate.status}"
    words += f", {estimate.num_inliers} inliers"
    if estimate.tracks is not None:
        words += f" of {len(estimate.tracks.keypoints)} tracks"
    if estimate.is_keyframe:
        words += ", keyframe"
    return f"{words} ({estimate.reason})" if estimate.reason else words


def _problems(report: Report) -> str:
    parts = []
    runs = lost_runs(report.estimates)
    if runs:
        start = report.estimates[0].stamp_ns
        rows = [
            [
                f"{(run.start_ns - start) * 1e-9:.2f} s",
                f"{(run.end_ns - start) * 1e-9:.2f} s",
                str(run.count),
                text(run.reason or "no reason given"),
            ]
            for run in runs[:ROWS]
        ]
        head = ["From", "to", "frames", "Reason"]
        parts.append("<h3>Lost</h3>" + table(head, rows, numbers=[0, 1, 2]) + _more(runs))
    if report.skipped:
        start = report.estimates[0].stamp_ns if report.estimates else report.skipped[0][0]
        rows = [
            [f"{(stamp - start) * 1e-9:.2f} s", text(file), text(reason)]
            for stamp, file, reason in report.skipped[:ROWS]
        ]
        head = ["At", "File", "Reason"]
        parts.append("<h3>Skipped</h3>" + table(head, rows, numbers=[0]) + _more(report.skipped))
    if report.warnings:
        items = "".join(f"<li>{text(warning)}</li>" for warning in report.warnings)
        parts.append(f"<h3>Warnings</h3><ul>{items}</ul>")
    if report.estimates and not report.has_path:
        parts.append("<p>No frame was tracked; the reasons are those of the lost frames.</p>")
    return "\n".join(parts) or '<p class="note">None: no frame was lost, no image skipped.</p>'


def _more(items: Sequence[object]) -> str:
    hidden = len(items) - ROWS
    return f'<p class="note">… and {hidden} more.</p>' if hidden > 0 else ""


def _run(report: Report) -> str:
    measured = [value_text(name, value) for name, value in flat(report.metrics)]
    columns = []
    if measured:
        rows = [[text(label), text(shown)] for label, shown in measured]
        columns.append(f"<div><h3>Measured</h3>{table([], rows, numbers=[1])}</div>")
    if report.environment:
        rows = [[text(name), text(value)] for name, value in report.environment.items()]
        columns.append(f"<div><h3>Environment</h3>{table([], rows)}</div>")
    parts = [f'<div class="columns">{"".join(columns)}</div>'] if columns else []
    if report.command:
        parts.append(f"<h3>Command</h3><pre>{text(report.command)}</pre>")
    if report.rig:
        parts.append(details("Rig", report.rig))
    if report.config:
        parts.append(details("Configuration", report.config))
    return "\n".join(parts)
