"""`odomap eval`: how far an estimated path is from the true one."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from odomap.evaluation.table import Scored, Table
    from odomap.geometry.trajectory import Trajectory

__all__ = ["Evaluate"]

SCALED = 0.5
"""A fitted scale that leaves less than this share of the error, and is as far from 1, is said."""


@dataclass(frozen=True)
class Evaluate:
    """Compare a trajectory with a reference: ATE, RPE, KITTI segments, relations.

    Trajectories are TUM text (time tx ty tz qx qy qz qw), KITTI rows or EuRoC csv, plain or .gz.
    """

    estimate: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ESTIMATE")]
    """The trajectory to judge."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """Ground truth: a trajectory, a recording that has one, or Freiburg *.relations."""
    align: Literal["se3", "sim3", "yaw", "first", "none"] = "se3"
    """How to align: rigid, with scale, about the vertical, first pose on first, or not at all."""
    delta: float = 1.0
    """Length of the increments of the relative error."""
    unit: Literal["s", "m", "f"] = "s"
    """Unit of delta: seconds, metres or frames."""
    max_dt: float = 0.02
    """Largest difference in time of two poses compared, seconds."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for eval.json and the plots."""
    json: bool = False
    """Print JSON instead of a table."""

    def execute(self) -> int:
        """Print the table, write what was asked for."""
        from odomap.errors import InputError
        from odomap.files.atomic import make_folder
        from odomap.files.trajectories import read_trajectory

        for name, value in (("delta", self.delta), ("max-dt", self.max_dt)):
            if not 0.0 < value < math.inf:
                raise InputError(f"--{name} is {value:g}: a positive number expected")
        if self.out is not None:
            make_folder(self.out)
        estimate = read_trajectory(self.estimate)
        if ".relations" in self.reference.suffixes:
            table = self._relations(estimate)
            reference = None
        else:
            reference = read_reference(self.reference)
            table = self._metrics(estimate, reference)
            estimate = self._scaled(estimate, reference)
        if self.json:
            print(table.to_json())
        else:
            print(table.to_text())
        if self.out is not None:
            self._write(table, estimate, reference)
        return 0

    def _relations(self, estimate: "Trajectory") -> "Table":
        from odomap.evaluation.relations import read_relations, relations
        from odomap.evaluation.table import Table

        result = relations(estimate, read_relations(self.reference))
        return Table.of({self.estimate.name: {"relations": result}})

    def _metrics(self, estimate: "Trajectory", reference: "Trajectory") -> "Table":
        from odomap.errors import InputError
        from odomap.evaluation.metrics import ate, kitti_segments, rpe
        from odomap.evaluation.table import Table

        groups: dict[str, Scored] = {"ATE": ate(estimate, reference, self.align, self.max_dt)}
        scaled: Literal["se3", "sim3"] = "sim3" if self.align == "sim3" else "se3"
        step = f"RPE {self.delta:g} {self.unit}"
        try:
            groups[step] = rpe(estimate, reference, self.delta, self.unit, scaled, self.max_dt)
        except InputError as error:
            print(f"odomap: no {step}: {error}", file=sys.stderr)
        # Drift over 100 m and more says nothing about shorter paths: left out there, not an error.
        if reference.path_length >= 100.0:
            try:
                groups["KITTI"] = kitti_segments(estimate, reference, self.max_dt)
            except InputError as error:
                print(f"odomap: no KITTI segments: {error}", file=sys.stderr)
        return Table.of({self.estimate.name: groups})

    def _scaled(self, estimate: "Trajectory", reference: "Trajectory") -> "Trajectory":
        """Return the path at the scale that was fitted, to draw; say if one should have been."""
        import numpy as np

        from odomap.errors import InputError
        from odomap.evaluation.metrics import ate
        from odomap.geometry.pose import Sim3

        try:
            fitted = ate(estimate, reference, "sim3", self.max_dt)
        except InputError:
            return estimate  # a path that stands still has no scale to speak of
        if self.align == "sim3":
            return estimate.transformed(Sim3.from_parts(fitted.scale, np.eye(3), np.zeros(3)))
        rigid = ate(estimate, reference, "se3", self.max_dt)
        if fitted.rmse < SCALED * rigid.rmse and abs(fitted.scale - 1.0) > 1.0 - SCALED:
            print(
                f"odomap: the reference is {fitted.scale:.3g} times as large as the path: if that "
                "is of one camera, which has no scale, give --align sim3",
                file=sys.stderr,
            )
        return estimate

    def _write(
        self, table: "Table", estimate: "Trajectory", reference: "Trajectory | None"
    ) -> None:
        """Write eval.json, and what a person wants to see of two paths."""
        from odomap.files.atomic import write_bytes, write_text
        from odomap.views.plots import error_figure, path_3d_figure, path_figure
        from odomap.views.style import figure_png

        assert self.out is not None
        written = [self.out / "eval.json"]
        write_text(written[0], table.to_json() + "\n")
        if reference is not None:
            for name, draw in (
                ("path", path_figure),
                ("path_3d", path_3d_figure),
                ("error", error_figure),
            ):
                written.append(self.out / f"{name}.png")
                write_bytes(written[-1], figure_png(draw(estimate, reference)))
        for path in written:
            print(f"odomap: wrote {path}", file=sys.stderr)


def read_reference(path: Path) -> "Trajectory":
    """Read ground truth: a file, or that of a recording."""
    from odomap.errors import InputError
    from odomap.files.trajectories import read_trajectory
    from odomap.sources.open import open as open_source

    if not path.is_dir() and not str(path).startswith("sim:"):
        return read_trajectory(path)
    truth = open_source(str(path)).truth
    if truth is None:
        raise InputError(f"{path}: this recording has no ground truth")
    return truth
