"""Maps as files: size, and how long it takes to save, open and load one.

    python benchmarks/mapfile.py [--keyframes 3000] [--landmarks 300000] [--features 1000] [DATA...]

Simulated streets of keyframes (each sees landmarks of a stretch, and has features, as SLAM keeps
them), a short one and a long one, and the maps that odometry leaves of recordings. The best of
several repeats; `lock` is the longest hold of the map's lock while it is saved, of which `dump` is
the part that copies it; `one` opens the file and reads the features of one keyframe; saving
includes the flush to the disk.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from map import TimedLock, street

from odomap.files.mapfile import MapFile, load_map, save_map
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.vision.features import Features


def with_features(m: Map, count: int) -> Map:
    """Return a copy of a map whose keyframes have so many features each."""
    rng = np.random.default_rng(0)
    tables = m.dump()
    keyframes = []
    for keyframe in tables.keyframes:
        bearings = rng.normal(size=(count, 3))
        features = Features(
            rng.uniform(0, 1000, (count, 2)).astype(np.float32),
            rng.integers(0, 256, (count, 32), np.uint8),
            bearings / np.linalg.norm(bearings, axis=1, keepdims=True),
            rng.uniform(1, 50, count),
            rng.integers(0, 8, count).astype(np.uint8),
        )
        keyframes.append(Keyframe(keyframe.id, keyframe.stamp_ns, features=features))
    return Map.restored(type(tables)(**{**vars(tables), "keyframes": tuple(keyframes)}))


def odometry_map(data: str) -> Map:
    """Return the map that odometry leaves of a recording."""
    import odomap

    source = odomap.open(data)
    if source.rig.depth is not None:
        vo = odomap.RgbdVO(source.rig)
    elif len(source.rig.cameras) > 1:
        vo = odomap.StereoVO(source.rig)
    else:
        vo = odomap.MonocularVO(source.rig.cameras[0].camera)
    for frame in source:
        vo.track(frame)
    return vo.finish().map


def best(call: Callable[[], object], repeat: int) -> float:
    laps = []
    for _ in range(repeat):
        start = time.perf_counter()
        call()
        laps.append(1e3 * (time.perf_counter() - start))
    return min(laps)


def open_only(path: Path) -> None:
    MapFile(path).close()


def one_keyframe(path: Path, keyframe: int) -> None:
    with MapFile(path) as file:
        file.features(keyframe)


def report(name: str, m: Map, folder: Path, repeat: int = 5) -> None:
    path = folder / "map.odomap"
    save = best(lambda: save_map(path, m), repeat)
    ids = [k.id for k in m.dump().keyframes if k.features is not None]
    m.lock = lock = TimedLock()  # type: ignore[assignment]
    dump = best(m.dump, repeat)
    numbers = [
        path.stat().st_size / 2**20,
        lock.longest,
        dump,
        save,
        best(lambda: open_only(path), repeat),
        best(lambda: one_keyframe(path, ids[len(ids) // 2]), repeat) if ids else 0.0,
        best(lambda: load_map(path), repeat),
    ]
    counts = f"{m.num_keyframes} / {m.num_landmarks} / {m.num_observations}"
    print(f"{name:<30}{counts:>26}" + "".join(f"{n:>10.2f}" for n in numbers))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=3000)
    parser.add_argument("--landmarks", type=int, default=300_000)
    parser.add_argument("--features", type=int, default=1000)
    parser.add_argument("data", nargs="*", default=[])
    given = parser.parse_args()
    print(f"{'':<30}{'keyframes/landmarks/seen':>26}", end="")
    print(
        "".join(f"{word:>10}" for word in ("MB", "lock", "dump", "save", "open", "one", "load")),
        " ms",
    )
    with tempfile.TemporaryDirectory() as folder:
        for keyframes, landmarks in ((100, 10_000), (given.keyframes, given.landmarks)):
            m = street(keyframes, landmarks, 5 * landmarks)
            report("street", m, Path(folder))
            name = f"street, {given.features} features each"
            report(name, with_features(m, given.features), Path(folder), 3)
        for data in given.data:
            report(Path(data).name[:29], odometry_map(data), Path(folder))


if __name__ == "__main__":
    main()
