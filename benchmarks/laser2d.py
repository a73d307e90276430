"""2D lasers: SLAM with them on real recordings and in simulated buildings, and scans as a grid.

    python benchmarks/laser2d.py [--part rays intel csail loop5 buildings speed memory]
                                 [--data DIR] [--seeds 5] [--rounds 10] [--out DIR] [--repeats 3]

    rays       1,000 scans of 360 beams, driven through a simulated building, laid into a grid of
               5 cm cells at their true poses: from ranges to cells, growth included. Beside it rays
               alone, and cells passed per second. Bar: under 1 s, by the smallest of --repeats.
    intel      all relations that people checked by hand: mean error of translation and rotation;
               beside it the wheels alone, and the same without loops. Bars: 0.0229 m and 0.453°,
               Cartographer's published figures.
    csail      how single walls are (`doublewalls`), beside the same without loops. Bars: loops are
               closed, and no more walls stand twice than without. The rest is to be looked at:
               --out keeps the grids and reports of both runs.
    loop5      likewise.
    buildings  of several seeds: ATE, normalised error squared in the plane, and the grid against
               the true plan, laid on it with the path. Bars: 0.3 % of the path, on the mean; 95 %
               of the wall cells within one cell.
    speed      Intel and CSAIL in a new process with compiled kernels, reading and all outputs
               included: the time they were recorded in over that. Bar: 40 times, the median of
               --repeats.
    memory     what is held after each of --rounds of one building: keyframes, submaps, edges, the
               file, memory of the process beyond what it held before, and the most it held at all.
               Bar: at the end at most 1.3 times as much as after two, of all of them.

Exit code 1 where a bar is missed, 2 where recordings are.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import laser2d_runs as runs
import numpy as np
import peer
from bars import Bench

from odomap.lidar.grid import OccupancyGrid
from odomap.lidar.scans import Beams
from odomap.run import chosen_config
from odomap.simulation.laserworld import LaserSpec, LaserWorld

RECORDED = ("intel", "csail", "loop5", "speed")
PARTS = ("rays", "intel", "csail", "loop5", "buildings", "speed", "memory")
FILES = {"intel": "intel.clf.bz2", "csail": "mit-csail.clf.bz2", "loop5": "loop5.log"}
SCANS, BEAMS, LONGEST_S = 1000, 360, 1.0
LARGEST_M, LARGEST_DEG = 0.0229, 0.453
LARGEST_PERCENT, LEAST_TRUE = 0.3, 0.95
LEAST_FACTOR, LARGEST_GROWTH = 40.0, 1.3
GROWING = ("keyframes", "submaps", "edges", "file_mb", "memory_mb", "peak_mb")
WITHOUT_THINNING = (("scan_thinning.enabled", "false"),)
BUILDING = "sim:building?sensors=laser&seed={}"


def main() -> int:
    options = _options()
    bench = Bench(options)
    parts: dict[str, Callable[[Bench], None]] = {
        "rays": rays,
        "intel": intel,
        "csail": lambda bench: walls(bench, "csail"),
        "loop5": lambda bench: walls(bench, "loop5"),
        "buildings": buildings,
        "speed": speed,
        "memory": memory,
    }
    return bench.measure(parts)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--data", default=os.environ.get("ODOMAP_DATA"), help="has laser2d/")
    parser.add_argument("--seeds", type=int, default=5, help="buildings")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=10, help="of the building for memory")
    parser.add_argument("--keep-all", action="store_true", help="let no submap go, for memory")
    parser.add_argument("--out", type=Path, help="keep grids and reports of the runs here")
    parser.add_argument("--repeats", type=int, default=3, help="of what is timed")
    parser.add_argument("--json", type=Path, help="write all numbers here")
    options = parser.parse_args()
    if set(options.part) & set(RECORDED):
        peer.require(parser, options, ("data",))
    if options.rounds < 2:
        parser.exit(2, f"{parser.prog}: --rounds: at least 2, since the second is compared with\n")
    return options


def rays(bench: Bench) -> None:
    """Lay scans into a grid."""
    spec = LaserSpec("building", 0, frames=SCANS, beams=BEAMS, fov_deg=359.0)
    world = LaserWorld(spec)
    scans = [world.frame(index).scan for index in range(SCANS)]
    beams, Ts = Beams(world.rig.lidars[0]), world.truth.Ts_world_body
    wholes, alone = [], []
    grid = _laid(beams, scans[:2], Ts)[0]  # compiled
    for _ in range(max(bench.options.repeats, 1)):
        start = time.process_time()
        grid, seconds = _laid(beams, scans, Ts)
        wholes.append(time.process_time() - start)
        alone.append(seconds)
    passed = _cells_passed(beams, scans, Ts, grid.resolution)
    known, (rows, columns) = int(grid.is_known.sum()), grid.log_odds.shape
    whole, fastest = min(wholes), min(alone)
    print(f"scans            {SCANS} of {BEAMS} beams, cells of {grid.resolution:g} m")
    print(f"grid             {columns} x {rows} cells, {known} known")
    print(f"on the rays      {passed / 1e6:.1f} million cells, {passed / SCANS:.0f} per scan")
    print(f"rays alone       {fastest:.3f} s, {1e9 * fastest / passed:.2f} ns per cell")
    print(f"from the ranges  {whole:.3f} s (bar {LONGEST_S:g} s)", flush=True)
    bench.numbers["rays"] = {
        "scans": SCANS,
        "beams": BEAMS,
        "known_cells": known,
        "cells_on_rays": passed,
        "rays_s": fastest,
        "whole_s": whole,
    }
    bench.need(whole < LONGEST_S, f"rays: {whole:.2f} s for {SCANS} scans of {BEAMS} beams")


def _laid(beams: Beams, scans: list[np.ndarray], Ts: np.ndarray) -> tuple[OccupancyGrid, float]:
    """Return a grid of scans, and the seconds that inserting took."""
    grid, seconds = OccupancyGrid(), 0.0
    for ranges, T in zip(scans, Ts):
        seen = beams.points(ranges)
        R, t = T[:2, :2].T, T[:2, 3]
        origin, hits, between = seen.origin @ R + t, seen.hits @ R + t, seen.between @ R + t
        start = time.process_time()
        grid.insert(origin, hits, between=between)
        seconds += time.process_time() - start
    return grid, seconds


def _cells_passed(beams: Beams, scans: list[np.ndarray], Ts: np.ndarray, cell_m: float) -> int:
    """Return how many cells all rays go through, each counted as often as it is passed."""
    total = 0
    for ranges, T in zip(scans, Ts):
        seen = beams.points(ranges)
        R, t = T[:2, :2].T, T[:2, 3]
        first, last = (np.floor((p @ R + t) / cell_m) for p in (seen.origin, seen.hits))
        total += int(np.abs(last - first).sum()) + len(last)
    return total


def intel(bench: Bench) -> None:
    """Hold a real path against relations checked by hand."""
    folder = Path(bench.options.data) / "laser2d"
    got = runs.related(folder / FILES["intel"], folder / "intel.relations", bench.options.out)
    print(f"{got.relations} relations, {got.loops} loops, {got.refused} refused, {got.lost} lost")
    print(f"odomap         {got.trans_m:8.4f} m {got.rot_deg:7.3f}°")
    print(f"without loops  {got.without_loops_m:8.4f} m {got.without_loops_deg:7.3f}°")
    print(f"wheels alone   {got.odometry_m:8.4f} m {got.odometry_deg:7.3f}°", flush=True)
    bench.numbers["intel"] = asdict(got)
    bench.need(got.trans_m <= LARGEST_M, f"intel: {got.trans_m:.4f} m, at most {LARGEST_M}")
    bench.need(got.rot_deg <= LARGEST_DEG, f"intel: {got.rot_deg:.3f}°, at most {LARGEST_DEG}")
    bench.need(got.lost == 0, f"intel: {got.lost} scans lost")


def walls(bench: Bench, name: str) -> None:
    """Look how single the walls of a real grid are."""
    got = runs.drawn(Path(bench.options.data) / "laser2d" / FILES[name], bench.options.out)
    print(f"{got.loops} loops, {got.refused} refused, {got.lost} lost; moved {got.moved_m:.2f} m")
    print("               walls that stand twice   beams that end in the open")
    print(f"odomap         {got.doubled:20.2%} {got.open:28.2%}")
    print(f"without loops  {got.doubled_without:20.2%} {got.open_without:28.2%}", flush=True)
    bench.numbers[name] = asdict(got)
    bench.need(got.loops > 0, f"{name}: no loop was closed")
    bench.need(got.lost == 0, f"{name}: {got.lost} scans lost")
    sentence = f"{name}: {got.doubled:.2%} of the walls stand twice, {got.doubled_without:.2%} "
    bench.need(got.doubled <= got.doubled_without, sentence + "without loops")


def buildings(bench: Bench) -> None:
    """Hold paths and grids against the truth."""
    options, found = bench.options, {}
    print("seed    ATE %    NEES  walls true  (as is)   found  keyframes  loops  lost")
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        out = None if options.out is None else options.out / f"building-{seed}"
        got = found[seed] = runs.built(BUILDING.format(seed), out)
        print(
            f"{seed:4}{got.percent:9.4f}{got.nees:8.2f}{got.true:12.2%}{got.true_as_is:9.2%}"
            f"{got.found:8.2%}{got.keyframes:11}{got.loops:7}{got.lost:6}",
            flush=True,
        )
        bench.need(got.true >= LEAST_TRUE, f"building {seed}: {got.true:.1%} of the walls true")
        bench.need(got.lost == 0, f"building {seed}: {got.lost} scans lost")
    mean, nees = (
        float(np.mean([getattr(b, n) for b in found.values()])) for n in ("percent", "nees")
    )
    print(f"mean{mean:9.4f}{nees:8.2f}")
    bench.numbers["buildings"] = {str(seed): asdict(got) for seed, got in found.items()}
    bench.need(mean <= LARGEST_PERCENT, f"buildings: ATE {mean:.3f} %, at most {LARGEST_PERCENT}")


def speed(bench: Bench) -> None:
    """Time whole processes."""
    numbers: dict[str, list[float]] = {}
    for name in ("intel", "csail"):
        file = Path(bench.options.data) / "laser2d" / FILES[name]
        runs.factor_of_real_time(file)  # compiled
        factors = [runs.factor_of_real_time(file) for _ in range(max(bench.options.repeats, 1))]
        median = float(np.median(factors))
        all_of_them = ", ".join(f"{factor:.1f}" for factor in factors)
        print(f"{name:8}{median:8.1f} times real time ({all_of_them})", flush=True)
        numbers[name] = factors
        sentence = f"speed: {name}: {median:.1f} times real time, at least {LEAST_FACTOR:g}"
        bench.need(median >= LEAST_FACTOR, sentence)
    bench.numbers["speed"] = numbers


def memory(bench: Bench) -> None:
    """Go round one building again and again."""
    options = bench.options
    config = chosen_config("lidar2d", overrides=WITHOUT_THINNING if options.keep_all else ())
    held = runs.rounds_of(BUILDING.format(options.first_seed), options.rounds, config)
    tell_growth(bench, held, GROWING)


def tell_growth(bench: Bench, held: list[runs.Held], growing: tuple[str, ...]) -> None:
    """Show what is held after each round, and hold the last against the second."""
    print("round  keyframes  submaps  edges  file MB  memory MB  peak MB  lost  ATE mm  NEES    ms")
    for number, each in enumerate(held, 1):
        print(
            f"{number:5}{each.keyframes:11}{each.submaps:9}{each.edges:7}{each.file_mb:9.2f}"
            f"{each.memory_mb:11.1f}{each.peak_mb:9.1f}{each.lost:6}{1e3 * each.ate_m:8.1f}"
            f"{each.nees:6.2f}{each.ms:6.1f}",
            flush=True,
        )
    bench.numbers["memory"] = [asdict(each) for each in held]
    for name in growing:
        ratio = getattr(held[-1], name) / getattr(held[1], name)
        print(f"{name:12}{ratio:6.2f} times those after two rounds")
        sentence = f"memory: {ratio:.2f} times the {name}, at most {LARGEST_GROWTH}"
        bench.need(ratio <= LARGEST_GROWTH, sentence)
    lost = sum(each.lost for each in held)
    bench.need(lost == 0, f"memory: {lost} scans lost")


if __name__ == "__main__":
    sys.exit(main())
