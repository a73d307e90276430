"""Numbers and their names as people read them: units out of names, cards out of metrics."""

import math
from collections.abc import Iterator, Mapping

from odomap.views.record import Report, length, significant

__all__ = ["cards", "flat", "value_text"]

UNITS = {
    "_deg_per_m": "°/m",
    "_pct_of_path": "% of path",
    "_pct": "%",
    "_deg": "°",
    "_hz": "Hz",
    "_ms": "ms",
    "_mb": "MB",
    "_bytes": "B",
    "_m": "m",
    "_s": "s",
    "ms_per_frame": "ms",
}
NAMES = {
    "truth": "poses in truth",
    "matched": "poses matched",
    "rmse_pct_of_path": "rmse",
    "path_m": "length of path",
    "ms_per_frame": "time per frame,",
    "path_units": "length of path, without scale",
    "skipped": "images skipped",
}
CARDS = {
    "real_time_factor": "times real time",
    "keyframes": "keyframes",
    "landmarks": "landmarks",
    "loops_closed": "loops closed",
    "peak_memory_mb": "peak memory",
}


def flat(values: Mapping[str, object], above: str = "") -> Iterator[tuple[str, object]]:
    """Yield (name, value) of nested mappings, names joined by a space; the unit keeps its place."""
    for name, value in values.items():
        whole = f"{above} {name}".strip()
        if isinstance(value, Mapping):
            yield from flat(value, whole)
        else:
            yield whole, value


def value_text(name: str, value: object) -> tuple[str, str]:
    """Return (label, text with unit) of a number under its name.

    Example:
        >>> value_text("rot_rmse_deg", 0.51234)
        ('rot rmse', '0.512 °')
    """
    # The unit may end the name of a group: "ms_per_frame median".
    words = name.split(" ")
    for k in reversed(range(len(words))):
        end = next((e for e in UNITS if words[k].endswith(e)), None)
        if end is not None:
            words[k] = NAMES.get(words[k], words[k].removesuffix(end))
            return " ".join(words).replace("_", " "), _with_unit(value, UNITS[end])
    return NAMES.get(name, name).replace("_", " "), _with_unit(value, "")


def _with_unit(value: object, unit: str) -> str:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return "–" if value is None else str(value)
    if not math.isfinite(value):
        return "–"
    if unit == "B":
        return f"{significant(value / 1e6, 3)} MB"
    if isinstance(value, int):
        return f"{value:,} {unit}".strip()
    if unit == "m":
        return length(value) if abs(value) < 0.5 else f"{significant(value, 4)} m"
    return f"{significant(value, 3)} {unit}".strip()


def cards(report: Report) -> list[tuple[str, str]]:
    """Return (number, caption) of what a reader looks for first."""
    out: list[tuple[str, str]] = []
    ate = next((of for group, of in report.scores.items() if group.upper().startswith("ATE")), {})
    rmse = ate.get("rmse_m", math.nan)
    if math.isfinite(rmse):
        out.append((length(rmse), "ATE RMSE"))
    if report.trajectory is not None and len(report.trajectory) > 1:
        path = float(report.trajectory.path_length)
        free = report.scale == "free"
        shown = f"{significant(path, 2)} {report.unit}" if free else length(path)
        out.append((shown, "path travelled, without scale" if free else "path travelled"))
    pace = report.metrics.get("ms_per_frame")
    if isinstance(pace, Mapping):
        for key, caption in (("median", "per frame, median"), ("p95", "per frame, 95 %")):
            ms = pace.get(key)
            if isinstance(ms, (int, float)) and math.isfinite(ms):
                out.append((f"{significant(ms, 2)} ms", caption))
    for name, caption in CARDS.items():
        value = report.metrics.get(name)
        if isinstance(value, (int, float)) and math.isfinite(value):
            text = f"{value:,}" if isinstance(value, int) else significant(value, 3)
            out.append((f"{text} MB" if name.endswith("_mb") else text, caption))
    return out
