"""Figures of a run: what metrics.json says, and what a person should be warned of.

Frames that found their place later have a pose in the end and are not lost. A path is compared with
the ground truth where there is one, aligned by a rigid motion, or with a scale where lengths are
in units of their own. A run that only places frames in a saved map has not failed as long as some
of them were: the others may show what the map has not seen.
"""

from collections import Counter
from typing import TYPE_CHECKING, Any

from odomap.errors import InputError
from odomap.logbook import Logbook, skipped_numbers, versions
from odomap.maps.atlas import Atlas
from odomap.maps.edges import LOOP
from odomap.maps.estimate import Status

if TYPE_CHECKING:
    from odomap.sources.source import Source
    from odomap.system.system import Result

__all__ = ["figures"]

DOUBTED = 0.1
"""Share of frames that may be tracked with a doubt before a person is told."""


def figures(
    source: "Source", logbook: Logbook, result: "Result", is_mapping: bool = True
) -> tuple[dict[str, Any], list[str]]:
    """Return the content of metrics.json and the warnings.

    Args:
        source: the recording.
        logbook: what was noted of its frames.
        result: what was found.
        is_mapping: False where frames were only placed in a map.
    """
    from odomap.evaluation.metrics import ate

    warnings = list(getattr(source, "notes", []))
    metrics: dict[str, Any] = {"name": source.name} | logbook.numbers() | skipped_numbers(source)
    # Frames that were placed later have a pose now.
    placed = set(result.trajectory.stamps_ns.tolist())
    # In a map there is no start to wait for: what is not placed is lost.
    missed = {Status.LOST} if is_mapping else {Status.LOST, Status.INITIALIZING}
    lost = [e for e in logbook.estimates if e.status in missed and e.stamp_ns not in placed]
    metrics["tracked"], metrics["lost"] = len(placed), len(lost)
    metrics["is_metric"] = result.is_metric
    metrics["path_m"] = float(result.trajectory.path_length) if len(result.trajectory) else 0.0
    metrics["keyframes"] = len(result.keyframes)
    metrics["map_keyframes"] = result.map.num_keyframes
    metrics["landmarks"] = result.map.num_landmarks
    metrics["loops"] = sum(kind == LOOP for kind in result.map.edges().kind)
    metrics["loops_closed"] = None if logbook.loops is None else logbook.loops.num_closed
    metrics["loops_rejected"] = None if logbook.loops is None else logbook.loops.num_rejected
    metrics["failure"] = logbook.failure(len(placed))
    if not is_mapping:
        metrics["localised"] = len(placed)
        metrics["keyframes"] = result.map.num_keyframes
        metrics["failure"] = "" if placed else _unplaced(logbook)
    metrics["ate_rmse_m"] = None
    metrics["ate"] = None
    if source.truth is not None:
        try:
            truth = result.truth(source.truth)
            found = ate(result.trajectory, truth, "se3" if result.is_metric else "sim3")
        except InputError as error:
            warnings.append(f"no comparison with the ground truth: {error}")
        else:
            metrics["ate_rmse_m"] = found.rmse
            metrics["ate"] = found.as_dict()
    if not result.is_metric:
        warnings.append("one camera cannot tell the scale: lengths are in units of their own")
    anew = [e for e in logbook.estimates if e.is_keyframe and e.status == Status.INITIALIZING]
    if anew:
        times = "once" if len(anew) == 1 else f"{len(anew)} times"
        warnings.append(f"tracking {anew[0].reason} (frame {anew[0].frame_id}, {times} in all)")
    pieces = len(Atlas(result.map).pieces)
    if pieces > 1:
        warnings.append(f"the map is in {pieces} pieces: where they are to each other is not known")
    if metrics["skipped"]:
        first, count = source.skipped[0], metrics["skipped"]
        what = "1 measurement" if count == 1 else f"{count} measurements, the first"
        warnings.append(f"skipped {what}: {first.file}: {first.reason}")
    for frame_id, seconds in logbook.gaps():
        warnings.append(f"a gap of {seconds:.2f} s after frame {frame_id}")
    if lost and not metrics["failure"]:
        warnings.append(f"{len(lost)} of {metrics['frames']} frames lost: {lost[0].reason}")
    warnings += _doubts(logbook)
    metrics["warnings"] = warnings
    metrics["versions"] = versions()
    return metrics, warnings


def _doubts(logbook: Logbook) -> list[str]:
    """Say of how many frames a pose is not all that was asked for, if they are not few."""
    doubted = [e for e in logbook.estimates if e.status == Status.TRACKING and e.reason]
    if len(doubted) <= DOUBTED * len(logbook.estimates):
        return []
    share, first = f"{len(doubted)} of {len(logbook.estimates)} frames", doubted[0]
    return [f"{share} tracked with a doubt, first frame {first.frame_id}: {first.reason}"]


def _unplaced(logbook: Logbook) -> str:
    """Return why no frame has a place in a map."""
    if not logbook.estimates:
        return "no frame could be read"
    reasons = Counter(e.reason for e in logbook.estimates if e.reason)
    why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
    return f"none of {len(logbook.estimates)} frames could be localised{why}"
