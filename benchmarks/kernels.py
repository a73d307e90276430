"""What each kernel costs, how long a cold start compiles, and how soon --help answers.

    python benchmarks/kernels.py [--repeats 20] [--skip-cold] [--json FILE]

Kernels run on rendered images of EuRoC's size and on windows of the size that odometry solves.
Times are the smallest over the repeats, of the processor and of the wall clock: they differ where
OpenCV uses several threads, or where other programs are in the way. Beside a kernel stands
OpenCV's answer to the same question, in one thread, where it has one.

A cold start is `odomap run` on three exported frames with an empty NUMBA_CACHE_DIR, in a process
of its own. The exit code is 1 where a bar is missed: 60 s to compile, 0.5 s to --help. On a busy
machine the processor time is what counts.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from meter import machine
from windows import motion_problem, window_problem

from odomap.backend.bundle import BundleConfig, solve_bundle
from odomap.backend.motion import solve_motion
from odomap.geometry.lie import se3_exp
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World
from odomap.vision.features import FeatureConfig, detect
from odomap.vision.flow import FlowConfig, pyramid, track
from odomap.vision.stereo import StereoConfig, match_sparse

LARGEST_COMPILE_S = 60.0
LARGEST_HELP_S = 0.5


@dataclass(frozen=True)
class Lap:
    """The cost of one thing: the smallest over the repeats, in seconds."""

    cpu: float
    wall: float


@dataclass(frozen=True)
class Row:
    """A kernel, what it is counted per, and OpenCV's answer if there is one."""

    name: str
    per: str
    count: int
    ours: Lap
    peer: Lap | None = None
    peer_name: str = ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--skip-cold", action="store_true", help="do not compile anew")
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{machine()}; smallest of {options.repeats}, OpenCV in one thread")
    print(f"{'':40}{'CPU':>10}{'wall':>10}{'OpenCV':>10}{'ratio':>7}")
    rows = [*image_kernels(options.repeats), *solvers(options.repeats)]
    for row in rows:
        print(_cells(row))
    missed: list[str] = []
    starts = {"help": help_time()}
    if not options.skip_cold:
        starts |= cold_start()
    for name, lap in starts.items():
        print(f"{name:40}{lap.cpu:8.2f} s{lap.wall:8.2f} s")
    for name, limit in (("help", LARGEST_HELP_S), ("cold, compiling", LARGEST_COMPILE_S)):
        if name in starts and min(starts[name].cpu, starts[name].wall) > limit:
            missed.append(f"{name}: {starts[name].cpu:.2f} s, at most {limit} s")
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        content = {
            "machine": machine(),
            "kernels": [asdict(row) for row in rows],
            "starts": {name: asdict(lap) for name, lap in starts.items()},
        }
        Path(options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return 1 if missed else 0


def measure(call: Callable[[], object], repeats: int) -> Lap:
    """Return the smallest processor and wall time of a call, after one that does not count."""
    call()
    cpu, wall = [], []
    for _ in range(repeats):
        start, start_cpu = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - start_cpu)
    return Lap(min(cpu), min(wall))


def image_kernels(repeats: int) -> list[Row]:
    """Measure flow, stereo and detection on two frames of a rendered room."""
    world = World.make(kind="room", seed=1, frames=4, resolution=(752, 480), sensors=("stereo",))
    left, right = world.frame(0).images
    later = world.frame(3).images[0]
    assert left is not None
    assert right is not None
    assert later is not None
    features, flow, stereo = FeatureConfig(), FlowConfig(), StereoConfig()
    corners = detect(left, features)
    points = corners.keypoints.astype(np.float64)
    n = len(points)
    template, target = pyramid(left, flow.levels), pyramid(later, flow.levels)
    side = 2 * flow.half_window_px + 1

    def both_ways() -> object:
        there, _, _ = cv2.calcOpticalFlowPyrLK(
            left, later, corners.keypoints, None, winSize=(side, side), maxLevel=flow.levels - 1
        )
        return cv2.calcOpticalFlowPyrLK(
            later, left, there, None, winSize=(side, side), maxLevel=flow.levels - 1
        )

    sgbm = cv2.StereoSGBM.create(0, 128, 5, 200, 800, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    return [
        Row("pyramid", "image", 1, measure(lambda: pyramid(left, flow.levels), repeats)),
        Row(
            "flow, there and back",
            "point",
            n,
            measure(lambda: track(template, target, points, points, flow), repeats),
            measure(both_ways, repeats),
            "calcOpticalFlowPyrLK",
        ),
        Row(
            "stereo, sparse",
            "point",
            n,
            measure(lambda: match_sparse(left, right, points, stereo), repeats),
            measure(lambda: sgbm.compute(left, right), max(2, repeats // 5)),
            "StereoSGBM, whole image",
        ),
        Row(
            f"detection, {n} corners",
            "image",
            1,
            measure(lambda: detect(left, features), repeats),
            measure(lambda: cv2.goodFeaturesToTrack(left, features.count, 0.01, 20.0), repeats),
            "goodFeaturesToTrack",
        ),
    ]


def solvers(repeats: int) -> list[Row]:
    """Measure the bundle of a window and the pose of one frame."""
    bundle = window_problem()
    T, T_camera_body, baseline, sightings = motion_problem()
    start = T @ se3_exp(np.array([0.02, -0.01, 0.03, 0.004, -0.006, 0.002]))
    guess = np.linalg.inv(start)
    rvec, tvec = cv2.Rodrigues(guess[:3, :3])[0], guess[:3, 3:].copy()
    tried = solve_bundle(bundle, BundleConfig()).iterations
    size = f"{len(bundle.is_fixed)} poses, {len(bundle.pose)} obs., {tried} steps"
    n = len(sightings.xy)
    return [
        Row(
            f"bundle: {size}",
            "window",
            1,
            measure(lambda: solve_bundle(bundle, BundleConfig()), repeats),
        ),
        Row(
            f"motion only, {n} points",
            "frame",
            1,
            measure(lambda: solve_motion(start, T_camera_body, baseline, sightings), repeats),
            measure(
                lambda: cv2.solvePnP(
                    sightings.points_world,
                    sightings.xy,
                    np.eye(3),
                    None,
                    rvec.copy(),
                    tvec.copy(),
                    True,
                    cv2.SOLVEPNP_ITERATIVE,
                ),
                repeats,
            ),
            "solvePnP, no loss, left image only",
        ),
    ]


def help_time() -> Lap:
    """Return the time `odomap --help` takes, the smallest of five."""
    laps = [_child([sys.executable, "-m", "odomap", "--help"], {})[0] for _ in range(5)]
    return Lap(min(lap.cpu for lap in laps), min(lap.wall for lap in laps))


COLD_RUN = """
import json, sys, time
import odomap.kernels, odomap.run
laps, warm_up = [], odomap.kernels.warm_up
def timed(name):
    start = time.process_time(), time.perf_counter()
    warm_up(name)
    laps.append([name, time.process_time() - start[0], time.perf_counter() - start[1]])
odomap.kernels.warm_up = timed
odomap.run.run(sys.argv[1], sys.argv[2])
assert laps, "the run warmed up nothing"
print(json.dumps(laps))
"""
"""A run that tells how long each module with kernels took."""


def cold_start() -> dict[str, Lap]:
    """Return the times of a first and of a second run on three frames, cache empty before."""
    laps: dict[str, Lap] = {}
    with tempfile.TemporaryDirectory(prefix="odomap-cold-") as name:
        folder = Path(name)
        world = World.make(kind="room", seed=1, frames=3, resolution=(320, 200))
        recording = export_euroc(world, folder / "room")
        cache = {"NUMBA_CACHE_DIR": str(folder / "cache")}
        for which in ("cold", "warm"):
            command = [sys.executable, "-c", COLD_RUN, str(recording), str(folder / which)]
            lap, said = _child(command, cache)
            parts = [(module, Lap(*times)) for module, *times in json.loads(said.splitlines()[-1])]
            cpu, wall = (sum(getattr(part, of) for _, part in parts) for of in ("cpu", "wall"))
            laps[f"{which}, compiling"] = Lap(cpu, wall)
            laps[f"{which}, whole run with report"] = lap
            if which == "cold":
                parts.sort(key=lambda item: -item[1].cpu)
                laps |= {f"  {module}": part for module, part in parts[:8]}
    return laps


def _child(command: list[str], variables: Mapping[str, str]) -> tuple[Lap, str]:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    done = subprocess.run(
        command, env=os.environ | variables, capture_output=True, text=True, check=False
    )
    wall = time.perf_counter() - start
    if done.returncode != 0:
        sys.exit(
            f"{Path(command[0]).name} {command[1]} failed:\n{(done.stderr or done.stdout)[-1500:]}"
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Lap(cpu, wall), done.stdout


def _cells(row: Row) -> str:
    scale, unit = (1e6, "µs") if row.per == "point" else (1e3, "ms")
    each = scale / row.count
    text = f"{row.name:40}{each * row.ours.cpu:7.2f} {unit}{each * row.ours.wall:7.2f} {unit}"
    if row.peer is not None:
        text += f"{each * row.peer.cpu:7.2f} {unit}{row.ours.cpu / row.peer.cpu:7.2f}"
    return f"{text}  per {row.per}" + (f"; {row.peer_name}" if row.peer_name else "")


if __name__ == "__main__":
    sys.exit(main())
