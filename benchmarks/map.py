"""How long the map holds its lock: the design allows 2 ms.

    python benchmarks/map.py [--keyframes 3000] [--landmarks 200000] [--observations 1000000]

Each line is one method, called many times on a street-like map (neighbouring keyframes share
landmarks): how long a call takes, and how long it holds the lock at a stretch, counted on the
thread's own clock, so that other programs on the machine do not count. The last lines build a map
of that size call by call, which meets all growing of tables, and let a second thread wait for the
lock while the map is copied.
"""

import argparse
import threading
import time
from collections.abc import Callable
from types import TracebackType

import numpy as np

from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.vision.features import Features


class TimedLock:
    """A re-entrant lock that remembers its longest hold, in ms of the holder's own time."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._depth = 0
        self._since = 0.0
        self.longest = 0.0

    def __enter__(self) -> None:
        self._lock.acquire()
        self._depth += 1
        if self._depth == 1:
            self._since = time.thread_time()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.longest = max(self.longest, 1e3 * (time.thread_time() - self._since))
        self._lock.release()


def described(id: int, count: int) -> Keyframe:
    """Return a keyframe with features on eight levels."""
    nothing = np.zeros((count, 3))
    level = (np.arange(count) % 8).astype(np.uint8)
    keypoints, looks = np.zeros((count, 2), np.float32), np.zeros((count, 32), np.uint8)
    return Keyframe(id, id, features=Features(keypoints, looks, nothing, nothing[:, 0], level))


def street(
    keyframes: int, landmarks: int, observations: int, seed: int = 0, *, described_too: bool = False
) -> Map:
    """Return a map in which each keyframe sees landmarks from a stretch of the street."""
    rng = np.random.default_rng(seed)
    m = Map()
    each = observations // keyframes
    for k in range(keyframes):
        T = np.eye(4)
        T[0, 3] = k
        keyframe = described(k, each) if described_too else Keyframe(k, k)
        m.add_keyframe(keyframe, T, covariance=np.eye(6))
    anchors = np.arange(landmarks) * keyframes // landmarks
    ids = m.add_landmarks(anchors, rng.normal(size=(landmarks, 3)))
    stretch = 4 * each
    for k in range(keyframes):
        near = (
            k * landmarks // keyframes + rng.permutation(stretch)[:each] - stretch // 2
        ) % landmarks
        m.add_observations(k, ids[near], np.arange(each))
    return m


def report(name: str, m: Map, call: Callable[[int], object], repeat: int = 200) -> None:
    """Print median and maximum of a call's duration, and median and maximum of its holds."""
    laps, holds = [], []
    for n in range(repeat):
        lock = TimedLock()
        m.lock = lock  # type: ignore[assignment]
        start = time.thread_time()
        call(n)
        laps.append(1e3 * (time.thread_time() - start))
        holds.append(lock.longest)
    numbers = np.median(laps), max(laps), np.median(holds), max(holds)
    print(f"{name:<44}" + "".join(f"{number:>9.3f}" for number in numbers))


def track(m: Map, K: int) -> None:
    """What tracking and local mapping ask of a map, frame by frame."""
    ids, mount = m.landmark_ids, np.eye(4)
    seen = m.observations_of(K // 2)[0]
    around = m.covisible(K // 2)[0][:30]
    local = m.landmarks_of(around)[:3000]
    observers = int(m.count_observers(local).sum())
    print(f"local map of {len(local)} landmarks with {observers} observations")
    report("observing", m, lambda n: m.observing(seen))
    report("landmarks_of 30 keyframes", m, lambda n: m.landmarks_of(around))
    report("views_of", m, lambda n: m.views_of(local, mount))
    report("points_world", m, lambda n: m.points_world(local))
    report("points_world, 500 ids", m, lambda n: m.points_world(ids[n : n + 500]))
    report("near", m, lambda n: m.near(m.T_world_body(K // 2), 5.0, 1.0))
    report("count_seen", m, lambda n: m.count_seen(local))
    report("set_descriptors", m, lambda n: m.set_descriptors(local, m.descriptors(local)))
    report("observers_of", m, lambda n: m.observers_of(local))
    report("covisible", m, lambda n: m.covisible(K // 2))
    report("landmark_ids", m, lambda n: m.landmark_ids)


def change(m: Map, K: int) -> None:
    """What local mapping does to a map."""
    rng = np.random.default_rng(1)
    window, held = np.arange(K // 2, K // 2 + 25), np.arange(K // 2 - 10, K // 2)
    local = m.snapshot(window, held)
    nothing = local.solved(local.Ts_world_body, local.points_world)
    some = np.arange(0, len(local.obs_keypoint), 50)
    drops = local.solved(local.Ts_world_body, local.points_world, dropped=some)
    ids = m.landmark_ids
    seen = m.observations_of(K // 2)[0]
    views = [m.observations_of(k)[0] for k in range(K)]
    size = f"({len(local.landmark_ids)} landmarks, {len(local.obs_keypoint)} observations)"
    print(f"window of 25 + 10 fixed {size}")
    report("snapshot, window", m, lambda n: m.snapshot(window, held))
    report("apply, window", m, lambda n: m.apply(nothing))
    report("apply, window, 2 % dropped", m, lambda n: m.apply(drops), 1)
    report("add_keyframe", m, lambda n: m.add_keyframe(described(K + n, 400), np.eye(4)))
    report(
        "add_observations of a keyframe",
        m,
        lambda n: m.add_observations(K + n, views[n], np.arange(len(views[n]))),
    )
    report("add_landmarks, 100", m, lambda n: m.add_landmarks(K + n, np.zeros((100, 3))))
    report(
        "fuse_landmarks, 20",
        m,
        lambda n: m.fuse_landmarks(ids[40 * n : 40 * n + 20], ids[40 * n + 20 : 40 * n + 40]),
    )
    far = len(ids) // 2
    report(
        "fuse_landmarks, 200",
        m,
        lambda n: m.fuse_landmarks(
            ids[far + 400 * n : far + 400 * n + 200], ids[far + 400 * n + 200 : far + 400 * n + 400]
        ),
        20,
    )
    report("cull_keyframes, 1", m, lambda n: m.cull_keyframes([K + n]), 100)
    report("cull_keyframes, 5", m, lambda n: m.cull_keyframes(K - 100 + 5 * n + np.arange(5)), 10)
    report("retire_keyframes, 1", m, lambda n: m.retire_keyframes([n]))
    report("remove_landmarks, 20", m, lambda n: m.remove_landmarks(rng.choice(seen, 20)))
    report("remove_landmarks, 300", m, lambda n: m.remove_landmarks(views[K // 4 + n]), 10)


def everything(m: Map) -> None:
    """What needs the whole map: loop closures, and files."""
    whole = m.snapshot(m.keyframe_ids)
    solved = whole.solved(whole.Ts_world_body, whole.points_world)
    parts = solved.split(5000)
    print("the whole map")
    report("snapshot, poses only", m, lambda n: m.snapshot(m.keyframe_ids, landmarks=False), 20)
    report("snapshot, all", m, lambda n: m.snapshot(m.keyframe_ids), 10)
    report("apply, all", m, lambda n: m.apply(solved), 10)
    report("apply, its parts of 5000 landmarks, each", m, lambda n: m.apply(parts[n]), len(parts))
    report("dump", m, lambda n: m.dump(), 10)
    report("edges", m, lambda n: m.edges(), 10)


def growth(keyframes: int, landmarks: int, observations: int) -> None:
    """Build a map call by call, and print the longest hold of all calls."""
    m, lock, held = Map(), TimedLock(), []
    m.lock = lock  # type: ignore[assignment]
    new, each = landmarks // keyframes, observations // keyframes
    looks = np.zeros((new, 32), np.uint8)
    for k in range(keyframes):
        m.add_keyframe(Keyframe(m.new_keyframe_id(), k), np.eye(4))
        ids = m.add_landmarks(k, np.zeros((new, 3)), looks)
        seen = np.arange(max(0, ids[-1] + 1 - each), ids[-1] + 1)
        m.add_observations(k, seen, np.arange(len(seen)))
        held.append(lock.longest)
        lock.longest = 0.0
    numbers = np.median(held), max(held)
    print(f"{'growing: each call':<62}" + "".join(f"{number:>9.3f}" for number in numbers))


def wait_beside_a_dump(m: Map) -> None:
    """Print how long another thread waits for the lock while the map is copied."""
    m.lock = threading.RLock()
    waits, done = [], threading.Event()

    def ask() -> None:
        while not done.is_set():
            start = time.perf_counter()
            with m.lock:
                waits.append(1e3 * (time.perf_counter() - start))
            time.sleep(0.0005)

    thread = threading.Thread(target=ask)
    thread.start()
    start = time.perf_counter()
    for _ in range(5):
        m._twin()
    took = 1e3 * (time.perf_counter() - start) / 5
    done.set()
    thread.join()
    numbers = took, np.median(waits), max(waits)
    print("a copy takes {:.0f} ms; another thread waits {:.3f} ms, at most {:.2f}".format(*numbers))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=3000)
    parser.add_argument("--landmarks", type=int, default=200_000)
    parser.add_argument("--observations", type=int, default=1_000_000)
    size = parser.parse_args()
    m = street(size.keyframes, size.landmarks, size.observations, described_too=True)
    sizes = m.num_keyframes, m.num_landmarks, m.num_observations
    print("{} keyframes, {} landmarks, {} observations".format(*sizes))
    print(f"{'':<44}{'call':>9}{'max':>9}{'hold':>9}{'max':>9}   ms")
    track(m, size.keyframes)
    change(m, size.keyframes)
    everything(m)
    growth(size.keyframes, size.landmarks, size.observations)
    wait_beside_a_dump(m)


if __name__ == "__main__":
    main()
