"""`odomap bundle`: the best views, points and lenses of a bundle adjustment problem."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from odomap.cli.optimize import chosen_loss
from odomap.cli.progress import Steps

if TYPE_CHECKING:
    from odomap.bundle import AdjustResult

__all__ = ["Bundle"]


@dataclass(frozen=True)
class Bundle:
    """Adjust the views, points and lenses of a BAL problem (text, plain or .gz).

    Prints what was found; --out writes the problem at its best views. Ctrl-C ends with the best
    so far. Exit code 1 if it did not converge.
    """

    problem: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PROBLEM")]
    """A problem as "Bundle adjustment in the large" has them."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Where to write it, as BAL text; with .gz packed."""
    cloud: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """PLY file for the points and, in orange, the places of the cameras."""
    loss: Literal["huber", "cauchy", "geman_mcclure", "tukey"] | None = None
    """Let observations that fit badly count less."""
    width: Annotated[float | None, tyro.conf.arg(metavar="PIXELS")] = None
    """Where the loss sets in; default by the loss."""
    gate: Annotated[float, tyro.conf.arg(metavar="PIXELS")] = 0.0
    """Leave out observations beyond this and solve again; 0: never."""
    fix_intrinsics: bool = False
    """Hold f, k1 and k2 of every lens."""
    fix_cameras: bool = False
    """Hold the views: points alone are adjusted."""
    fix_points: bool = False
    """Hold the points: views alone are adjusted."""
    method: Literal["auto", "factored", "iterative"] = "auto"
    """How views are solved for; iterative is for thousands of them."""
    max_iterations: Annotated[int, tyro.conf.arg(metavar="N")] = 100
    """Most steps."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Solve, write, and say what was found."""
        from odomap.bundle import adjust_file

        loss = chosen_loss(self.loss, self.width)
        with Steps("bundle", self.quiet) as steps:
            result = adjust_file(
                self.problem,
                self.out,
                loss=loss,
                gate=self.gate,
                fix_intrinsics=self.fix_intrinsics,
                fix_cameras=self.fix_cameras,
                fix_points=self.fix_points,
                method=self.method,
                max_iterations=self.max_iterations,
                cloud=self.cloud,
                progress=steps.show,
            )
        for name, value in rows(result):
            print(f"{name:<16} {value}")
        if result.is_interrupted:
            print("odomap: interrupted: this is the best so far", file=sys.stderr)
            return 130
        if not result.solution.converged:
            print(f"odomap: not converged: {result.solution.reason}", file=sys.stderr)
            return 1
        return 0


def rows(result: "AdjustResult") -> list[tuple[str, str]]:
    """Return the lines of the conclusion, name and value."""
    import numpy as np

    solution = result.solution
    problem = solution.problem
    counts = f"{problem.num_views} views, {problem.num_points} points"
    lines = [
        ("problem", f"{counts}, {problem.num_observations} observations"),
        ("cost", f"{solution.cost_before:.8g} → {solution.cost_after:.8g}"),
        ("residual", _residual(result)),
        ("iterations", f"{solution.iterations}: {solution.reason}  ({solution.method})"),
        ("time", f"{result.seconds:.3f} s"),
    ]
    out_of_sight = int(np.isinf(solution.chi2).sum())
    remarks = [
        ("left out", int(solution.is_outlier.sum()), "observations beyond the gate"),
        ("out of sight", out_of_sight, "observations of points that their view cannot see"),
        ("blind", len(solution.blind_views), "views that see nothing, left as they were"),
        ("unseen", len(solution.unseen_points), "points that no view sees, left as they were"),
    ]
    lines += [(name, f"{count} {what}") for name, count, what in remarks if count]
    if solution.num_parts > 1:
        lines.append(("parts", f"{solution.num_parts}: not placed relative to each other"))
    return lines + [("wrote", str(path)) for path in result.written]


def _residual(result: "AdjustResult") -> str:
    if result.rms_px != result.rms_px:
        return "none: nothing that is used is in sight"
    return f"{result.rms_px:.4g} px RMS, {result.median_px:.4g} px median"
