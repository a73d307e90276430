"""Is the rendered world as hard as the real one? Ask a system that had no part in making it.

ORB-SLAM3 runs on a real stereo clip and on a rendered one of the same number of frames, the same
frame rate and the same length of path, at sensor pace; the figure is the RMSE of its absolute
trajectory error in percent of the path. The real figure is the median over runs (the peer differs
from run to run), the rendered one the median over seeds. Demand: rendered at least half of real.

The figure of our own StereoVO on the same images stands beside it, without a demand: it shows what
a perfect calibration and exact truth are worth to a system that can use them; --calibration-px 0.1
gives the rendered rigs the errors of a real calibration.

    python benchmarks/realism.py --data DATA --peer-python PYTHON --peer-script SCRIPT

or ODOMAP_DATA, ODOMAP_PEER_PYTHON and ODOMAP_PEER_SCRIPT. Exit code 1 where the rendered world is
more than twice as easy.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from statistics import median

import numpy as np
import peer

from odomap.evaluation.metrics import ate
from odomap.files.trajectories import read_tum
from odomap.geometry.trajectory import Trajectory
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World
from odomap.sources.open import open as open_source
from odomap.system.odometry import StereoVO

PAIRS = (
    ("room", "euroc_mh01", "euroc", {"rate_hz": 20.0}),
    ("street", "kitti_stereo", "kitti", {"rate_hz": 10.0}),
)
LEAST_RATIO = 0.5


def main() -> int:
    options = _options()
    with tempfile.TemporaryDirectory(prefix="realism-") as folder:
        scratch = Path(folder)
        vocabulary = peer.unpacked(options.vocabulary, scratch)

        def run_peer(layout: str, data: Path, truth: Trajectory) -> dict[str, float]:
            played = peer.run(options, vocabulary, (layout, "stereo"), data, scratch / "peer")
            result = ate(played.trajectory(), truth)
            path = {"percent": result.percent, "path_m": result.path_m}
            return path | played.numbers(truth)

        rows = [_compare(options, run_peer, scratch, *pair) for pair in PAIRS]
    print(
        f"\n{'world':8} {'real clip':14} {'real %':>8} {'rendered %':>11} {'ratio':>6}"
        f" {'ours real %':>12} {'ours rendered %':>16}"
    )
    for row in rows:
        print(
            f"{row['world']:8} {row['clip']:14} {row['real_percent']:8.3f}"
            f" {row['rendered_percent']:11.3f} {row['ratio']:6.2f}"
            f" {row['ours_real_percent']:12.3f} {row['ours_rendered_percent']:16.3f}"
        )
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1), encoding="utf-8")
    easy = [row["world"] for row in rows if row["ratio"] < LEAST_RATIO]
    if easy:
        print(f"more than twice as easy as the real one: {', '.join(easy)}")
    return 1 if easy else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    peer.add_options(parser)
    parser.add_argument("--seeds", type=int, default=3, help="rendered worlds of each kind")
    parser.add_argument("--runs", type=int, default=3, help="runs on each real clip")
    parser.add_argument("--calibration-px", type=float, default=0.0, help="of the rendered rigs")
    parser.add_argument("--json", help="write the numbers here")
    options = parser.parse_args()
    peer.require(parser, options)
    return options


def _compare(options, run_peer, scratch, kind, clip, layout, fields) -> dict[str, object]:
    """Run the peer on a real clip and on rendered ones of the same length."""
    real = Path(options.data) / clip
    truth = read_tum(real / "groundtruth.txt")
    stamps = _image_stamps(real, layout)
    matched = truth.interpolate(
        stamps[(stamps >= truth.stamps_ns[0]) & (stamps <= truth.stamps_ns[-1])]
    )
    seconds = (len(stamps) - 1) / fields["rate_hz"]
    spec = {**fields, "frames": len(stamps), "speed": matched.path_length / seconds}
    spec["calibration_px"] = options.calibration_px
    print(f"{clip}: {len(stamps)} frames, {matched.path_length:.2f} m, {spec['speed']:.2f} m/s")
    real_runs = [run_peer(layout, real, matched) for _ in range(options.runs)]
    rendered_runs, ours = [], []
    for seed in range(options.seeds):
        world = World.make(kind=kind, seed=seed, **spec)
        folder = export_euroc(world, scratch / f"{kind}{seed}")
        rendered_runs.append(run_peer("euroc", folder, world.truth))
        ours.append(_run_ours(folder, world.truth))
    for name, runs in ((clip, real_runs), (f"rendered {kind}", rendered_runs)):
        for run in runs:
            print(f"  {name:16}", *(f"{key}={value:.4g}" for key, value in run.items()))
    real_percent = median(run["percent"] for run in real_runs)
    rendered_percent = median(run["percent"] for run in rendered_runs)
    return {
        "world": kind,
        "clip": clip,
        "real_percent": real_percent,
        "rendered_percent": rendered_percent,
        "ratio": rendered_percent / real_percent,
        "ours_real_percent": _run_ours(real, matched),
        "ours_rendered_percent": median(ours),
        "real_runs": real_runs,
        "rendered_runs": rendered_runs,
    }


def _image_stamps(folder: Path, layout: str) -> np.ndarray:
    if layout == "euroc":
        rows = (folder / "mav0/cam0/data.csv").read_text(encoding="utf-8").splitlines()
        return np.array([int(row.split(",")[0]) for row in rows if row[:1].isdigit()], np.int64)
    return np.rint(np.loadtxt(folder / "times.txt") * 1e9).astype(np.int64)


def _run_ours(data: Path, truth: Trajectory) -> float:
    source = open_source(data)
    odometry = StereoVO(source.rig)
    for frame in source:
        odometry.track(frame)
    return ate(odometry.finish().trajectory, truth).percent


if __name__ == "__main__":
    sys.exit(main())
