"""`odomap info`: what a recording holds."""

import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from odomap.sensors.rig import Rig
    from odomap.sources.source import Source

__all__ = ["Info"]


@dataclass(frozen=True)
class Info:
    """Say what a recording holds: frames, sensors, calibration, ground truth."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder of a recording, a world.yaml, or 'sim:room?seed=3&frames=100'."""
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rig.yaml: which sensors there are and where they are mounted."""
    check: bool = False
    """Read every frame, and count those that cannot be used."""
    json: bool = False
    """Print JSON."""

    def execute(self) -> int:
        """Print the facts."""
        from odomap.sources.open import open as open_source

        source = open_source(self.data, self.rig)
        facts = describe(source)
        if self.check:
            facts["check"] = read_all(source)
        if self.json:
            print(json.dumps(facts, indent=2))
        else:
            print("\n".join(lines(facts)))
        return 0


def describe(source: "Source") -> dict[str, Any]:
    """Return the facts about a source, without reading its frames."""
    truth = source.truth
    facts: dict[str, Any] = {
        "name": source.name,
        "format": type(source).__name__.removesuffix("Source").lower(),
        "frames": len(source),
        "cameras": [
            {
                "name": mount.name,
                "model": mount.camera.model,
                "resolution": [mount.camera.width, mount.camera.height],
                "focal_px": [round(mount.camera.fx, 3), round(mount.camera.fy, 3)],
                "distortion": [float(k) for k in mount.camera.distortion],
                "rate_hz": mount.rate_hz,
            }
            for mount in source.rig.cameras
        ],
        "stereo_baseline_m": baseline(source.rig),
        "imu_rate_hz": source.rig.imu.rate_hz if source.rig.imu else None,
        "lidars": [mount.name for mount in source.rig.lidars],
    }
    if truth is None:
        facts["truth"] = None
    else:
        span = int(truth.stamps_ns[-1] - truth.stamps_ns[0]) * 1e-9 if len(truth) else 0.0
        facts["truth"] = {"poses": len(truth), "duration_s": span, "path_m": truth.path_length}
    return facts


def baseline(rig: "Rig") -> float | None:
    """Return the distance between the stereo cameras in metres, None without a pair."""
    if len(rig.cameras) < 2:
        return None
    left, right = rig.stereo_pair()
    return math.dist(left.T_body_camera.t, right.T_body_camera.t)


def read_all(source: "Source") -> dict[str, Any]:
    """Read every frame; return how many there are, their span, and what had to be skipped."""
    stamps = [frame.stamp_ns for frame in source]
    gaps = [b - a for a, b in itertools.pairwise(stamps)]
    return {
        "frames_read": len(stamps),
        "duration_s": (stamps[-1] - stamps[0]) * 1e-9 if stamps else 0.0,
        "longest_gap_s": max(gaps, default=0) * 1e-9,
        "skipped": [f"{item.file}: {item.reason}" for item in source.skipped],
    }


def lines(facts: dict[str, Any]) -> list[str]:
    """Return the facts as lines for people."""
    out = [f"{facts['name']}: {facts['frames']} frames, {facts['format']}"]
    for camera in facts["cameras"]:
        w, h = camera["resolution"]
        rate = f", {camera['rate_hz']:g} Hz" if camera["rate_hz"] else ""
        bend = "distorted" if any(camera["distortion"]) else "no distortion"
        text = f"{camera['model']} {w}x{h}, focal {camera['focal_px'][0]:g} px, {bend}{rate}"
        out.append(f"  camera {camera['name']:<8} {text}")
    if facts["stereo_baseline_m"]:
        out.append(f"  baseline        {facts['stereo_baseline_m']:.4f} m")
    if facts["imu_rate_hz"]:
        out.append(f"  imu             {facts['imu_rate_hz']:g} Hz")
    out += [f"  lidar           {name}" for name in facts["lidars"]]
    truth = facts["truth"]
    found = f"{truth['poses']} poses, {truth['path_m']:.2f} m" if truth else "none"
    out.append(f"  ground truth    {found}")
    if "check" in facts:
        check = facts["check"]
        gap = f"longest gap {check['longest_gap_s']:.3f} s"
        out.append(f"  read            {check['frames_read']} frames, {gap}")
        out.append(f"  skipped         {len(check['skipped'])}")
        out += [f"    {line}" for line in check["skipped"]]
    return out
