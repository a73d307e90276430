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
import lzma
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

import numpy as np

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
        vocabulary = _unpacked(options.vocabulary, scratch)

        def peer(layout: str, data: Path, truth: Trajectory) -> dict[str, float]:
            return _run_peer(options, vocabulary, layout, data, truth, scratch / "peer")

        rows = [_compare(options, peer, scratch, *pair) for pair in PAIRS]
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
    env = os.environ.get
    parser.add_argument("--data", default=env("ODOMAP_DATA"), help="folder of the real clips")
    parser.add_argument("--peer-python", default=env("ODOMAP_PEER_PYTHON"))
    parser.add_argument("--peer-script", default=env("ODOMAP_PEER_SCRIPT"))
    parser.add_argument("--vocabulary", help="default: DATA/peer/orb_vocabulary.txt.xz")
    parser.add_argument("--seeds", type=int, default=3, help="rendered worlds of each kind")
    parser.add_argument("--runs", type=int, default=3, help="runs on each real clip")
    parser.add_argument("--calibration-px", type=float, default=0.0, help="of the rendered rigs")
    parser.add_argument("--json", help="write the numbers here")
    options = parser.parse_args()
    for name in ("data", "peer_python", "peer_script"):
        if not getattr(options, name):
            flag = "--" + name.replace("_", "-")
            parser.error(f"{flag} is needed (or ODOMAP_{name.upper()})")
    options.vocabulary = options.vocabulary or f"{options.data}/peer/orb_vocabulary.txt.xz"
    return options


def _unpacked(vocabulary: str, scratch: Path) -> Path:
    """Unpack the vocabulary once rather than at every run."""
    if not vocabulary.endswith(".xz"):
        return Path(vocabulary)
    plain = scratch / "vocabulary.txt"
    with lzma.open(vocabulary) as packed:
        plain.write_bytes(packed.read())
    return plain


def _compare(options, peer, scratch, kind, clip, layout, fields) -> dict[str, object]:
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
    real_runs = [peer(layout, real, matched) for _ in range(options.runs)]
    rendered_runs, ours = [], []
    for seed in range(options.seeds):
        world = World.make(kind=kind, seed=seed, **spec)
        folder = export_euroc(world, scratch / f"{kind}{seed}")
        rendered_runs.append(peer("euroc", folder, world.truth))
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


def _run_peer(options, vocabulary, layout, data, truth, prefix) -> dict[str, float]:
    command = [options.peer_python, options.peer_script, layout, str(data), "--mode", "stereo"]
    command += ["--vocab", str(vocabulary), "--out", str(prefix), "--pace"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"the peer failed on {data}:\n{done.stderr[-2000:]}")
    said = json.loads(done.stdout.strip().splitlines()[-1])
    result = ate(read_tum(Path(f"{prefix}.tum")), truth)
    return {
        "percent": result.percent,
        "ate_m": result.rmse,
        "path_m": result.path_m,
        "frames": said["frames"],
        "tracked": said["states"].get("OK", 0),
        "ms_median": said["ms_median"],
    }


def _run_ours(data: Path, truth: Trajectory) -> float:
    source = open_source(data)
    odometry = StereoVO(source.rig)
    for frame in source:
        odometry.track(frame)
    return ate(odometry.finish().trajectory, truth).percent


if __name__ == "__main__":
    sys.exit(main())
