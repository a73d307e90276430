"""odomap and ORB-SLAM3 on the same images at the pace of the sensor: error, time, memory, ratio.

    python benchmarks/sequences.py [--repeats 5] [--gate | --update-baseline] [--json FILE]
                                   [--preset-suffix=-flow | --preset NAME] [--odometry-only]

Needs --data, --peer-python and --peer-script, or the variables in `peer`. The systems run one
after the other, each in its own process, alternating. Printed is the median over the repeats
with the smallest and largest; a ratio is the median of ours over the median of the peer's.

Bars of SLAM: where the recording is one to beat the peer on, the error of every run at most the
median of the peer's, no frame lost if the peer loses none, median and p95 of the time per frame at
most 0.7 of the peer's; on all, frames with a pose, frames per second, and a trajectory of the same
bytes in every run. Bars of --odometry-only: errors of their own, and times for stereo alone.

With --gate the exit code is 1 where a ratio is worse than in baseline.json by more than its
tolerance, or a bar is missed.
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
"""Of a frame's time, ours over the peer's."""
SHOWN = {
    "ate_m": ("ATE RMSE, m", ".4f"),
    "tracked": ("frames tracked", ".0f"),
    "lost": ("frames lost", ".0f"),
    "ms_mean": ("ms per frame, mean", ".1f"),
    "ms_median": ("ms per frame, median", ".1f"),
    "ms_p95": ("ms per frame, p95", ".1f"),
    "stall_p99": ("of it mapping, p99", ".1f"),
    "cpu_s": ("CPU seconds", ".2f"),
    "peak_memory_mb": ("peak memory, MB", ".0f"),
    "threads": ("threads", ".0f"),
}


Runs = dict[str, list[dict[str, float]]]
"""The numbers of every run, of "ours" and of the "peer"."""


@dataclass(frozen=True)
class Recording:
    """A recording, how it is played, and what is asked of us.

    Attributes:
        name: of the benchmark.
        folder: in --data.
        layout: what the peer's script calls it.
        mode: which of its sensors are used: stereo, mono or rgbd.
        largest_ate_m: bar for the error of odometry, and where SLAM is not held against the peer.
        least_frames: bar for the frames with a pose at the end.
        truth: file of the ground truth.
        least_rate_hz: bar for the frames per second; images of KITTI are larger, and come at 10 Hz.
        beats_peer: whether error and time of SLAM are held against the peer's.
    """

    name: str
    folder: str
    layout: str
    mode: str
    largest_ate_m: float
    least_frames: int
    truth: str = "groundtruth.txt"
    least_rate_hz: float = 30.0
    beats_peer: bool = True


RECORDINGS = {
    r.name: r
    for r in (
        Recording("euroc_mh01", "euroc_mh01", "euroc", "stereo", 0.0055, 110),
        Recording("kitti_stereo", "kitti_stereo", "kitti", "stereo", 0.11, 51),
        Recording(
            *("euroc_mono", "euroc_mh01", "euroc", "mono", 0.010, 102, "groundtruth_cam0.txt"),
            beats_peer=False,
        ),
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
            key = f"odometry/{name}" if options.odometry_only else name
            now[key] = gate.ratios(ours, theirs)
            print_table(name, runs, now[key])
            bars = odometry_bars if options.odometry_only else slam_bars
            missed += bars(RECORDINGS[name], runs, now[key])
            results[key] = {"ratio": now[key], **runs}
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
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--frames", type=int, default=0, help="only the first ones")
    parser.add_argument("--cv-threads", type=int, default=0, help="of Python's OpenCV, both sides")
    parser.add_argument("--odometry-only", action="store_true", help="ours without SLAM")
    parser.add_argument("--preset", help="of ours; default the one for the recording's sensors")
    parser.add_argument("--preset-suffix", default="", metavar="-flow", help="added to it")
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
    changed = changed or options.preset or options.preset_suffix
    if options.update_baseline and changed:
        peer.refuse(parser, "--update-baseline wants default settings and all frames")
    beside = Path(options.peer_script).with_name("score.py")
    if not options.score_script and beside.exists():
        options.score_script = str(beside)
    return options


def compare(
    options: argparse.Namespace, recording: Recording, vocabulary: Path, scratch: Path
) -> Runs:
    """Play a recording to both systems in turn; return the numbers of every run."""
    data = Path(options.data) / recording.folder
    truth = read_tum(data / recording.truth)
    align: Alignment = "sim3" if recording.mode == "mono" else "se3"
    runs: Runs = {"ours": [], "peer": []}
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
            if options.rhythm == "live":  # which is not repeatable, and does not say so
                del numbers["digest"]
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
    suffix = options.preset_suffix or ("-flow" if options.odometry_only else "")
    preset = options.preset or recording.mode + suffix
    command += ["--preset", preset, "--rhythm", options.rhythm]
    command += ["--odometry-only"] if options.odometry_only else []
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


def odometry_bars(recording: Recording, runs: Runs, ratio: dict[str, float]) -> list[str]:
    """Return a sentence for every bar that odometry misses."""
    missed = _error_bar(recording, runs["ours"], recording.largest_ate_m)
    missed += _usable_bars(recording, runs["ours"])
    return missed + (_time_bars(recording, ratio) if recording.mode == "stereo" else [])


def slam_bars(recording: Recording, runs: Runs, ratio: dict[str, float]) -> list[str]:
    """Return a sentence for every bar that SLAM misses."""
    ours, theirs = runs["ours"], median(runs["peer"])
    missed = _usable_bars(recording, ours)
    if len({run["digest"] for run in ours if "digest" in run}) > 1:
        missed.append(f"{recording.name}: trajectories differ from run to run")
    if not recording.beats_peer:
        return missed + _error_bar(recording, ours, recording.largest_ate_m)
    missed += _error_bar(recording, ours, theirs["ate_m"])
    lost = max(run["lost"] for run in ours)
    if lost and not max(run["lost"] for run in runs["peer"]):
        missed.append(f"{recording.name}: {lost:.0f} frames lost, where the peer loses none")
    return missed + _time_bars(recording, ratio)


def _error_bar(recording: Recording, ours: list[dict[str, float]], largest_m: float) -> list[str]:
    worst = max(run["ate_m"] for run in ours)
    if worst <= largest_m:
        return []
    return [f"{recording.name}: ATE {worst:.4f} m, at most {largest_m:.4f} m"]


def _usable_bars(recording: Recording, ours: list[dict[str, float]]) -> list[str]:
    """Frames with a pose, and frames per second."""
    missed = []
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
    return missed


def _time_bars(recording: Recording, ratio: dict[str, float]) -> list[str]:
    return [
        f"{recording.name}: {SHOWN[name][0]}: {ratio[name]:.2f} of the peer's,"
        f" at most {LARGEST_TIME_RATIO}"
        for name in ("ms_median", "ms_p95")
        if not ratio[name] <= LARGEST_TIME_RATIO
    ]


def print_table(name: str, runs: Runs, ratio: dict[str, float]) -> None:
    """Print median [smallest to largest] of both and the ratio of the medians."""
    frames = int(runs["ours"][0]["frames"])
    threads = {who: int(several[0]["cv_threads"]) for who, several in runs.items()}
    print(f"\n{name}: {frames} frames, {len(runs['ours'])} runs, times without the first {SKIPPED}")
    print(f"OpenCV threads: {threads['ours']} in odomap; {threads['peer']} in the peer's reader,")
    print("its own OpenCV inside and its three threads are as it was built")
    print(f"{'':22}{'odomap':>26}{'ORB-SLAM3':>26}{'ratio':>8}")
    for key, (label, form) in SHOWN.items():
        values = [[run[key] for run in runs[who] if key in run] for who in ("ours", "peer")]
        cells = [f"{_spread(several, form) if several else '':>26}" for several in values]
        print(f"{label:22}{cells[0]}{cells[1]}{f'{ratio[key]:.2f}' if key in ratio else '':>8}")
    print(flush=True)


def _spread(values: list[float], form: str) -> str:
    low, high = f"{min(values):{form}}", f"{max(values):{form}}"
    middle = f"{np.median(values):{form}}"
    return middle if low == high else f"{middle} [{low} to {high}]"


def _line(numbers: dict[str, float]) -> str:
    shown = ((key, label, form) for key, (label, form) in SHOWN.items() if key in numbers)
    return ", ".join(f"{label} {numbers[key]:{form}}" for key, label, form in shown)


if __name__ == "__main__":
    sys.exit(main())
