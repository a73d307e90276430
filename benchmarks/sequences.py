"""odomap and ORB-SLAM3 on the same images at the pace of the sensor: error, time, memory, ratio.

    python benchmarks/sequences.py [--repeats 3] [--gate | --update-baseline] [--json FILE]

Needs --data, --peer-python and --peer-script, or the variables in `peer`. The systems run one
after the other, each in its own process, alternating. Printed is the median over the repeats
with the smallest and largest; a ratio is the median of ours over the median of the peer's.

With --gate the exit code is 1 where a ratio is worse than in baseline.json by more than its
tolerance, or a bar is missed: error, frames with a pose, 30 frames per second, and for stereo
times at most 0.7 of the peer's.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import gate
import numpy as np
import peer
from meter import machine
from played import SKIPPED, Played, play

from odomap.evaluation.metrics import Alignment
from odomap.files.trajectories import read_tum
from odomap.run import RHYTHM
from odomap.system.rhythms import RHYTHMS

HERE = Path(__file__).parent
BASELINE = HERE / "baseline.json"
LARGEST_TIME_RATIO = 0.7
"""Of a stereo frame's time, ours over the peer's."""
SHOWN = {
    "ate_m": ("ATE RMSE, m", ".4f"),
    "tracked": ("frames tracked", ".0f"),
    "ms_mean": ("ms per frame, mean", ".1f"),
    "ms_median": ("ms per frame, median", ".1f"),
    "ms_p95": ("ms per frame, p95", ".1f"),
    "cpu_s": ("CPU seconds", ".2f"),
    "peak_memory_mb": ("peak memory, MB", ".0f"),
    "threads": ("threads", ".0f"),
}


@dataclass(frozen=True)
class Recording:
    """A recording, how it is played, and what is asked of us.

    Attributes:
        name: of the benchmark.
        folder: in --data.
        layout: what the peer's script calls it.
        mode: which of its sensors are used: stereo, mono or rgbd.
        largest_ate_m: bar for the error.
        least_frames: bar for the frames with a pose at the end.
        truth: file of the ground truth.
        least_rate_hz: bar for the frames per second; images of KITTI are larger, and come at 10 Hz.
    """

    name: str
    folder: str
    layout: str
    mode: str
    largest_ate_m: float
    least_frames: int
    truth: str = "groundtruth.txt"
    least_rate_hz: float = 30.0


RECORDINGS = {
    r.name: r
    for r in (
        Recording("euroc_mh01", "euroc_mh01", "euroc", "stereo", 0.0055, 110),
        Recording("kitti_stereo", "kitti_stereo", "kitti", "stereo", 0.11, 51),
        Recording("euroc_mono", "euroc_mh01", "euroc", "mono", 0.010, 102, "groundtruth_cam0.txt"),
        Recording("kitti_mono", "kitti_mono", "kitti", "mono", 0.20, 91, least_rate_hz=10.0),
        Recording("rgbd_desk", "rgbd_desk", "tum", "rgbd", 0.035, 160),
    )
}


def main() -> int:
    options = _options()
    now: dict[str, dict[str, float]] = {}
    missed: list[str] = []
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="odomap-sequences-") as folder:
        scratch = Path(folder)
        vocabulary = peer.unpacked(options.vocabulary, scratch)
        for name in options.recordings:
            runs = compare(options, RECORDINGS[name], vocabulary, scratch)
            ours, theirs = (median(runs[who]) for who in ("ours", "peer"))
            now[name] = gate.ratios(ours, theirs)
            print_table(name, runs, now[name])
            missed += below_bars(RECORDINGS[name], runs["ours"], now[name])
            results[name] = {"ratio": now[name], **runs}
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1), encoding="utf-8")
    if options.update_baseline:
        gate.write(BASELINE, now, {"date": date.today().isoformat(), "machine": machine()})
        print(f"written: {BASELINE.name}")
    if not options.gate:
        return 0
    worse = gate.regressions(now, gate.read(BASELINE))
    for line in worse:
        print(f"regression: {line}")
    print("gate: closed" if worse or missed else "gate: open")
    return 1 if worse or missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    peer.add_options(parser)
    parser.add_argument("--recordings", nargs="+", choices=RECORDINGS, default=list(RECORDINGS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--frames", type=int, default=0, help="only the first ones")
    parser.add_argument("--cv-threads", type=int, default=0, help="of Python's OpenCV, both sides")
    parser.add_argument("--rhythm", choices=RHYTHMS, default=RHYTHM, help="of ours")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of ours")
    parser.add_argument("--score-script", default=os.environ.get("ODOMAP_SCORE_SCRIPT"))
    parser.add_argument("--json", help="write all numbers here")
    parser.add_argument("--gate", action="store_true")
    parser.add_argument("--update-baseline", action="store_true")
    options = parser.parse_args()
    peer.require(parser, options)
    for name in options.recordings:
        truth = Path(RECORDINGS[name].folder) / RECORDINGS[name].truth
        if not (Path(options.data) / truth).exists():
            peer.refuse(parser, f"--data: there is no {truth} in {options.data}")
    changed = options.set or options.frames or options.cv_threads or options.rhythm != RHYTHM
    if options.update_baseline and changed:
        peer.refuse(parser, "--update-baseline wants default settings and all frames")
    beside = Path(options.peer_script).with_name("score.py")
    if not options.score_script and beside.exists():
        options.score_script = str(beside)
    return options


def compare(
    options: argparse.Namespace, recording: Recording, vocabulary: Path, scratch: Path
) -> dict[str, list[dict[str, float]]]:
    """Play a recording to both systems in turn; return the numbers of every run."""
    data = Path(options.data) / recording.folder
    truth = read_tum(data / recording.truth)
    align: Alignment = "sim3" if recording.mode == "mono" else "se3"
    runs: dict[str, list[dict[str, float]]] = {"ours": [], "peer": []}
    for repeat in range(options.repeats):
        for who in runs:
            prefix = scratch / f"{recording.name}-{who}-{repeat}"
            if who == "ours":
                played = run_ours(options, recording, data, prefix)
            else:
                played = peer.run(
                    options,
                    vocabulary,
                    (recording.layout, recording.mode),
                    data,
                    prefix,
                    options.frames,
                    options.cv_threads,
                )
            numbers = played.numbers(truth, align)
            if options.score_script:
                judge = options.score_script, align
                cross_check(judge, data / recording.truth, played, numbers["ate_m"])
            runs[who].append(numbers)
            print(
                f"{recording.name} {who} {repeat + 1}/{options.repeats}:",
                _line(numbers),
                flush=True,
            )
    return runs


def run_ours(options: argparse.Namespace, recording: Recording, data: Path, prefix: Path) -> Played:
    """Play a recording to odomap, in a process of its own."""
    command = [sys.executable, str(HERE / "ours.py"), str(data), str(prefix)]
    command += ["--preset", recording.mode, "--rhythm", options.rhythm]
    command += ["--frames", str(options.frames), "--cv-threads", str(options.cv_threads)]
    for assignment in options.set:
        command += ["--set", assignment]
    return play(command, prefix, f"odomap on {data.name}")


def cross_check(judge: tuple[str, Alignment], truth: Path, played: Played, error: float) -> None:
    """End where another evaluator, with the same alignment, finds another error in the files."""
    script, align = judge
    command = [sys.executable, script, "ate", str(truth), str(played.path), "--json"]
    command += ["--align", align]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{script} failed on {played.path.name}: {done.stderr.strip()[-500:]}")
    other = json.loads(done.stdout)["rmse_m"]
    if not abs(other - error) <= 1e-9:
        sys.exit(f"evaluators disagree on {played.path.name}: {error!r} and {other!r} m")


def median(runs: list[dict[str, float]]) -> dict[str, float]:
    """Return the median over runs of every quantity."""
    return {name: float(np.median([run[name] for run in runs])) for name in runs[0]}


def below_bars(
    recording: Recording, ours: list[dict[str, float]], ratio: dict[str, float]
) -> list[str]:
    """Return a sentence for every bar that is missed."""
    missed = []
    worst = max(run["ate_m"] for run in ours)
    if not worst <= recording.largest_ate_m:
        missed.append(f"{recording.name}: ATE {worst:.4f} m, at most {recording.largest_ate_m} m")
    least = min(run["tracked"] for run in ours)
    if least < recording.least_frames and all(
        run["frames"] >= recording.least_frames for run in ours
    ):
        missed.append(
            f"{recording.name}: {least:.0f} frames have a pose, {recording.least_frames} needed"
        )
    rate = 1e3 / max(run["ms_mean"] for run in ours)
    if rate < recording.least_rate_hz:
        missed.append(
            f"{recording.name}: {rate:.0f} frames per second, {recording.least_rate_hz:g} needed"
        )
    for name in ("ms_median", "ms_p95"):
        if recording.mode == "stereo" and not ratio[name] <= LARGEST_TIME_RATIO:
            missed.append(
                f"{recording.name}: {SHOWN[name][0]}: {ratio[name]:.2f} of the peer's,"
                f" at most {LARGEST_TIME_RATIO}"
            )
    return missed


def print_table(
    name: str, runs: dict[str, list[dict[str, float]]], ratio: dict[str, float]
) -> None:
    """Print median [smallest to largest] of both and the ratio of the medians."""
    frames = int(runs["ours"][0]["frames"])
    threads = {who: int(several[0]["cv_threads"]) for who, several in runs.items()}
    print(f"\n{name}: {frames} frames, {len(runs['ours'])} runs, times without the first {SKIPPED}")
    print(f"OpenCV threads: {threads['ours']} in odomap; {threads['peer']} in the peer's reader,")
    print("its own OpenCV inside and its three threads are as it was built")
    print(f"{'':22}{'odomap':>26}{'ORB-SLAM3':>26}{'ratio':>8}")
    for key, (label, form) in SHOWN.items():
        cells = [
            f"{_spread([run[key] for run in runs[who]], form):>26}" for who in ("ours", "peer")
        ]
        print(f"{label:22}{cells[0]}{cells[1]}{f'{ratio[key]:.2f}' if key in ratio else '':>8}")
    print(flush=True)


def _spread(values: list[float], form: str) -> str:
    low, high = f"{min(values):{form}}", f"{max(values):{form}}"
    middle = f"{np.median(values):{form}}"
    return middle if low == high else f"{middle} [{low} to {high}]"


def _line(numbers: dict[str, float]) -> str:
    return ", ".join(f"{label} {numbers[key]:{form}}" for key, (label, form) in SHOWN.items())


if __name__ == "__main__":
    sys.exit(main())
