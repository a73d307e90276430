"""2D lasers: how fast scans become a grid.

    python benchmarks/laser2d.py [--part rays] [--repeats 3] [--json FILE]

    rays   1,000 scans of 360 beams, driven through a simulated building, laid into a grid of 5 cm
           cells at their true poses: from ranges to cells, growth included. Beside it rays alone,
           and cells passed per second. Bar: under 1 s, by the smallest of --repeats.

Exit code 1 where a bar is missed.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from odomap.lidar.grid import OccupancyGrid
from odomap.lidar.scans import Beams
from odomap.simulation.laserworld import LaserSpec, LaserWorld

PARTS = ("rays",)
SCANS, BEAMS, LONGEST_S = 1000, 360, 1.0


class Bench:
    """What was measured, and which bars were missed."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.numbers: dict[str, object] = {}
        self.missed: list[str] = []

    def need(self, is_kept: bool, sentence: str) -> None:
        """Note a bar that is missed."""
        if not is_kept:
            self.missed.append(sentence)

    def save(self) -> None:
        """Write what there is."""
        if self.options.json:
            content = {"numbers": self.numbers, "missed": self.missed}
            self.options.json.write_text(json.dumps(content, indent=1), encoding="utf-8")


def main() -> int:
    options = _options()
    bench = Bench(options)
    parts: dict[str, Callable[[Bench], None]] = {"rays": rays}
    for part in options.part:
        print(f"\n{part}", flush=True)
        parts[part](bench)
        bench.save()
    for line in bench.missed:
        print(f"bar missed: {line}")
    return 1 if bench.missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--repeats", type=int, default=3, help="of what is timed")
    parser.add_argument("--json", type=Path, help="write all numbers here")
    return parser.parse_args()


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


if __name__ == "__main__":
    sys.exit(main())
