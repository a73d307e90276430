"""Does memory grow with the recording? A run over thousands of simulated frames says.

    python benchmarks/memory.py [--frames 3000] [--resolution 320x200] [--render 0] [--json FILE]

`odomap.run` tracks a simulated room; the memory the process holds (RSS) is sampled every few
frames, and a line fitted through the samples after warm-up gives MB per 1,000 frames. What a run
must keep grows with it: a pose, a covariance and a status for every frame, a pose for every
keyframe. That is a few kilobytes per frame; images or landmarks kept by mistake are hundreds. The
exit code is 1 where it grows by more than --limit.

Rendering takes most of the time, hence the low resolution. --render N renders only N frames and
plays them to and fro, which is faster but comes back to the same few places.
"""

import argparse
import ctypes
import gc
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from odomap.geometry.trajectory import Trajectory
from odomap.run import Progress, run
from odomap.sensors.frame import Frame
from odomap.simulation.world import World
from odomap.sources.open import open as open_source
from odomap.sources.source import Skipped, Source

SAMPLE_EVERY = 25


class ToAndFro:
    """A few frames of a world, rendered once and played to and fro for as long as wanted."""

    def __init__(self, world: World, frames: int) -> None:
        self._shown = [world.frame(i) for i in range(len(world))]
        self._frames = frames
        self._step_ns = round(1e9 / world.spec.rate_hz)
        self.name = f"sim:{world.spec.kind} (to and fro)"
        self.rig = world.rig.without_imu()
        self.truth: Trajectory | None = None
        self.skipped: list[Skipped] = []

    def __len__(self) -> int:
        return self._frames

    def __iter__(self) -> Iterator[Frame]:
        last = len(self._shown) - 1
        start = self._shown[0].stamp_ns
        for index in range(self._frames):
            lap, place = divmod(index, last)
            shown = self._shown[last - place if lap % 2 else place]
            yield replace(shown, id=index, stamp_ns=start + index * self._step_ns, imu=None)


def main() -> int:
    options = _options()
    source = open_it(options)
    size = "x".join(str(n) for n in source.rig.cameras[0].camera.resolution)
    print(f"{source.name}, {size} pixels, {len(source)} frames")
    samples: list[tuple[int, float]] = []
    start = time.perf_counter()

    def sample(progress: Progress) -> None:
        if progress.stage == "tracking" and progress.done % SAMPLE_EVERY == 0:
            gc.collect()
            release_freed()
            samples.append((progress.done, resident_mb()))

    result = run(source, progress=sample)
    seconds = time.perf_counter() - start
    slope = growth(samples, options.warm_up)
    frames, mb = np.array(samples).T
    for k in np.unique(np.linspace(0, len(frames) - 1, 13).round().astype(int)):
        print(f"  frame {frames[k]:6.0f}  {mb[k]:8.1f} MB")
    numbers = result.metrics
    print(
        f"{numbers['frames']} frames in {seconds:.0f} s with rendering, {numbers['lost']} lost, "
        f"{numbers['keyframes']} keyframes, {numbers['landmarks']} landmarks in the map"
    )
    verdict = "flat" if slope <= options.limit else "NOT FLAT"
    print(f"{slope:+.2f} MB per 1000 frames after warm-up: {verdict}")
    if options.json:
        content = {"slope_mb_per_1000": slope, "samples": samples, "lost": numbers["lost"]}
        Path(options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return 0 if slope <= options.limit else 1


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--kind", choices=("room", "street"), default="room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resolution", default="320x200")
    parser.add_argument("--render", type=int, default=0, help="frames to render; 0 for all")
    parser.add_argument("--warm-up", type=int, default=500, help="frames before the line begins")
    parser.add_argument("--limit", type=float, default=5.0, help="MB per 1000 frames")
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    if options.frames < 10 * SAMPLE_EVERY:
        parser.exit(2, f"{parser.prog}: --frames: at least {10 * SAMPLE_EVERY}\n")
    return options


def open_it(options: argparse.Namespace) -> Source:
    """Return the source that was asked for."""
    frames = options.render or options.frames
    name = f"sim:{options.kind}?seed={options.seed}&frames={frames}"
    name += f"&resolution={options.resolution}"
    if not options.render:
        return open_source(name)
    width, height = (int(n) for n in options.resolution.split("x"))
    world = World.make(
        kind=options.kind, seed=options.seed, frames=frames, resolution=(width, height)
    )
    return ToAndFro(world, options.frames)


def growth(samples: list[tuple[int, float]], warm_up: int) -> float:
    """Return the slope of memory after warm-up (at most half the run), MB per 1,000 frames."""
    frames, mb = np.array(samples).T
    counted = frames > min(warm_up, 0.5 * frames[-1])
    return float(1000.0 * np.polyfit(frames[counted], mb[counted], 1)[0])


def resident_mb() -> float:
    """Return the memory this process holds now, in MB."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        sys.exit("memory.py: reads /proc/self/statm, which only Linux has")
    pages = int(statm.read_text(encoding="ascii").split()[1])
    import resource

    return pages * resource.getpagesize() / 1024**2


def release_freed() -> None:
    """Have the C library give back what is free, so that its pools do not count as growth."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except AttributeError:  # a C library without it
        return


if __name__ == "__main__":
    sys.exit(main())
