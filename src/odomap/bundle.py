"""One call from a bundle adjustment problem's file to its best views: file → solver → files.

    result = odomap.bundle.adjust_file("problem-49-7776-pre.txt.gz", "best.txt", cloud="best.ply")
    result.solution.cost_after, result.rms_px, result.written

Written are the problem at its best views, points and lenses, as BAL text, and the points with the
places of the cameras among them as a coloured cloud. Ctrl-C ends the descent after its step and
keeps the best so far.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from odomap.errors import InputError
from odomap.files.bal import read_bal, write_bal
from odomap.solving import Tell, check_out, compile_imported

if TYPE_CHECKING:
    from odomap.backend.adjustment.adjust import Adjustment, AdjustmentSolution
    from odomap.backend.descent import IterationRecord
    from odomap.geometry.robust import Loss

__all__ = ["AdjustResult", "adjust_file"]

POINT, CAMERA = (90, 98, 112), (213, 94, 0)
"""Colours in the cloud."""


@dataclass(frozen=True)
class AdjustResult:
    """What a bundle adjustment found.

    Attributes:
        solution: views, points, lenses, costs, and why the solver stopped.
        rms_px: of the distances in the image, of what was used and is in sight.
        median_px: likewise.
        seconds: to solve; reading and compiling are not in it.
        is_interrupted: whether Ctrl-C ended it.
        written: the problem and the cloud, if asked for.
    """

    solution: "AdjustmentSolution"
    rms_px: float
    median_px: float
    seconds: float
    is_interrupted: bool
    written: tuple[Path, ...]


def adjust_file(
    path: str | Path,
    out: str | Path | None = None,
    *,
    loss: "Loss | None" = None,
    gate: float = 0.0,
    fix_intrinsics: bool = False,
    fix_cameras: bool = False,
    fix_points: bool = False,
    method: Literal["auto", "factored", "iterative"] = "auto",
    max_iterations: int = 100,
    cloud: str | Path | None = None,
    progress: Tell | None = None,
) -> AdjustResult:
    """Adjust the views, points and lenses of a BAL problem, and write them.

    Args:
        path: the problem, plain or gzip.
        out: where to write it at the views found, as BAL text.
        loss: robust loss of the observations.
        gate: distance in pixels beyond which an observation is left out; 0: never.
        fix_intrinsics: whether to hold f, k1 and k2 of all lenses.
        fix_cameras: whether to hold all views.
        fix_points: whether to hold all points.
        method: how views are solved for: factored, iterative, or what suits their number.
        max_iterations: most steps.
        cloud: PLY file for points and places of cameras.
        progress: called with (done, total, text).

    Raises:
        InputError: the file, or what is asked of it, cannot be.
        OutputError: the results cannot be written.
    """
    from odomap.backend.adjustment.adjust import AdjustmentConfig, adjust
    from odomap.system.worker import deferred_interrupt

    tell = progress or (lambda *_: None)
    config = AdjustmentConfig(method=method, iterations=max_iterations, gate=gate)
    problem = read_bal(path)
    check_out(path, out, cloud)
    problem = replace(
        problem,
        is_free_intrinsic=np.full(problem.intrinsics.shape, not fix_intrinsics),
        is_fixed_view=np.full(problem.num_views, fix_cameras),
        is_fixed_point=np.full(problem.num_points, fix_points),
    )
    compile_imported(tell)
    tell(0, 0, f"{problem.num_views} views, {problem.num_points} points")
    with deferred_interrupt() as interrupt:
        start = time.perf_counter()
        try:
            solution = adjust(
                problem,
                config,
                loss=loss,
                stop=interrupt,
                progress=lambda record: tell(record.iteration, 0, _step(record)),
            )
        except InputError as error:
            raise InputError(f"{path}: {str(error).removeprefix('adjustment: ')}") from error
        seconds = time.perf_counter() - start
        written = _write(solution.problem, out, cloud)
        is_interrupted = interrupt.is_set()
    used = solution.chi2[np.isfinite(solution.chi2) & ~solution.is_outlier]
    rms, median = np.sqrt([used.mean(), np.median(used)]) if len(used) else (np.nan, np.nan)
    return AdjustResult(solution, float(rms), float(median), seconds, is_interrupted, written)


def _step(record: "IterationRecord") -> str:
    return f"cost {record.cost:.6g}"


def _write(
    problem: "Adjustment", out: str | Path | None, cloud: str | Path | None
) -> tuple[Path, ...]:
    written = []
    if out is not None:
        write_bal(out, problem)
        written.append(Path(out))
    if cloud is not None:
        from odomap.files.clouds import write_ply
        from odomap.maps.surface import Surface

        R, t = problem.Ts_camera_world[:, :3, :3], problem.Ts_camera_world[:, :3, 3]
        cameras = -np.einsum("kji,kj->ki", R, t)
        places = np.concatenate([problem.points_world, cameras]).astype(np.float32)
        colours = np.tile(np.array(POINT, np.uint8), (len(places), 1))
        colours[problem.num_points :] = CAMERA
        write_ply(cloud, Surface(places, colours=colours))
        written.append(Path(cloud))
    return tuple(written)
