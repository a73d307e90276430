"""`odomap loops`: where a run came back to, what that corrected, and what was not believed."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from odomap.errors import InputError

if TYPE_CHECKING:
    from odomap.files.loops import LoopLog, LoopRecord

__all__ = ["Loops", "lines"]

FEW = 10
"""Refused candidates that are listed where not all are."""


@dataclass(frozen=True)
class Loops:
    """List the loops that a run closed, and the candidates that it refused with their reasons.

    A loop is a place seen before. Closing it moves the path, so that both visits lie on each other.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The output folder of `odomap run` or `odomap continue`."""
    all: bool = False
    """List all refused candidates, in the order in which they came."""
    json: bool = False
    """Print JSON."""

    def execute(self) -> int:
        """Print the table."""
        from odomap.files.loops import as_fields, read_loops
        from odomap.files.records import plain

        loops = read_loops(loops_file(self.run))
        if self.json:
            print(json.dumps(plain(as_fields(loops)), indent=2, ensure_ascii=False))
        else:
            print("\n".join(lines(loops, self.all)))
        return 0


def loops_file(run: Path) -> Path:
    """Return where a run's loops are written.

    Raises:
        InputError: it is no run, or nobody looked for loops in it.
    """
    from odomap.files.loops import LOOPS_FILE

    if run.name == LOOPS_FILE and run.is_file():
        return run
    if not run.is_dir():
        what = "is a file" if run.exists() else "no such folder"
        raise InputError(f"{run}: {what}: give the output folder of 'odomap run'")
    if (run / LOOPS_FILE).exists():
        return run / LOOPS_FILE
    if (run / "metrics.json").exists():
        raise InputError(
            f"{run}: has no {LOOPS_FILE}: no loops were looked for in this run; "
            "'odomap run' looks for them but with --odometry-only, presets with flow, or "
            "--closing.enabled false"
        )
    raise InputError(f"{run}: is no run: neither {LOOPS_FILE} nor metrics.json is there")


def lines(loops: "LoopLog", is_all: bool = False) -> list[str]:
    """Return the loops as lines for people.

    Args:
        loops: what was decided.
        is_all: whether to list all in their order; else those closed, and the nearest to it.
    """
    from odomap.cli.run import loops_text
    from odomap.files.loops import nearest

    head = f"{loops.name}: {loops_text(len(loops.closed), len(loops.rejected))}"
    if not loops.records:
        return [f"{loops.name}: no place looked like one seen before, but for those known at once"]
    chosen = loops.records if is_all else [*loops.closed, *nearest(loops.rejected, FEW)]
    rows = [["", "back at", "seen before at", "inliers", "path moved", ""]]
    rows += [_row(loops, record) for record in chosen]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]) - 1)]
    table = [
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths)), row[-1]]).rstrip()
        for row in rows
    ]
    left = len(loops.records) - len(chosen)
    more = [f"  ... and {left} with fewer inliers: --all lists them"] if left else []
    return [head, *(f"  {line}" for line in table), *more]


def _row(loops: "LoopLog", record: "LoopRecord") -> list[str]:
    back = _when(loops, record.frame, record.stamp_ns, record.keyframe_id)
    before = _when(loops, record.matched_frame, record.matched_stamp_ns, record.matched_id)
    decided = "rejected" if record.reason else "merged" if record.merges else "closed"
    moved = moved_text(record, loops.is_metric) if record.is_accepted else "-"
    said = "; ".join(loops.remarks(record)) if record.is_accepted else record.reason
    return [decided, back, before, f"{record.num_inliers:7d}", moved, said]


def _when(loops: "LoopLog", frame: int, stamp_ns: int, keyframe_id: int) -> str:
    if frame < 0:
        return f"keyframe {keyframe_id} of the map before"
    return f"{loops.seconds(stamp_ns):.2f} s, frame {frame}"


def moved_text(record: "LoopRecord", is_metric: bool) -> str:
    """Say how far a loop moved the path.

    Args:
        record: a loop that was closed.
        is_metric: whether lengths are metres.
    """
    unit = "m" if is_metric else "units"
    words = f"{record.moved:.3g} {unit}, {math.degrees(record.turned):.2g}°"
    if not is_metric:
        words += f", scale {100.0 * (record.rescaled - 1.0):+.1f} %"
    return words
