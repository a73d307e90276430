"""3D LiDARs: odometry beside KISS-ICP's, loops, deskewing, covariances, labels and memory.

    python benchmarks/lidar3d.py [--part kitti drift back deskew circuits labels memory]
                                 [--data DIR] [--peer-python P] [--seeds 5] [--rounds 10]
                                 [--front-ends points loam lego] [--patterns rotating:16 ...]

    kitti     KITTI's raw sweeps: ATE and mean error over 10 m, and ms of a sweep, ours on one
              thread, KISS-ICP on its own (voxels of 1 m, 100 m), the median of --repeats; beside
              it processor time, which other programs change less. Bars: `points` at most KISS-ICP's
              errors, `loam` and `lego` 1.5 times as much; a third of its time for the same, with
              motion taken out or not.
    drift     a street gone round once and a bit more, 64 beams, of several seeds, loops not closed:
              error of rotation per metre and drift over segments of 100 m. Bar: mean rotation of
              `points` at most KISS-ICP's.
    back      KITTI's sweeps there and back (even ones forth, odd ones back), odometry knowing the
              last three sweeps alone: how far the end is from the way there, at the same instant of
              the recording, and from where GPS says, which is good to 5 cm itself. Bars: a loop is
              closed, the end is 5 times nearer to the way there than without or within 5 cm.
    deskew    how thick planes of the map are, with and without deskewing, in KITTI's sweeps and in
              streets: all, and those across the way; and the motion over a sweep. A plane is what
              each sweep alone shows to be one. Bars: thinner; in streets, whose truth is exact,
              motion within 0.5 %.
    circuits  streets gone round once and a bit more, of several seeds. Bars: ATE 0.3 % of the path,
              a loop closed in each, no sweep lost, the mean normalised error squared per degree of
              freedom from 0.5 to 2 over the seeds.
    labels    edges, planes and ground of `loam` and `lego` in streets. Bar: 95 % are right.
    memory    what is held after each of --rounds of one street: keyframes, edges, the file, memory
              of the process beyond what it held before, and the most it held at all. Bar: at the
              end at most 1.3 times as much as after two.

Of every figure it is said whether the motion over a sweep was taken out. Bars are the better of
KISS-ICP's two ways, figure by figure; where the truth is exact its poses are held against it at
that moment of the sweep that suits them best. Exit code 1 where a bar is missed, 2 where something
needed is.
"""

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lidar3d_runs as runs
import numpy as np
import peer
from bars import Bench
from laser2d import tell_growth
from laser2d_runs import rounds_of
from lidar3d_labels import labelled
from lidar3d_odometry import Found, Way, followed

from odomap.run import chosen_config
from odomap.simulation.sweepspec import SweepSpec
from odomap.sources.open import open as open_source

PARTS = ("kitti", "drift", "back", "deskew", "circuits", "labels", "memory")
RECORDED, BESIDE = ("kitti", "back", "deskew"), ("kitti", "drift")
FRONT_ENDS = ("points", "loam", "lego")
PATTERNS = ("rotating:16", "rotating:64", "solid_state:16")
KISS = Way("KISS-ICP", False), Way("KISS-ICP", True)
STREET = "sim:street?sensors=lidar3d&seed={}&beams={}&pattern={}"
LARGEST = {"points": 1.0, "loam": 1.5, "lego": 1.5}
LARGEST_TIME, FIVEFOLD, NEAR_M = 1 / 3, 5.0, 0.05
LARGEST_PERCENT, NEES_RANGE, LARGEST_OFF = 0.3, (0.5, 2.0), 0.5
LEAST_RIGHT = 0.95
GROWING = ("keyframes", "edges", "file_mb", "memory_mb", "peak_mb")
WITHOUT_THINNING = (("cloud_thinning.enabled", "false"),)
DRIVEN = 200
"""Sweeps of a street in which deskewing is looked at."""
EVERY = 40
"""Of the sweeps of a street, those whose labels are looked at."""


def main() -> int:
    options = _options()
    bench = Bench(options)
    parts: dict[str, Callable[[Bench], None]] = {
        "kitti": kitti,
        "drift": drift,
        "back": back,
        "deskew": deskew,
        "circuits": circuits,
        "labels": labels,
        "memory": memory,
    }
    return bench.measure(parts)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    env = os.environ.get
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--data", default=env("ODOMAP_DATA"), help="has kitti_velodyne/")
    parser.add_argument("--peer-python", default=env("ODOMAP_KISS_PYTHON"), help="has kiss_icp")
    parser.add_argument("--front-ends", nargs="+", choices=FRONT_ENDS, default=list(FRONT_ENDS))
    parser.add_argument("--seeds", type=int, default=5, help="of streets")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--patterns", nargs="+", default=list(PATTERNS), help="pattern:beams")
    parser.add_argument("--rounds", type=int, default=10, help="of the street for memory")
    parser.add_argument("--keep-all", action="store_true", help="let no keyframe go, for memory")
    parser.add_argument("--repeats", type=int, default=3, help="of what is timed")
    parser.add_argument("--json", type=Path, help="write all numbers here")
    options = parser.parse_args()
    if set(options.part) & set(RECORDED):
        peer.require(parser, options, ("data",))
    if set(options.part) & set(BESIDE) and not Path(options.peer_python or "").is_file():
        peer.refuse(parser, "--peer-python (or ODOMAP_KISS_PYTHON): a Python that has kiss_icp")
    if options.rounds < 2:
        peer.refuse(parser, "--rounds: at least 2, since the second is compared with")
    return options


def seeds(bench: Bench) -> range:
    """Return the seeds of the streets."""
    first = bench.options.first_seed
    return range(first, first + bench.options.seeds)


def ways(bench: Bench) -> list[Way]:
    """Return the ways to do odometry that are compared."""
    ours = [Way(name, True) for name in bench.options.front_ends]
    return [*KISS, *ours, Way("points", False)]


def kitti(bench: Bench) -> None:
    """Follow a real drive, again and again."""
    source = open_source(Path(bench.options.data) / "kitti_velodyne")
    told: dict[Way, list[Found]] = {way: [] for way in ways(bench)}
    for _ in range(max(bench.options.repeats, 1)):
        for way, found in followed(
            source, list(told), bench.options.peer_python, is_recorded=True
        ).items():
            told[way].append(found)
    head = f"{'':32}{'ATE m':>8}{'10 m: m':>9}{'deg':>8}{'lost':>6}{'ms':>8}{'95 %':>8}{'CPU':>8}"
    print(f"{head}{'KISS-ICP = 1':>14}")
    middle = {way: over(found, np.median) for way, found in told.items()}
    for way, f in middle.items():
        print(
            f"{way!s:32}{f.ate_m:8.4f}{f.per10_m:9.4f}{f.per10_deg:8.4f}{f.lost:6.0f}{f.ms:8.1f}"
            f"{f.ms_p95:8.1f}{f.cpu_ms:8.1f}{f.ms / middle[alike(way)].ms:14.2f}",
            flush=True,
        )
    bench.numbers["kitti"] = {str(w): [asdict(f) for f in found] for w, found in told.items()}
    best = over([middle[way] for way in KISS], np.min)
    for way, found in middle.items():
        if way.is_ours:
            below_kiss(bench, way, found, replace(best, ms=middle[alike(way)].ms))


def alike(way: Way) -> Way:
    """Return what KISS-ICP does to sweeps as a way of ours does, which takes it time, too."""
    return replace(way, who="KISS-ICP")


def below_kiss(bench: Bench, way: Way, found: Found, best: Found) -> None:
    """Hold a front-end against KISS-ICP on KITTI's sweeps: errors against its least."""
    who = way.who
    for name, unit in (("ate_m", "m of ATE"), ("per10_m", "m over 10 m")):
        ours, theirs = getattr(found, name), getattr(best, name)
        sentence = f"kitti: {who}: {ours:.4f} {unit}, KISS-ICP {theirs:.4f}"
        bench.need(ours <= LARGEST[who] * theirs, sentence)
    bench.need(found.lost == 0, f"kitti: {who}: {found.lost} sweeps lost")
    ratio = found.ms / best.ms
    bench.need(ratio <= LARGEST_TIME, f"kitti: {way}: {ratio:.2f} of KISS-ICP's time, at most 1/3")


def over(found: list[Found], of: Callable[..., Any]) -> Found:
    """Return the median, the mean, or the least of every figure."""
    return Found(*of([list(asdict(f).values()) for f in found], axis=0).tolist())


def drift(bench: Bench) -> None:
    """Follow streets without closing loops."""
    told: dict[Way, list[Found]] = {way: [] for way in ways(bench)}
    print(f"seed  {'':32}{'deg/100 m':>10}{'%':>8}{'ATE m':>8}{'lost':>6}{'ms':>8}")
    for seed in seeds(bench):
        source = open_source(STREET.format(seed, 64, "rotating"))
        for way, f in followed(source, list(told), bench.options.peer_python).items():
            told[way].append(f)
            _print_drift(f"{seed:4}  ", way, f)
    mean = {way: over(found, np.mean) for way, found in told.items()}
    for way, f in mean.items():
        _print_drift("mean  ", way, f)
    bench.numbers["drift"] = {str(w): [asdict(f) for f in found] for w, found in told.items()}
    ours, theirs = mean[Way("points", True)], over([mean[way] for way in KISS], np.min)
    sentence = (
        f"drift: {100 * ours.deg_per_m:.4f}° over 100 m, KISS-ICP {100 * theirs.deg_per_m:.4f}"
    )
    bench.need(ours.deg_per_m <= theirs.deg_per_m, sentence)


def _print_drift(first: str, way: Way, f: Found) -> None:
    print(
        f"{first}{way!s:32}{100 * f.deg_per_m:10.4f}{f.percent:8.4f}{f.ate_m:8.3f}{f.lost:6.0f}"
        f"{f.ms:8.1f}",
        flush=True,
    )


def back(bench: Bench) -> None:
    """Come back along a real drive."""
    source = open_source(Path(bench.options.data) / "kitti_velodyne")
    numbers: dict[str, runs.Back] = {}
    print("motion-compensated           cm from the way there      by GPS, cm")
    print("        loops  refused  lost       end   without          end   without loops")
    for name in bench.options.front_ends:
        got = numbers[name] = runs.back(source, name)
        print(
            f"{name:8}{got.loops:5}{got.refused:9}{got.lost:6}{100 * got.apart_m:10.1f}"
            f"{100 * got.odometry_apart_m:10.1f}{100 * got.end_m:13.1f}"
            f"{100 * got.odometry_end_m:10.1f}",
            flush=True,
        )
        bench.need(got.loops > 0, f"back: {name}: no loop was closed")
        bench.need(got.lost == 0, f"back: {name}: {got.lost} sweeps lost")
        is_near = got.apart_m <= max(NEAR_M, got.odometry_apart_m / FIVEFOLD)
        bench.need(is_near, f"back: {name}: {100 * got.apart_m:.1f} cm from where it began")
    bench.numbers["back"] = {name: asdict(got) for name, got in numbers.items()}


def deskew(bench: Bench) -> None:
    """Map with and without deskewing."""
    names: dict[str, Any] = {"kitti": Path(bench.options.data) / "kitti_velodyne"}
    for seed in seeds(bench):
        names[f"street {seed}"] = STREET.format(seed, 64, "rotating") + f"&frames={DRIVEN}&speed=12"
    numbers = {}
    print("planes, mm          all   without    across   without  motion %  length %")
    for name, data in names.items():
        got = runs.deskewed(data)
        print(
            f"{name:12}{got.with_mm:11.1f}{got.without_mm:10.1f}{got.across_with_mm:10.1f}"
            f"{got.across_without_mm:10.1f}{got.motion_percent:10.3f}{got.length_percent:10.3f}",
            flush=True,
        )
        numbers[name] = asdict(got)
        for kind, thick, without in (
            ("planes", got.with_mm, got.without_mm),
            ("planes across the way", got.across_with_mm, got.across_without_mm),
        ):
            sentence = f"deskew: {name}: {kind} {thick:.1f} mm thick, {without:.1f} without"
            bench.need(thick < without, sentence)
        if name != "kitti":  # whose truth is GPS
            sentence = (
                f"deskew: {name}: motion {got.motion_percent:.3f} % off, at most {LARGEST_OFF}"
            )
            bench.need(got.motion_percent <= LARGEST_OFF, sentence)
    bench.numbers["deskew"] = numbers


def circuits(bench: Bench) -> None:
    """Go round streets."""
    numbers: dict[str, Any] = {}
    for front_end in bench.options.front_ends[:1]:
        for pattern in bench.options.patterns:
            numbers[f"{front_end} {pattern}"] = _circuits(bench, front_end, pattern)
    bench.numbers["circuits"] = numbers


def _circuits(bench: Bench, front_end: str, pattern: str) -> dict[str, Any]:
    """Go round streets of one pattern."""
    kind, beams = pattern.split(":")
    found = {}
    print(f"{front_end}, {pattern}, motion-compensated")
    print("seed   path m   ATE %  (live)    NEES  keyframes  loops  refused  lost      ms    95 %")
    for seed in seeds(bench):
        got = found[seed] = runs.circuit(STREET.format(seed, beams, kind), front_end)
        print(
            f"{seed:4}{got.path_m:9.1f}{got.percent:8.4f}{got.live_percent:8.4f}{got.nees:8.2f}"
            f"{got.keyframes:11}{got.loops:7}{got.refused:9}{got.lost:6}{got.ms:8.1f}"
            f"{got.ms_p95:8.1f}",
            *(f"\n      {line}" for line in got.said),
            flush=True,
        )
        name = f"circuits: {pattern}, seed {seed}"
        sentence = f"{name}: ATE {got.percent:.3f} %, at most {LARGEST_PERCENT}"
        bench.need(got.percent <= LARGEST_PERCENT, sentence)
        bench.need(got.loops > 0, f"{name}: no loop was closed")
        bench.need(got.lost == 0, f"{name}: {got.lost} sweeps lost")
    percent, nees = (
        float(np.mean([getattr(c, n) for c in found.values()])) for n in ("percent", "nees")
    )
    print(f"mean{'':9}{percent:8.4f}{'':8}{nees:8.2f}", flush=True)
    low, high = NEES_RANGE
    bench.need(low <= nees <= high, f"circuits: {pattern}: NEES {nees:.2f}, from {low} to {high}")
    return {str(seed): asdict(got) for seed, got in found.items()}


def labels(bench: Bench) -> None:
    """Look at edges, planes and ground."""
    numbers = {}
    print("                              edges  planes  ground  of it found     edges    planes")
    for name in [name for name in bench.options.front_ends if name != "points"]:
        for pattern in bench.options.patterns:
            kind, beams = pattern.split(":")
            for seed in seeds(bench):
                spec = SweepSpec(seed=seed, frames=4 * EVERY, beams=int(beams), pattern=kind)
                got = labelled(name, spec, list(range(EVERY // 2, 4 * EVERY, EVERY)))
                about = f"{name}, {pattern}, seed {seed}"
                print(
                    f"{about:28}{got.edges:7.1%}{got.planes:8.1%}{_share(got.ground):>8}"
                    f"{_share(got.ground_found):>13}{got.num_edges:10}{got.num_planes:10}",
                    flush=True,
                )
                numbers[about] = asdict(got)
                for what in ("edges", "planes", "ground"):
                    share = getattr(got, what)
                    sentence = f"labels: {about}: {share:.1%} of the {what} right"
                    bench.need(np.isnan(share) or share >= LEAST_RIGHT, sentence)
    bench.numbers["labels"] = numbers


def _share(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.1%}"


def memory(bench: Bench) -> None:
    """Go round one street again and again."""
    options = bench.options
    world = STREET.format(options.first_seed, 16, "rotating")
    config = chosen_config("lidar", overrides=WITHOUT_THINNING if options.keep_all else ())
    tell_growth(bench, rounds_of(world, options.rounds, config, runs.nees), GROWING)


if __name__ == "__main__":
    sys.exit(main())
