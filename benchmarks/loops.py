"""Loops: are they found, are they true, and what do they make of the path?

    python benchmarks/loops.py [--part system closer circuits corridor live same] [--seeds 5]
                               [--recordings ...] [--worlds street building building:rgbd]
                               [--data DIR] [--peer-python P --peer-script S] [--cache DIR]

    system    the recordings there and back (even frames forth, odd ones back): how far the last
              pose is off as seen from the first, ours and ORB-SLAM3's in the same run. Bar: at most
              the peer's. A single camera's is judged in the scale of its whole path.
    closer    the same with keyframes older than 20 frames hidden from tracker and mapper: what
              comes of the way there is up to the closer. Bars: a loop is found, the end is 5
              times nearer than without or within 1 cm, no loop is false.
    circuits  a simulated street and building, gone round once and a bit more, of several seeds.
              Bars: the way back is tied to the beginning, ATE under 0.3 % of the path, the mean
              normalised error squared of keyframes per degree of freedom between 0.5 and 2 over all
              worlds of a kind, no loop false.
    corridor  one of identical doors. Bars: no loop is false, and the path as right as elsewhere.
    live      closures in a map of 3,000 keyframes: what they take between frames, and for how long
              they stop the tracker's thread. Bar: 15 ms, by the smallest of --repeats.
    same      a circuit played twice in lockstep. Bars: a loop is closed; the same bytes.

A loop is false if what was measured is off by more than 0.3 m and 5 % of what lies between, or 10°.
Exit code 1 where a bar is missed. What was refused is listed by --verbose, all numbers by --json.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import loops_live
import numpy as np
import peer
from bars import Bench
from consistency import simulation_hash
from loopcases import HEADER, HIDDEN, Case, Forgetful, cells, closing, end_error, play
from rounds import Rendered

from odomap.errors import OdomapError
from odomap.evaluation.metrics import ate
from odomap.files.trajectories import read_tum
from odomap.geometry.trajectory import Trajectory
from odomap.simulation.world import World
from odomap.sources.disturb import there_and_back
from odomap.sources.open import open as open_source
from odomap.system.config import preset

LAYOUTS = {
    "euroc_mh01": ("euroc", "stereo"),
    "kitti_stereo": ("kitti", "stereo"),
    "kitti_mono": ("kitti", "mono"),
    "rgbd_desk": ("tum", "rgbd"),
}
PARTS = ("system", "closer", "circuits", "corridor", "live", "same")
WORLDS = ("street", "building", "building:rgbd")
FIVEFOLD, CENTIMETRE = 5.0, 0.01
LARGEST_PERCENT, NEES_RANGE = 0.3, (0.5, 2.0)
ONCE_AND_MORE = 1.08
CALIBRATED_PX = 0.06
"""How well the rigs of the worlds are calibrated, standard deviation: they are off by 0.1 at most.
A covariance can only be right if what it starts from is; by default a real rig is assumed."""
SMALL: dict[str, dict[str, object]] = {
    "street": {"resolution": (480, 184), "rate_hz": 8.0},
    "building": {"resolution": (400, 250), "rate_hz": 8.0},
    "corridor": {"resolution": (320, 200), "rate_hz": 5.0},
}
"""Images are small and few, so that rendering does not take an hour."""


class LoopBench(Bench):
    """What was measured of loops, and which bars were missed."""

    def note(self, part: str, case: Case) -> None:
        """Print a case and keep its numbers."""
        print(cells(case), flush=True)
        if self.options.verbose:
            print("\n".join(f"      {reason}" for reason in case.said), flush=True)
        self.numbers[f"{part}: {case.name}"] = asdict(case)
        self.need(not case.false, f"{part}: {case.name}: {case.false} false loops")
        self.save()


def main() -> int:
    options = _options()
    cv2.setNumThreads(1)
    bench = LoopBench(options)
    parts: dict[str, Callable[[LoopBench], None]] = {
        "system": system,
        "closer": closer,
        "circuits": circuits,
        "corridor": corridor,
        "live": live,
        "same": same,
    }
    for part in options.part:
        print(f"\n{part}\n{HEADER}" if part != "live" else f"\n{part}", flush=True)
        parts[part](bench)
    for line in bench.missed:
        print(f"bar missed: {line}")
    bench.save()
    return 1 if bench.missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    peer.add_options(parser)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--recordings", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=3, help="of what is timed")
    parser.add_argument("--no-peer", action="store_true", help="do not compare with ORB-SLAM3")
    parser.add_argument("--full", action="store_true", help="worlds as large and fast as ever")
    parser.add_argument("--cache", type=Path, help="keep rendered worlds here")
    parser.add_argument("--verbose", action="store_true", help="say why candidates are refused")
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    names = ["data"] * bool({"system", "closer"} & set(options.part))
    names += ["peer_python", "peer_script"] * ("system" in options.part and not options.no_peer)
    peer.require(parser, options, tuple(names))
    return options


# ---- recordings, there and back ----


def system(bench: LoopBench) -> None:
    """Play all that SLAM has to the recordings, and the peer beside it."""
    options = bench.options
    with tempfile.TemporaryDirectory(prefix="odomap-loops-") as scratch:
        folder = Path(scratch)
        words = None if options.no_peer else peer.unpacked(options.vocabulary, folder)
        for name in options.recordings:
            source = there_and_back(open_source(Path(options.data) / name))
            assert source.truth is not None
            config = closing(preset(LAYOUTS[name][1]))
            case, result = play(name, source, source.rig, source.truth, config)
            bench.note("system", case)
            if words is None:
                continue
            data = Path(options.data) / name
            extra = ("--there-and-back",)
            played = peer.run(options, words, LAYOUTS[name], data, folder / name, extra=extra)
            path, true = read_tum(played.path), result.truth(source.truth)
            end = peer_end(path, true, result.is_metric)
            print(f"{'  ORB-SLAM3':62}{end[0]:9.4f}{end[1]:7.3f}", flush=True)
            bench.numbers[f"system: {name}: peer"] = {"end_m": end[0], "end_deg": end[1]}
            sentence = (
                f"system: {name}: the end is {case.end_m:.4f} m off, ORB-SLAM3's {end[0]:.4f}"
            )
            bench.need(case.end_m <= end[0], sentence)


def peer_end(path: Trajectory, truth: Trajectory, is_metric: bool) -> tuple[float, float]:
    """Return how far the peer's last pose is off, infinitely where it has no path to speak of."""
    try:
        scale = 1.0 if is_metric else ate(path, truth, "sim3").scale
        return end_error(path, truth, scale)
    except OdomapError as why:
        print(f"  ORB-SLAM3: no error can be computed: {why}")
        return np.inf, np.inf


def closer(bench: LoopBench) -> None:
    """Play the recordings to SLAM that forgets, without a closer and with one."""
    options = bench.options
    for name in options.recordings:
        source = there_and_back(open_source(Path(options.data) / name))
        assert source.truth is not None
        ends, memory_ns = [], HIDDEN * int(np.median(np.diff(source.stamps_ns)))
        for is_enabled in (False, True):
            config = closing(preset(LAYOUTS[name][1]), is_enabled)
            label = f"{name}, {'loops closed' if is_enabled else 'as it drifts'}"
            case, _ = play(
                label, source, source.rig, source.truth, config, map=Forgetful(memory_ns)
            )
            bench.note("closer", case)
            ends.append(case.end_m)
        sentence = f"closer: {name}: the end is {ends[1]:.4f} m off, {ends[0]:.4f} without"
        bench.need(ends[1] <= max(ends[0] / FIVEFOLD, CENTIMETRE), sentence)
        bench.need(case.loops > 0, f"closer: {name}: no loop was found")


# ---- worlds ----


def rendered(bench: LoopBench, kind: str, seed: int, folder: Path) -> tuple[World, Rendered]:
    """Return a world gone round once and a bit more, and its frames, rendered or kept."""
    fields = {"kind": kind, "seed": seed, "sensors": ("stereo", "depth")}
    fields |= {} if bench.options.full else SMALL[kind]
    once = World.make(**fields, frames=1)
    each = once.spec.rate_hz / once.path.rounds_per_s
    world = World.make(**fields, frames=int(ONCE_AND_MORE * each))
    size = "full" if bench.options.full else "small"
    kept = (bench.options.cache or folder) / f"{kind}-{seed}-{size}-{simulation_hash()}"
    if (kept / "stamps.npy").exists():
        return world, Rendered(kept)
    part = kept.with_name(kept.name + ".part")
    part.mkdir(parents=True, exist_ok=True)
    Rendered.of(world, part)
    part.rename(kept)
    return world, Rendered(kept)


def round_and_round(
    bench: LoopBench, part: str, kind: str, seed: int, name: str = "stereo"
) -> Case:
    """Play a world to SLAM and judge it."""
    with tempfile.TemporaryDirectory(prefix="odomap-loops-") as folder:
        world, frames = rendered(bench, kind, seed, Path(folder))
        rig, label = world.rig.without_imu(), f"{kind} {seed}, {name}"
        config = closing(preset(name))
        config = replace(config, noise=replace(config.noise, calibration_px=CALIBRATED_PX))
        case, _ = play(label, frames, rig, world.truth, config)
    bench.note(part, case)
    return case


def circuits(bench: LoopBench) -> None:
    """Go round streets and buildings."""
    options = bench.options
    for world in options.worlds:
        kind, _, sensors = world.partition(":")
        cases = []
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            cases.append(
                case := round_and_round(bench, "circuits", kind, seed, sensors or "stereo")
            )
            bench.need(case.reused > 0, f"circuits: {case.name}: nothing ties the end to the start")
            bench.need(
                case.percent < LARGEST_PERCENT,
                f"circuits: {case.name}: ATE {case.percent:.3f} %, under {LARGEST_PERCENT} %",
            )
            bench.need(not case.lost, f"circuits: {case.name}: {case.lost} frames lost")
        mean = float(np.mean([case.nees for case in cases]))
        print(f"{world}: NEES per degree of freedom {mean:.2f}")
        low, high = NEES_RANGE
        sentence = f"circuits: {world}: NEES per degree of freedom {mean:.2f}, {low} to {high}"
        bench.need(low <= mean <= high, sentence)


def corridor(bench: LoopBench) -> None:
    """Walk along identical doors."""
    options = bench.options
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        case = round_and_round(bench, "corridor", "corridor", seed)
        sentence = f"corridor: {case.name}: the path is off by {case.percent:.1f} % of its length"
        bench.need(case.percent < LARGEST_PERCENT, sentence)


def same(bench: LoopBench) -> None:
    """Play a circuit twice, and compare what is left."""
    left = []
    for _ in range(2):
        with tempfile.TemporaryDirectory(prefix="odomap-loops-") as folder:
            world, frames = rendered(bench, "building", bench.options.first_seed, Path(folder))
            parts = frames, world.rig.without_imu(), world.truth, closing(preset("stereo"))
            case, result = play("building", *parts)
        bench.note("same", case)
        tables = result.map.dump()
        left.append(b"".join(tables.columns[name].tobytes() for name in sorted(tables.columns)))
    bench.need(case.loops > 0, "same: no loop was closed")
    bench.need(left[0] == left[1], "same: two runs in lockstep differ")


def live(bench: LoopBench) -> None:
    """Close loops in a large map, and look at what it costs tracking."""
    stalls = loops_live.measured(bench.options.repeats)
    loops_live.show(stalls)
    bench.numbers["live"] = asdict(stalls)
    bench.missed += [f"live: {line}" for line in loops_live.below_bars(stalls)]


if __name__ == "__main__":
    sys.exit(main())
