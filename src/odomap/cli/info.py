"""`odomap info`: what a recording or a map file holds."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from odomap.errors import InputError

if TYPE_CHECKING:
    from odomap.sources.source import Source

__all__ = ["Info"]

MAP = "map.odomap"
VARIES = 1.5
"""A rate varies if the longest step between frames is so many shortest ones."""


@dataclass(frozen=True)
class Info:
    """Say what a recording (frames, sensors, calibration, gaps, truth) or a map file holds."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """A recording (EuRoC, KITTI, TUM RGB-D, a video, a folder of images or of a LiDAR's clouds, a
    laser's log, a bag, a capture), a camera ('camera:0'), a world.yaml,
    'sim:room?seed=3&frames=100', or a map: the output folder of a run, or its map.odomap."""
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rig.yaml: which sensors there are and where they are mounted."""
    check: bool = False
    """Read every frame, and say which cannot be used; read all of a map file."""
    json: bool = False
    """Print JSON."""

    def execute(self) -> int:
        """Print the facts."""
        place = Path(self.data)
        if place.is_dir() and (place / MAP).is_file() and (place / "metrics.json").is_file():
            place /= MAP  # of a run
        if place.suffix == ".odomap":
            from odomap.files.mapdescribe import describe_map, map_lines

            inside = describe_map(place, check=self.check)
            print(json.dumps(inside, indent=2) if self.json else "\n".join(map_lines(inside)))
            return 0
        from odomap.sources.describe import describe
        from odomap.sources.open import open as open_source

        source = open_source(self.data, self.rig)
        facts = describe(source)
        if self.check and not len(source):
            raise InputError(f"{self.data}: a live camera has no end: leave --check out")
        if self.check:
            facts["readable"] = read_all(source)
            facts["skipped"] = [f"{item.file}: {item.reason}" for item in source.skipped]
        if self.json:
            print(json.dumps(facts, indent=2))
        else:
            print("\n".join(lines(facts)))
        return 0


def read_all(source: "Source") -> int:
    """Read every frame and return how many could be."""
    from odomap.cli.progress import Steps

    count = 0
    with Steps("reading") as steps:
        for count, _ in enumerate(source, 1):
            steps.show(count, len(source), "")
    return count


def lines(facts: dict[str, Any]) -> list[str]:
    """Return the facts as lines for people."""
    rows = [("frames", _times(facts))]
    if "readable" in facts:
        rows.append(("readable", str(facts["readable"])))
    rows += [(f"camera {camera['name']}", _camera(camera)) for camera in facts["cameras"]]
    if facts["stereo_baseline_m"]:
        rows.append(("baseline", f"{facts['stereo_baseline_m']:.4f} m"))
    if facts["depth"]:
        rows.append(("depth", _depth(facts["depth"])))
    rows += [
        (name.removesuffix("_deg").replace("_", " "), _detail(name, value))
        for name, value in facts["details"].items()
        if value
    ]
    if facts["imu_rate_hz"]:
        rows.append(("imu", f"{facts['imu_rate_hz']:g} Hz"))
    rows += [(f"lidar {lidar['name']}", _lidar(lidar)) for lidar in facts["lidars"]]
    if facts["scans"]:
        rows += _scans(facts["scans"])
    if facts["sweeps"]:
        rows += _sweeps(facts["sweeps"])
    rows.append(("body", facts["body"] or "a frame of its own, none of these sensors"))
    rows.append(("ground truth", _truth(facts)))
    for gap in facts["gaps"][:10]:
        rows.append(("gap", f"{gap['gap_s']:.3f} s after frame {gap['after_frame']}"))
    rows += [("note", text) for text in facts["notes"]]
    rows += [("skipped", text) for text in facts["skipped"]]
    head = f"{facts['name']} ({facts['format']})"
    return [head, *(f"  {name:<14} {text}" for name, text in rows)]


def _times(facts: dict[str, Any]) -> str:
    if facts["frames"] is None:
        return "unknown: it is live"
    text = str(facts["frames"])
    if facts["duration_s"] is not None:
        text += f" in {facts['duration_s']:.2f} s"
    if facts["rate_hz"]:
        text += f", {facts['rate_hz']:g} Hz"
    if facts["steps_s"] and facts["steps_s"][1] > VARIES * facts["steps_s"][0]:
        low, high = (1e3 * step for step in facts["steps_s"])
        text += f" (varies: {low:.3g} to {high:.3g} ms apart)"
    return text


def _depth(depth: dict[str, Any]) -> str:
    text = f"{depth['factor']:g} per metre, registered to {depth['camera']}"
    if "frames" in depth:
        text += (
            f", of {depth['frames']} frames; {depth['offset_median_ms']:+g} ms from colour, "
            f"{depth['offset_largest_ms']:g} ms at most"
        )
    return text


def _detail(name: str, value: object) -> str:
    return f"{value}°" if name.endswith("_deg") else str(value)


def _camera(camera: dict[str, Any]) -> str:
    w, h = camera["resolution"]
    bend = "distorted" if any(camera["distortion"]) else "no distortion"
    return f"{camera['model']} {w}x{h}, focal {camera['focal_px'][0]:g} px, {bend}"


def _lidar(lidar: dict[str, Any]) -> str:
    near, far = lidar["range_m"]
    text = f"{near:g} to {far:g} m, {lidar['rate_hz']:g} Hz"
    if "angles_deg" not in lidar and "beams" in lidar:
        text = f"{lidar['beams']} beams above each other, {text}"
    if "angles_deg" in lidar:
        first, last = lidar["angles_deg"]
        view = f"{lidar['beams']} beams from {first:g}° to {last:g}°, every {lidar['step_deg']:g}°"
        text = f"{view}, {text}"
    return text if lidar["sweep"] == "none" else f"{text}, {lidar['sweep']} sweep"


def _scans(scans: dict[str, Any]) -> list[tuple[str, str]]:
    rows = []
    if "share_invalid" in scans:
        code = scans["no_return_m"]
        lost = f"{scans['share_no_return']:.2%} of the beams"
        rows.append(("no return", lost if code is None else f"{lost}, written as {code:g} m"))
        rows.append(("invalid", f"{scans['share_invalid']:.2%} of the beams"))
    path = scans["odometry_path_m"]
    rows.append(("odometry", "none" if path is None else f"of the wheels, {path:.2f} m"))
    return rows


def _sweeps(sweeps: dict[str, Any]) -> list[tuple[str, str]]:
    fewest, usual, most = sweeps["points"]
    low, high = sweeps["elevation_deg"]
    near, far = sweeps["range_m"]
    text = f"{usual} points ({fewest} to {most}), {near:g} to {far:g} m"
    text += f", {low:g}° to {high:g}° high, {sweeps['view_deg']:g}° around"
    if sweeps["share_no_return"]:
        text += f", {sweeps['share_no_return']:.2%} of the rows are no return"
    times = "none: a sweep is taken as of one instant, or the rig says how it turns"
    if sweeps["times"]:
        first, last = (1e3 * t for t in sweeps["times_s"])
        times = f"{first:.4g} to {last:.4g} ms, {sweeps['times']}"
    beams = f"{sweeps['beams']}, {sweeps['beams_by']}" if sweeps["beams"] else "not known"
    rows = [("sweeps", text), ("point times", times), ("beams", beams)]
    if sweeps["intensities"] is not None:
        rows.append(("intensity", "{:g} to {:g}".format(*sweeps["intensities"])))
    return rows


def _truth(facts: dict[str, Any]) -> str:
    truth = facts["truth"]
    if truth is None:
        return "none"
    text = f"{truth['poses']} poses, {truth['path_m']:.2f} m"
    if "frames_covered" in truth:
        text += f", covers {truth['frames_covered']} frames"
    return text
