"""A run's recording, opened again: what its keyframes saw, at where they are now.

A run keeps no depth: depth is in the recording, and poses are in the run's folder, which says of
which recording and calibration it was made. So the recording is opened again, and the frames at
the keyframes' stamps are read; stamps written as text may have lost their last digits.

Reference: B. Curless, M. Levoy, "A volumetric method for building complex models from range
images", SIGGRAPH 1996 (depth fused at poses known later).
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from odomap.errors import InputError
from odomap.files.trajectories import read_tum
from odomap.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from odomap.maps.depthviews import DepthView, DepthViews
    from odomap.sensors.rig import Rig
    from odomap.sources.source import Source

__all__ = ["keyframe_poses", "keyframe_views", "need_metres", "open_recording"]

SAME_NS = 1000
"""Stamps this near are the same: text of another program may have six decimals only."""
STEP = (0.1, np.deg2rad(10.0))
"""Motion, metres and radians, from one pose used to the next where keyframes are not known."""


def keyframe_poses(folder: Path) -> tuple[Trajectory, list[str]]:
    """Return T_world_body at the keyframes."""
    if (folder / "keyframes.tum").exists():
        return read_tum(folder / "keyframes.tum"), []
    if not (folder / "trajectory.tum").exists():
        raise InputError(
            f"{folder}: has no keyframes.tum: give the output folder of a finished `odomap run`"
        )
    path = read_tum(folder / "trajectory.tum")
    chosen = [0]
    for row in range(1, len(path)):
        moved = (path.pose(chosen[-1]).inverse() @ path.pose(row)).log()
        if np.linalg.norm(moved[:3]) > STEP[0] or np.linalg.norm(moved[3:]) > STEP[1]:
            chosen.append(row)
    note = f"there is no keyframes.tum: {len(chosen)} poses of trajectory.tum are used"
    return path.rows(chosen), [note]


def need_metres(folder: Path) -> None:
    """Raise an InputError if the run's path has no scale: metres of depth do not fit to it."""
    try:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return  # a path from elsewhere, of which nothing is said, is taken to be metric
    if isinstance(metrics, dict) and metrics.get("is_metric") is False:
        raise InputError(
            f"{folder}: the run is of one camera, so its path has no scale that depth would fit "
            "to: run it again with depth or a stereo pair (without --preset mono)"
        )


def open_recording(
    folder: Path, data: str | Path | None, rig: "Rig | str | Path | None"
) -> "Source":
    """Open the recording again that the run was made from."""
    from odomap.sources.open import open as open_source

    head = _head(folder / "config.yaml") if data is None or rig is None else {}
    where = str(head.get("data") or "") if data is None else str(data)
    if not where:
        raise InputError(
            f"{folder / 'config.yaml'}: does not say of which recording the run is: "
            "give it with --data PATH"
        )
    if where.startswith("camera:"):
        raise InputError(f"{folder}: was made live from {where}, which left no recording")
    if data is None and not where.startswith("sim:") and not Path(where).exists():
        raise InputError(
            f"{where}: the recording of {folder} is no longer there: "
            "give its new place with --data PATH"
        )
    # The calibration that the run was given belongs to its recording, wherever that is now.
    given = rig if rig is not None else head.get("rig")
    if rig is None and given is not None and not Path(str(given)).exists():
        raise InputError(
            f"{given}: the calibration of {folder} is no longer there: give it with --rig FILE"
        )
    return open_source(where, given)


def _head(file: Path) -> dict[str, Any]:
    """Return what the head of a config.yaml says; nothing where there is none."""
    import yaml

    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not YAML: {' '.join(str(error).split())}") from error
    return content if isinstance(content, dict) else {}


def keyframe_views(
    source: "Source", views: "DepthViews", poses: Trajectory, skipped: list[str]
) -> Iterator[tuple[int, "DepthView"]]:
    """Yield the row of each pose and the view of its frame.

    Raises:
        InputError: not one of the stamps is in the recording.
    """
    from odomap.sources.source import Coloured, RandomAccess, UnusableFrame

    coloured = source if isinstance(source, Coloured) else None
    if isinstance(source, RandomAccess):
        rows = _nearest(poses.stamps_ns, source.stamps_ns)
        known = [(int(row), int(index)) for row, index in enumerate(rows) if index >= 0]
        _need_some(len(known), source, poses)
        for row, index in known:
            try:
                colour = None if coloured is None else coloured.colour(index)
                view = views.view(source.frame(index), colour)
            except UnusableFrame as error:
                skipped.append(f"a keyframe is left out: {error}")
                continue
            if view is not None:
                yield row, view
        return
    count = 0
    for frame in source:
        row = int(_nearest(np.array([frame.stamp_ns]), poses.stamps_ns)[0])
        if row >= 0:
            count += 1
            view = views.view(frame)
            if view is not None:
                yield row, view
    _need_some(count, source, poses)


def _nearest(stamps: "NDArray[np.int64]", known: "NDArray[np.int64]") -> "NDArray[np.int64]":
    """Return for each stamp the row of the known one that is the same, or -1."""
    if not len(known):
        return np.full(len(stamps), -1, np.int64)
    right = np.clip(np.searchsorted(known, stamps), 0, len(known) - 1)
    left = np.maximum(right - 1, 0)
    row = np.where(np.abs(known[right] - stamps) <= np.abs(known[left] - stamps), right, left)
    return np.where(np.abs(known[row] - stamps) <= SAME_NS, row, -1).astype(np.int64)


def _need_some(count: int, source: "Source", poses: Trajectory) -> None:
    if count == 0:
        raise InputError(
            f"{source.name}: has no frame at any of the {len(poses)} keyframes' stamps: "
            "is it the recording that the run was made from?"
        )
