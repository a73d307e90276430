"""Does tracking get slower while the map grows? A simulated street with 100 to 3,000 keyframes.

    python benchmarks/growth.py [--presets stereo stereo-flow] [--sizes 100 300 1000 3000]

Rendering 3,000 keyframes would take an hour, so a street is built of one stretch of it: that
stretch is mapped by SLAM, and copies of what it left (keyframes with all their features, landmarks,
observations) are set behind each other. Each copy's descriptors are changed by a mask of its own,
which keeps the distances within a copy and makes copies strangers to each other, as other stretches
of a street are. Only the rest of the map is made up: what follows is tracked and mapped for real,
on frames of the same street ahead of it all.

One system per size drives the same frames, side by side and in turns, so that all do the same work
at the same time; each frame's time is the smallest of --repeats drives. Bar: "prepare" and "track"
together, and all but mapping, in the largest map at most 1.10 times of the smallest, by the median
over frames of the ratio of their times. Poses of all sizes must be the same. Exit code 1 otherwise.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import modules_with_kernels, warm_up
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.simulation.world import World
from odomap.system.config import preset
from odomap.system.slam import Slam
from odomap.vision.features import Features

LARGEST_RATIO = 1.10
GAP_M = 10.0
"""Between the copies of a stretch."""
FIRST = 10
"""Frames after a start that do not count: more of the map is new in them than not."""
COSTS = ("track", "all but map", "map")
"""Milliseconds that are counted: "prepare" and "track"; the call without mapping; mapping."""
BOUND = COSTS[:2]


@dataclass(frozen=True, eq=False)
class Stretch:
    """What SLAM left of a stretch of the way.

    Attributes:
        features: of its K keyframes.
        Ts_world_body: (K, 4, 4).
        anchor: (M,) row of the keyframe that each landmark is relative to.
        p_anchor: (M, 3).
        descriptors: (M, 32).
        seen: per keyframe, rows of the landmarks it sees, and at which keypoints.
    """

    features: tuple[Features, ...]
    Ts_world_body: NDArray[np.float64]
    anchor: NDArray[np.int64]
    p_anchor: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    seen: tuple[tuple[NDArray[np.int64], NDArray[np.int64]], ...]

    @classmethod
    def of(cls, m: Map) -> "Stretch":
        """Read a map of living keyframes with features."""
        ids, landmarks = m.keyframe_ids, m.landmark_ids
        Ts, anchor = m.Ts_world_body(ids), np.searchsorted(ids, m.anchors(landmarks))
        away = m.points_world(landmarks) - Ts[anchor, :3, 3]
        seen = (m.observations_of(k) for k in ids.tolist())
        kept = (m.keyframe(k).features for k in ids.tolist())
        return cls(
            tuple(features for features in kept if features is not None),
            Ts,
            anchor,
            np.einsum("nji,nj->ni", Ts[anchor, :3, :3], away),
            m.descriptors(landmarks),
            tuple((np.searchsorted(landmarks, who), where) for who, where in seen),
        )

    def add_to(self, m: Map, copy: int, most: int) -> None:
        """Set a copy of the stretch into a map, `copy` stretches behind its own place.

        Args:
            m: the map.
            copy: number of the copy, from 1.
            most: keyframes that may be added; the rest of the copy is left out.
        """
        mask = np.random.default_rng(copy).integers(0, 256, 32, np.uint8)
        ahead = self.Ts_world_body[-1, :3, 3] - self.Ts_world_body[0, :3, 3]
        length = np.linalg.norm(ahead)
        shift = -copy * (length + GAP_M) / length * ahead
        ids = np.array([m.new_keyframe_id() for _ in self.features[:most]])
        for k, T, features in zip(ids.tolist(), self.Ts_world_body, self.features, strict=False):
            T_world_body = T.copy()
            T_world_body[:3, 3] += shift
            looks = replace(features, descriptors=features.descriptors ^ mask)
            m.add_keyframe(Keyframe(k, k, features=looks), T_world_body, covariance=np.eye(6))
        rows = np.flatnonzero(self.anchor < len(ids))
        made = np.full(len(self.anchor), -1)
        looks_like = self.descriptors[rows] ^ mask
        made[rows] = m.add_landmarks(ids[self.anchor[rows]], self.p_anchor[rows], looks_like)
        for k, (who, where) in zip(ids.tolist(), self.seen, strict=False):
            known = made[who] >= 0
            m.add_observations(k, made[who[known]], where[known])


def grow(m: Map, stretch: Stretch, size: int) -> None:
    """Add copies of a stretch until a map has so many keyframes."""
    copy = 0
    while m.num_keyframes < size:
        copy += 1
        stretch.add_to(m, copy, size - m.num_keyframes)


def drive(system: Slam, frame: Frame) -> tuple[dict[str, float], NDArray[np.float64]]:
    """Track a frame; return what it cost and where it is."""
    start = time.perf_counter()
    estimate = system.track(frame)
    ms = 1e3 * (time.perf_counter() - start)
    laps = estimate.timing
    mapping = laps.get("map", 0.0)
    placing = laps.get("prepare", 0.0) + laps.get("track", 0.0)
    costs = dict(zip(COSTS, (placing, ms - mapping, mapping), strict=True))
    return costs, estimate.T_world_body.matrix


def measure(
    name: str, world: World, frames: Sequence[Frame], stretch: Stretch, sizes: Sequence[int]
) -> tuple[dict[str, NDArray[np.float64]], float, list[int]]:
    """Drive through frames with maps of several sizes, in turns.

    Returns:
        Of each cost its (frames, sizes) milliseconds; by how much poses differ between sizes, in
        metres; and how many landmarks the maps began with.
    """
    rig = world.rig.without_imu()
    systems = [Slam(rig, preset(name)) for _ in sizes]
    costs = {cost: np.zeros((len(frames), len(sizes))) for cost in COSTS}
    off, landmarks = 0.0, []
    for n, frame in enumerate(frames):
        turn = [(n + i) % len(sizes) for i in range(len(sizes))]
        places = np.empty((len(sizes), 4, 4))
        for i in turn:
            laps, places[i] = drive(systems[i], frame)
            for cost, ms in laps.items():
                costs[cost][n, i] = ms
        off = max(off, float(np.abs(places - places[0])[:, :3, 3].max()))
        if n == 0:
            for system, size in zip(systems, sizes, strict=True):
                grow(system.map, stretch, size)
                landmarks.append(system.map.num_landmarks)
    return costs, off, landmarks


def main() -> int:
    options = _options()
    cv2.setNumThreads(1)
    world = World.make(
        kind="street",
        seed=options.seed,
        frames=options.mapped + options.driven,
        speed=options.speed,
    )
    shown = [replace(world.frame(i), imu=None) for i in range(len(world))]
    print(f"{len(shown)} frames of a street rendered", flush=True)
    missed: list[str] = []
    results: dict[str, Any] = {}
    for name in options.presets:
        stretch = mapped(name, world, shown[: options.mapped])
        best: dict[str, NDArray[np.float64]] = {}
        off = 0.0
        for _ in range(options.repeats):
            ahead = shown[options.mapped :]
            costs, differ, landmarks = measure(name, world, ahead, stretch, options.sizes)
            best = {c: np.minimum(ms, best.get(c, ms)) for c, ms in costs.items()}
            off = max(off, differ)
        table = {c: ms[FIRST:] for c, ms in best.items()}
        print_table(name, options.sizes, landmarks, table)
        results[name] = {"off_m": off, "ratio": {c: ratio(ms) for c, ms in table.items()}}
        results[name]["ms"] = {c: np.median(ms, axis=0).tolist() for c, ms in table.items()}
        missed += below_bars(name, results[name])
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--presets", nargs="+", default=["stereo", "stereo-flow"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[100, 300, 1000, 3000])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--speed", type=float, default=7.5, help="m/s")
    parser.add_argument("--mapped", type=int, default=60, help="frames of the copied stretch")
    parser.add_argument("--driven", type=int, default=60, help="frames that are timed")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    if options.driven <= FIRST:
        parser.exit(2, f"{parser.prog}: --driven: more than {FIRST}\n")
    return options


def mapped(name: str, world: World, frames: Sequence[Frame]) -> Stretch:
    """Map a stretch of a street; kernels are compiled before."""
    system = Slam(world.rig.without_imu(), preset(name))
    imported = set(sys.modules)
    for module in modules_with_kernels():
        if module in imported:
            warm_up(module)
    for frame in frames:
        system.track(frame)
    return Stretch.of(system.finish().map)


def ratio(ms: NDArray[np.float64]) -> float:
    """Return the median over frames of the time in the largest map over that in the smallest."""
    small, large = ms[:, 0], ms[:, -1]
    return float(np.median(large[small > 0] / small[small > 0])) if small.any() else 1.0


def below_bars(name: str, result: dict[str, Any]) -> list[str]:
    """Return a sentence for every bar that is missed."""
    missed = [
        f"{name}: {cost}: {result['ratio'][cost]:.2f} times that in the smallest map, "
        f"at most {LARGEST_RATIO:.2f}"
        for cost in BOUND
        if not result["ratio"][cost] <= LARGEST_RATIO
    ]
    if result["off_m"] > 0:
        missed.append(f"{name}: poses differ by {result['off_m']:.3g} m between sizes")
    return missed


def print_table(
    name: str,
    sizes: Sequence[int],
    landmarks: Sequence[int],
    table: dict[str, NDArray[np.float64]],
) -> None:
    """Print the median of each cost in each size, and how it grows."""
    print(f"\n{name:24}" + "".join(f"{size:>10}" for size in sizes) + f"{'ratio':>8}")
    print(f"{'landmarks':24}" + "".join(f"{count:>10}" for count in landmarks))
    for cost, ms in table.items():
        where = ms[ms[:, 0] > 0]
        medians = np.median(where, axis=0) if len(where) else np.zeros(len(sizes))
        print(f"{cost + ', ms':24}" + "".join(f"{m:>10.2f}" for m in medians), end="")
        print(f"{ratio(ms):>8.2f}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
