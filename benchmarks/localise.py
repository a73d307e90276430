"""A map saved, loaded, and localised in: even frames make it, odd frames are placed in it.

    python benchmarks/localise.py --data DATA [--recordings rgbd_desk euroc_mh01] [--suffix=-flow]

For each recording: SLAM over the even frames leaves a map; it is saved and loaded again; the odd
frames, which it has never seen, are placed in it without changing it, the first one by recognition
alone. Their poses are compared with those of SLAM over all frames. Both worlds begin at the same
first frame, so nothing is aligned; what remains after an alignment is printed beside.

Bars: loading takes less than 1 s; the worst frame is within 2 cm and 0.5 degrees; at least 95 % of
the odd frames are localised; loading gives a map that saves to the same bytes, and that
localising leaves as it was. Exit code 1 where one is missed, 2 where a recording is missing.
"""

import argparse
import hashlib
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from odomap.evaluation.match import rotation_angle
from odomap.evaluation.metrics import ate
from odomap.files.mapfile import load_map, save_map
from odomap.geometry.trajectory import Trajectory
from odomap.maps.map import Map
from odomap.sources.disturb import drop
from odomap.sources.open import open as open_source
from odomap.sources.source import Source
from odomap.system.config import Config, preset, preset_for
from odomap.system.slam import Slam

LONGEST_LOAD_S = 1.0
LARGEST_ERROR_M, LARGEST_ERROR_DEG = 0.02, 0.5
LEAST_SHARE = 0.95


def main() -> int:
    options = _options()
    cv2.setNumThreads(1)
    missed: list[str] = []
    results: dict[str, dict[str, float]] = {}
    for name in options.recordings:
        source = open_source(Path(options.data) / name)
        usual = preset_for(source.rig)
        numbers = measure(source, preset(usual + options.suffix), preset(usual))
        print_numbers(name, numbers)
        missed += below_bars(name, numbers)
        results[name] = numbers
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", default=os.environ.get("ODOMAP_DATA"))
    parser.add_argument("--recordings", nargs="+", default=["rgbd_desk", "euroc_mh01"])
    parser.add_argument("--suffix", default="", help="of the preset that maps: -flow")
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    if not options.data:
        parser.exit(2, f"{parser.prog}: --data is needed (or set ODOMAP_DATA)\n")
    for name in options.recordings:
        if not (Path(options.data) / name).exists():
            parser.exit(2, f"{parser.prog}: --data: there is no {name} in {options.data}\n")
    return options


def measure(source: Source, mapping: Config, placing: Config) -> dict[str, float]:
    """Map the even frames, save, load, localise the odd ones; return what is to be told.

    Args:
        source: the recording.
        mapping: how frames are tracked that make a map.
        placing: how those are that are placed in it.
    """
    ids = range(len(source))
    even, odd = drop(source, ids[1::2]), drop(source, ids[0::2])
    whole = slam(source, mapping).finish().trajectory
    made = slam(even, mapping)
    made.finish()
    with tempfile.TemporaryDirectory(prefix="odomap-localise-") as folder:
        first, again = Path(folder) / "first.odomap", Path(folder) / "again.odomap"
        save_map(first, made.map, source.rig)
        loaded, load_s = timed_load(first)
        save_map(again, loaded, source.rig)
        numbers = {
            "frames": float(len(odd)),
            "keyframes": float(loaded.num_keyframes),
            "landmarks": float(loaded.num_landmarks),
            "file_mb": first.stat().st_size / 2**20,
            "load_s": load_s,
            "is_same_file": float(digest(first) == digest(again)),
        }
        placed = slam(odd, placing, loaded).finish().trajectory
        counted = {"seen", "expected"}  # how often landmarks are found is remembered
        numbers["is_unchanged"] = float(same(made.map, loaded, counted))
    return numbers | errors(placed, whole) | {"share": len(placed) / len(odd)}


def slam(source: Source, config: Config, map: Map | None = None) -> Slam:
    """Play a source to SLAM; with a map, only place its frames there."""
    system = Slam(source.rig, config, map=map, is_mapping=map is None)
    for frame in source:
        system.track(frame)
    return system


def timed_load(path: Path, repeat: int = 3) -> tuple[Map, float]:
    """Load a map several times; return it and the shortest time in seconds."""
    laps = []
    for _ in range(repeat):
        start = time.perf_counter()
        loaded = load_map(path)
        laps.append(time.perf_counter() - start)
    return loaded, min(laps)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def same(a: Map, b: Map, but: set[str]) -> bool:
    """Say whether two maps hold the same, some columns excepted."""
    ours, theirs = a.dump().columns, b.dump().columns
    return ours.keys() == theirs.keys() and all(
        np.array_equal(ours[name], theirs[name], equal_nan=ours[name].dtype.kind == "f")
        for name in ours
        if name.split("/")[-1] not in but
    )


def errors(placed: Trajectory, whole: Trajectory) -> dict[str, float]:
    """Return how far poses are from those of the same instants in another trajectory."""
    _, a, b = np.intersect1d(placed.stamps_ns, whole.stamps_ns, return_indices=True)
    if not len(a):
        return dict.fromkeys(("median_m", "worst_m", "median_deg", "worst_deg"), np.inf)
    Ts, truth = placed.Ts_world_body[a], whole.Ts_world_body[b]
    away = np.linalg.norm(Ts[:, :3, 3] - truth[:, :3, 3], axis=1)
    turned = np.swapaxes(truth[:, :3, :3], 1, 2) @ Ts[:, :3, :3]
    angle = np.degrees(rotation_angle(turned))
    return {
        "median_m": float(np.median(away)),
        "worst_m": float(away.max()),
        "median_deg": float(np.median(angle)),
        "worst_deg": float(angle.max()),
        "aligned_rmse_m": ate(placed, whole).rmse,
    }


def below_bars(name: str, numbers: dict[str, float]) -> list[str]:
    """Return a sentence for every bar that is missed."""
    bars = (
        ("loading", numbers["load_s"], LONGEST_LOAD_S, "s"),
        ("the worst frame", numbers["worst_m"], LARGEST_ERROR_M, "m"),
        ("the worst frame", numbers["worst_deg"], LARGEST_ERROR_DEG, "degrees"),
    )
    missed = [
        f"{name}: {what}: {value:.3f} {unit}, at most {bar} {unit}"
        for what, value, bar, unit in bars
        if not value <= bar
    ]
    if numbers["share"] < LEAST_SHARE:
        share = f"{100 * numbers['share']:.0f} % of the frames are localised"
        missed.append(f"{name}: {share}, {100 * LEAST_SHARE:.0f} % needed")
    if not numbers["is_same_file"]:
        missed.append(f"{name}: loaded and saved again, the file is another one")
    if not numbers["is_unchanged"]:
        missed.append(f"{name}: localising has changed the map")
    return missed


def print_numbers(name: str, numbers: dict[str, float]) -> None:
    """Print everything about a recording."""
    n = numbers
    print(
        f"{name}: map of {n['keyframes']:.0f} keyframes, {n['landmarks']:.0f} landmarks, "
        f"{n['file_mb']:.2f} MB, loaded in {n['load_s']:.3f} s"
    )
    print(
        f"  {100 * n['share']:.1f} % of {n['frames']:.0f} frames localised; off by "
        f"{n['median_m']:.4f} m, {n['median_deg']:.3f} deg (median), "
        f"{n['worst_m']:.4f} m, {n['worst_deg']:.3f} deg (worst)"
        + (f", {n['aligned_rmse_m']:.4f} m aligned (RMS)" if "aligned_rmse_m" in n else ""),
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
