"""Does a map grow with the space seen, or with time? Ten rounds of one room say.

    python benchmarks/rounds.py [--rounds 10] [--presets stereo stereo-flow ...] [--periodic]

A camera is carried round a simulated room again and again; no round is the same to the pixel (the
hand sways, exposure and noise differ). What the map holds after the last round is compared with
what it held after the second: keyframes, landmarks, bytes of the file, and memory of the process
over what it held before the first frame, all at most 1.3 times as much. The exit code is 1 where
one is more, or where a frame is lost.

With --periodic the hand sways in time with the rounds, so that each is exactly the last again, but
for noise and exposure: what still grows then grows with time alone.

The room is rendered once, with all sensors, and played to each preset in a process of its own. Low
resolution and rate keep that short.
"""

import argparse
import gc
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path as File

import cv2
import numpy as np
from memory import release_freed
from numpy.lib.format import open_memmap

from odomap.files.mapfile import save_map
from odomap.geometry.trajectory import Trajectory
from odomap.kernels import modules_with_kernels, warm_up
from odomap.maps.estimate import Status
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.simulation.path import Harmonics, Path
from odomap.simulation.world import World
from odomap.system.config import preset
from odomap.system.slam import Slam

PRESETS = ("stereo", "stereo-flow", "rgbd", "rgbd-flow", "mono", "mono-flow")
LARGEST_GROWTH = 1.3
GROWING = ("keyframes", "landmarks", "file_mb", "memory_mb")


@dataclass(frozen=True)
class Held:
    """What a map holds after a round.

    Attributes:
        keyframes: alive.
        landmarks: how many.
        file_mb: size of its file.
        memory_mb: of the process, over what it held before the first frame.
        lost: frames of this round that could not be placed.
        ms: median of a frame's time in this round, mapping included.
    """

    keyframes: int
    landmarks: int
    file_mb: float
    memory_mb: float
    lost: int
    ms: float


class Rendered:
    """Frames of a world in files, so that several processes can play them."""

    def __init__(self, folder: File) -> None:
        names = "left", "right", "depth", "stamps"
        arrays = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in names)
        self._left, self._right, self._depth, self._stamps = arrays

    @classmethod
    def of(cls, world: World, folder: File) -> "Rendered":
        """Render all frames of a world into files."""
        width, height = world.spec.resolution
        shape = len(world), height, width
        kinds = {"left": np.uint8, "right": np.uint8, "depth": np.float32}
        files = {
            name: open_memmap(folder / f"{name}.npy", "w+", kind, shape)
            for name, kind in kinds.items()
        }
        np.save(folder / "stamps.npy", world.truth.stamps_ns)
        for index in range(len(world)):
            frame = world.frame(index)
            measured = *frame.images, frame.depth
            for file, image in zip(files.values(), measured, strict=True):
                file[index] = image
        for file in files.values():
            file.flush()
        return cls(folder)

    def __len__(self) -> int:
        return len(self._stamps)

    def __iter__(self) -> Iterator[Frame]:
        for index, stamp in enumerate(self._stamps.tolist()):
            images = np.array(self._left[index]), np.array(self._right[index])
            yield Frame(index, stamp, images, depth=np.array(self._depth[index]))


def main() -> int:
    options = _options()
    world, each = room(options)
    print(f"a room of {each} frames per round, {options.rounds} rounds, {options.resolution}")
    grown: dict[str, list[Held]] = {}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="odomap-rounds-") as folder:
        Rendered.of(world, File(folder))
        print(f"rendered in {time.perf_counter() - start:.0f} s", flush=True)
        rig = world.rig.without_imu()
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as pool:
            for name in options.presets:
                grown[name] = pool.submit(play, folder, rig, name, each).result()
                print_table(name, grown[name])
    missed = [line for name, rounds in grown.items() for line in below_bars(name, rounds)]
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        content = {name: [asdict(held) for held in rounds] for name, rounds in grown.items()}
        File(options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resolution", default="320x200")
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second")
    parser.add_argument("--speed", type=float, default=0.6, help="of the camera, m/s")
    parser.add_argument("--periodic", action="store_true", help="every round is the same")
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    if options.rounds < 2:
        parser.exit(2, f"{parser.prog}: --rounds: at least 2, since the second is compared with\n")
    return options


def room(options: argparse.Namespace) -> tuple[World, int]:
    """Return a room, gone round as often as wanted, and the frames of one round."""
    width, height = (int(n) for n in options.resolution.split("x"))
    fields = {"kind": "room", "seed": options.seed, "rate_hz": options.rate}
    fields |= {"resolution": (width, height), "speed": options.speed}
    fields["sensors"] = ("stereo", "depth")
    each = round(options.rate / World.make(**fields, frames=1).path.rounds_per_s)
    world = World.make(**fields, frames=options.rounds * each)
    if options.periodic:  # a world has no field for it: its path is put in place of another
        world._path = periodic(world.path)
        stamps = world.truth.stamps_ns
        world.truth = Trajectory(stamps, world._at(stamps))
    return world, each


def periodic(path: Path) -> Path:
    """Return a path whose sway and pace repeat with every round."""

    def in_time(sway: Harmonics) -> Harmonics:
        once = 2 * np.pi * path.rounds_per_s
        return replace(sway, omega=once * np.maximum(1.0, np.rint(sway.omega / once)))

    sways = {name: in_time(getattr(path, name)) for name in ("unevenness", "sway", "tilt")}
    return replace(path, **sways)


def play(folder: str, rig: Rig, name: str, each: int) -> list[Held]:
    """Play rendered frames to a preset; return what its map holds after each round."""
    cv2.setNumThreads(1)
    system = Slam(rig, preset(name))
    imported = set(sys.modules)
    for module in modules_with_kernels():
        if module in imported:
            warm_up(module)
    before = private_mb()
    rounds: list[Held] = []
    statuses: list[Status] = []
    ms: list[float] = []
    for frame in Rendered(File(folder)):
        start = time.perf_counter()
        statuses.append(system.track(frame).status)
        ms.append(1e3 * (time.perf_counter() - start))
        if len(ms) == each:
            path = File(folder) / f"{name}.odomap"
            save_map(path, system.map, rig)
            rounds.append(
                Held(
                    system.map.num_keyframes,
                    system.map.num_landmarks,
                    path.stat().st_size / 2**20,
                    private_mb() - before,
                    statuses.count(Status.LOST),
                    float(np.median(ms)),
                )
            )
            statuses.clear()
            ms.clear()
    return rounds


def private_mb() -> float:
    """Return the memory this process holds for itself alone, in MB; files it reads are not in it.

    What is free is given back first, so that the C library's pools do not count.
    """
    gc.collect()
    release_freed()
    statm = File("/proc/self/statm")
    if not statm.exists():
        sys.exit("rounds.py: reads /proc/self/statm, which only Linux has")
    resident, shared = (int(n) for n in statm.read_text(encoding="ascii").split()[1:3])
    import resource

    return (resident - shared) * resource.getpagesize() / 2**20


def growth(rounds: list[Held]) -> dict[str, float]:
    """Return the last round over the second of everything that may grow."""
    second, last = rounds[1], rounds[-1]
    return {name: getattr(last, name) / getattr(second, name) for name in GROWING}


def below_bars(name: str, rounds: list[Held]) -> list[str]:
    """Return a sentence for every bar that is missed."""
    missed = [
        f"{name}: {what} after round {len(rounds)}: {ratio:.2f} times those of round 2, "
        f"at most {LARGEST_GROWTH}"
        for what, ratio in growth(rounds).items()
        if not ratio <= LARGEST_GROWTH
    ]
    lost = sum(held.lost for held in rounds)
    return [*missed, f"{name}: {lost} frames lost"] if lost else missed


def print_table(name: str, rounds: list[Held]) -> None:
    """Print what the map held after each round, and how it grew."""
    print(f"\n{name:12}{'keyframes':>10}{'landmarks':>10}{'file MB':>9}{'memory MB':>10}", end="")
    print(f"{'lost':>6}{'ms':>7}")
    for number, held in enumerate(rounds, 1):
        print(f"round {number:<6}{held.keyframes:>10}{held.landmarks:>10}", end="")
        print(f"{held.file_mb:>9.2f}{held.memory_mb:>10.1f}{held.lost:>6}{held.ms:>7.1f}")
    ratio = growth(rounds)
    print(f"{'last / 2nd':12}{ratio['keyframes']:>10.2f}{ratio['landmarks']:>10.2f}", end="")
    print(f"{ratio['file_mb']:>9.2f}{ratio['memory_mb']:>10.2f}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
