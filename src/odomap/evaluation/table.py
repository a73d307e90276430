"""Tables of metrics: one estimate or several side by side, for people and for programs.

Rows are metrics, columns are estimates; where there are several, the best of each row is marked.
One value renders as aligned text (pipes, logs), Markdown (papers, issues), a rich table (terminals)
and JSON (programs; full precision, NaN as null).
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from odomap.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table as RichTable

__all__ = ["Row", "Scored", "Table"]

_UNITS = {
    "_deg_per_m": "°/m",
    "_pct_of_path": "% of path",
    "_pct": "%",
    "_deg": "°",
    "_ms": "ms",
    "_m": "m",
    "_s": "s",
}
_MORE_IS_BETTER = ("matched", "coverage", "inside_95", "relations", "pairs", "segments", "used")
_NOT_RANKED = ("truth", "scale", "path_m", "nees_mean", "nees_per_dof")
_NAMES = {
    "truth": "poses in reference",
    "rmse_pct_of_path": "rmse",
    "path_m": "reference path",
    "matched": "poses matched",
    "used": "poses with covariance",
}


class Scored(Protocol):
    """A result that can say its numbers by name, units in the names (as AteResult does)."""

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by name."""
        ...


@dataclass(frozen=True)
class Row:
    """One metric of every estimate.

    Attributes:
        group: what it belongs to, such as "ATE".
        name: its name as in the result, unit included, such as "rmse_m".
        values: one per estimate; None where an estimate has no such number.
    """

    group: str
    name: str
    values: tuple[float | None, ...]

    @property
    def unit(self) -> str:
        """Unit of the values, "" for plain numbers."""
        return next((unit for end, unit in _UNITS.items() if self.name.endswith(end)), "")

    @property
    def label(self) -> str:
        """Name for people, without the unit."""
        end = next((e for e in _UNITS if self.name.endswith(e)), "")
        return _NAMES.get(self.name, self.name.removesuffix(end).replace("_", " "))

    @property
    def best(self) -> int | None:
        """Column of the best value, or None where there is nothing to compare."""
        known = [(v, k) for k, v in enumerate(self.values) if v is not None and math.isfinite(v)]
        if self.name in _NOT_RANKED or len({v for v, _ in known}) < 2:
            return None
        return (max if self.name in _MORE_IS_BETTER else min)(known, key=lambda vk: vk[0])[1]


@dataclass(frozen=True)
class Table:
    """Metrics of one or several estimates.

    Attributes:
        title: shown above.
        estimates: names of the columns.
        rows: the metrics, in order.

    Example:
        >>> rows = (Row("ATE", "rmse_m", (0.0041, 0.0033)),)
        >>> print(Table("MH_01", ("peer", "ours"), rows).to_markdown())
        **MH_01**
        <BLANKLINE>
        | metric | unit | peer | ours |
        |---|---|--:|--:|
        | ATE rmse | m | 0.004100 | **0.003300** |
    """

    title: str
    estimates: tuple[str, ...]
    rows: tuple[Row, ...]

    @classmethod
    def of(
        cls, results: Mapping[str, Mapping[str, Scored | Mapping[str, float]]], title: str = ""
    ) -> "Table":
        """Gather results by estimate and group, such as `{"ours": {"ATE": ate(...)}}`.

        Raises:
            InputError: there are no estimates.
        """
        if not results:
            raise InputError("table: no estimates to compare")
        numbers = {
            name: {
                group: dict(r) if isinstance(r, Mapping) else r.as_dict() for group, r in of.items()
            }
            for name, of in results.items()
        }
        keys = dict.fromkeys(
            (group, key) for of in numbers.values() for group, ns in of.items() for key in ns
        )
        # A group that only some estimates have may come first in a later one: keep groups together.
        groups = list(dict.fromkeys(group for group, _ in keys))
        ordered = sorted(keys, key=lambda gk: groups.index(gk[0]))
        rows = tuple(
            Row(group, key, tuple(of.get(group, {}).get(key) for of in numbers.values()))
            for group, key in ordered
        )
        return cls(title, tuple(numbers), rows)

    def to_text(self) -> str:
        """Render as aligned plain text; `*` marks the best of a row."""
        several = len(self.estimates) > 1
        cells = [["metric", "unit", *self.estimates]]
        for row in self.rows:
            marks = ["*" if k == row.best else " " if several else "" for k in self._columns]
            texts = [format_number(v) + m for v, m in zip(row.values, marks)]
            cells.append([f"{row.group} {row.label}", row.unit, *texts])
        widths = [max(len(line[k]) for line in cells) for k in range(len(cells[0]))]
        lines = ["  ".join(_pad(t, w, k < 2) for k, (t, w) in enumerate(zip(line, widths)))
                 for line in cells]  # fmt: skip
        lines.insert(1, "  ".join("─" * w for w in widths))
        head = [self.title, ""] if self.title else []
        return "\n".join(line.rstrip() for line in head + lines)

    def to_markdown(self) -> str:
        """Render as a Markdown table; the best of a row in bold."""
        head = [f"**{_escape(self.title)}**", ""] if self.title else []
        lines = [
            _markdown_line(["metric", "unit", *map(_escape, self.estimates)]),
            "|---|---|" + "--:|" * len(self.estimates),
        ]
        for row in self.rows:
            texts = [format_number(v) for v in row.values]
            texts = [f"**{t}**" if k == row.best else t for k, t in enumerate(texts)]
            lines.append(_markdown_line([_escape(f"{row.group} {row.label}"), row.unit, *texts]))
        return "\n".join(head + lines)

    def to_rich(self) -> "RichTable":
        """Render for a terminal; the best of a row in bold green."""
        from rich.table import Table as RichTable
        from rich.text import Text

        table = RichTable(title=Text(self.title) if self.title else None, header_style="bold")
        table.add_column("metric")
        table.add_column("unit", style="dim")
        for name in self.estimates:
            table.add_column(Text(name), justify="right")
        for k, row in enumerate(self.rows):
            texts = [
                Text(format_number(v), style="bold green" if j == row.best else "")
                for j, v in enumerate(row.values)
            ]
            last = k + 1 == len(self.rows) or self.rows[k + 1].group != row.group
            table.add_row(Text(f"{row.group} {row.label}"), row.unit, *texts, end_section=last)
        return table

    def to_json(self) -> str:
        """Render as JSON: estimate → group → name → number; not-a-number and missing as null."""
        out: dict[str, dict[str, dict[str, float | None]]] = {name: {} for name in self.estimates}
        for row in self.rows:
            for name, value in zip(self.estimates, row.values):
                finite = value is not None and math.isfinite(value)
                out[name].setdefault(row.group, {})[row.name] = value if finite else None
        return json.dumps({"title": self.title, "estimates": out}, indent=2, ensure_ascii=False)

    @property
    def _columns(self) -> range:
        return range(len(self.estimates))


def format_number(value: float | None) -> str:
    """Format with four significant digits; integers whole; "–" where there is no number."""
    if value is None or not math.isfinite(value):
        return "–"
    if isinstance(value, int):
        return str(value)
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        digits = 3 - math.floor(math.log10(abs(value))) if value else 3
        return f"{value:.{max(digits, 0)}f}"
    return f"{value:.3e}"


def _pad(text: str, width: int, left: bool) -> str:
    return text.ljust(width) if left else text.rjust(width)


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("\n", " ")


def _markdown_line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
