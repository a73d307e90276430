"""What a recording holds, in numbers: for `odomap info`, and to see at once what is odd about it.

Stamps are read, images are not; of sweeps a few are. A gap is a step between frames longer than
three usual (median) ones: no error, since recordings have them, but worth knowing, since a tracker
may get lost there.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.depth import DepthFiles
from odomap.sources.scans import Beams
from odomap.sources.source import RandomAccess, Source
from odomap.sources.survey import SweepSurvey, survey_frames

__all__ = ["describe"]

GAP_STEPS = 3.0


def describe(source: Source) -> dict[str, Any]:
    """Describe a source without reading its frames.

    Args:
        source: any source; times are known of those that can be read in any order.

    Returns:
        Plain numbers, texts, lists and mappings: name, format, frames, duration_s, rate_hz, gaps,
        steps_s, cameras, stereo_baseline_m, depth, imu_rate_hz, lidars, scans, sweeps, body,
        details, truth, skipped, notes. Frames are None where they cannot be counted, as of a live
        camera.
    """
    rig = source.rig
    return {
        "name": source.name,
        "format": type(source).__name__.strip("_").removesuffix("Source").lower(),
        "frames": len(source) or None,
        **_times(source),
        "cameras": [
            {
                "name": mount.name,
                "model": mount.camera.model,
                "resolution": [mount.camera.width, mount.camera.height],
                "focal_px": [round(mount.camera.fx, 3), round(mount.camera.fy, 3)],
                "distortion": [float(k) for k in mount.camera.distortion],
                "rate_hz": mount.rate_hz,
            }
            for mount in rig.cameras
        ],
        "stereo_baseline_m": _baseline(rig),
        "depth": _depth(source),
        "imu_rate_hz": None if rig.imu is None else rig.imu.rate_hz,
        "lidars": [_lidar(mount) for mount in rig.lidars],
        "scans": _scans(source),
        "sweeps": _sweeps(source),
        "body": rig.body_sensor,
        "details": dict(getattr(source, "details", {})),
        "truth": _truth(source),
        "skipped": [f"{item.file}: {item.reason}" for item in source.skipped],
        "notes": list(getattr(source, "notes", [])),
    }


def _times(source: Source) -> dict[str, Any]:
    if not isinstance(source, RandomAccess) or len(source) == 0:
        return {"duration_s": None, "rate_hz": None, "steps_s": None, "gaps": []}
    stamps = source.stamps_ns
    goes_back = bool((np.diff(stamps) < 0).any())
    order = np.argsort(stamps, kind="stable")
    stamps = stamps[order]
    steps = np.diff(stamps)
    if len(steps) == 0:
        return {"duration_s": 0.0, "rate_hz": None, "steps_s": None, "gaps": []}
    # A clock that jumps leaves bunches of stamps, and their median step says nothing of the rate.
    usual = float(steps.mean() if goes_back else np.median(steps))
    gaps = [
        {
            "after_frame": int(order[i]),
            "stamp_s": float(stamps[i] * 1e-9),
            "gap_s": float(steps[i] * 1e-9),
        }
        for i in np.flatnonzero(steps > GAP_STEPS * usual)
    ]
    return {
        "duration_s": float((stamps[-1] - stamps[0]) * 1e-9),
        "rate_hz": round(1e9 / usual, 3),
        "steps_s": [float(steps.min() * 1e-9), float(steps.max() * 1e-9)],
        "gaps": gaps,
    }


def _lidar(mount: LidarMount) -> dict[str, Any]:
    first, last, beams = mount.angles
    facts: dict[str, Any] = {
        "name": mount.name,
        "range_m": [round(float(r), 3) for r in mount.range_m],
        "rate_hz": round(mount.rate_hz, 3),
        "sweep": mount.sweep,
    }
    if mount.beams:
        facts["beams"] = mount.beams
    if beams:
        facts |= {
            "beams": beams,
            "angles_deg": [round(float(np.degrees(a)), 3) for a in (first, last)],
            "step_deg": round(float(np.degrees(last - first)) / max(beams - 1, 1), 4),
        }
    return facts


def _scans(source: Source) -> dict[str, Any] | None:
    """Return what became of the beams of a recording, and how far its wheels went."""
    beams: Beams | None = getattr(source, "beams", None)
    odometry: NDArray[np.float64] | None = getattr(source, "odometry", None)
    if beams is None and odometry is None:
        return None
    facts: dict[str, Any] = {"odometry_path_m": None}
    if odometry is not None:
        steps = np.diff(odometry[:, :3, 3], axis=0)
        # Where the wheels say nothing there is no step.
        facts["odometry_path_m"] = round(float(np.nansum(np.linalg.norm(steps, axis=1))), 3)
    if beams is not None:
        value = beams.no_return_m
        facts["no_return_m"] = round(value, 4) if np.isfinite(value) else None
        facts["share_no_return"] = round(beams.share_no_return, 5)
        facts["share_invalid"] = round(beams.share_invalid, 5)
    return facts


def _sweeps(source: Source) -> dict[str, Any] | None:
    """Return what the sweeps of a 3D LiDAR are like."""
    seen: SweepSurvey | None = getattr(source, "survey", None)
    if seen is None:
        is_3d = any(not mount.angles[2] for mount in source.rig.lidars)
        if not is_3d or not isinstance(source, RandomAccess):
            return None
        seen = survey_frames(source)
    return {
        "points": list(seen.rows),
        "share_no_return": round(seen.share_lost, 5),
        "range_m": [round(r, 3) for r in seen.range_m],
        "elevation_deg": [round(float(np.degrees(a)), 2) for a in seen.elevation],
        "view_deg": round(float(np.degrees(seen.view)), 1),
        "times": seen.times,
        "times_s": [round(t, 6) for t in seen.span_s] if seen.times else None,
        "beams": seen.beams,
        "beams_by": seen.beams_how,
        "intensities": None if seen.intensities is None else list(seen.intensities),
    }


def _depth(source: Source) -> dict[str, Any] | None:
    """Return the factor of depth, and how well it is paired with colour."""
    files, mount = getattr(source, "depth", None), source.rig.depth
    if mount is None:
        return None
    facts: dict[str, Any] = {"camera": mount.camera, "factor": mount.factor}
    if isinstance(files, DepthFiles):
        offsets_ms = files.paired * 1e-6
        facts |= {
            "frames": len(offsets_ms),
            "offset_median_ms": round(float(np.median(offsets_ms)), 3),
            "offset_largest_ms": round(float(np.abs(offsets_ms).max()), 3),
        }
    return facts


def _baseline(rig: Rig) -> float | None:
    try:
        left, right = rig.stereo_pair()
    except CalibrationError:
        return None
    return float(np.linalg.norm(left.T_body_camera.t - right.T_body_camera.t))


def _truth(source: Source) -> dict[str, Any] | None:
    truth = source.truth
    if truth is None or len(truth) == 0:
        return None
    facts = {
        "poses": len(truth),
        "duration_s": truth.duration_s,
        "path_m": truth.path_length,
    }
    if isinstance(source, RandomAccess) and len(source):
        stamps = source.stamps_ns
        covered = (stamps >= truth.stamps_ns[0]) & (stamps <= truth.stamps_ns[-1])
        facts["frames_covered"] = int(np.count_nonzero(covered))
    return facts
