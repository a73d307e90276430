"""Scan Context in NumPy: places of a drive recognised on the second round, turned, and from beside.

Run it with `python examples/46_scan_context.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap

Array = np.ndarray
TOWN = "sim:street?sensors=lidar3d&seed=2&beams=16&columns=600"
RINGS, SECTORS, REACH = 20, 36, 60.0  # m
AROUND = np.diag([-1.0, -1.0, 1.0])  # turned by 180 degrees


def context(points: Array, beside: float = 0.0) -> Array:
    """Return (rings, sectors) heights, each column of length 1, seen from so far to the left."""
    x, y = points[:, 0], points[:, 1] - beside
    ring = (RINGS * np.hypot(x, y) / REACH).astype(int)
    sector = ((np.arctan2(y, x) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    heights, z = np.zeros((RINGS, SECTORS)), points[:, 2] - np.percentile(points[:, 2], 5) + 0.3
    near = ring < RINGS
    np.maximum.at(heights, (ring[near], sector[near]), z[near])
    return heights / np.maximum(np.linalg.norm(heights, axis=0), 1e-9)


def compare(a: Array, b: Array) -> tuple[float, float]:
    """Return the distance at the best turn, and that turn in degrees: all at once, by spectra."""
    alike = np.fft.irfft(np.fft.rfft(b) * np.conj(np.fft.rfft(a)), SECTORS).mean(axis=0)
    return 1.0 - RINGS * alike.max() / SECTORS, 360.0 * alike.argmax() / SECTORS


def main() -> dict[str, int]:
    source, results = odomap.open(TOWN), {}
    places = source.truth.Ts_world_body[:, :3, 3]
    first, second = range(0, 740, 10), range(775, len(source), 10)  # sweeps of two rounds
    known = {k: context(source.frame(k).cloud.points) for k in first}
    for name, R, left, looks in (
        ("as it came", np.eye(3), 0.0, (0.0,)),
        ("turned by 180 deg", AROUND, 0.0, (0.0,)),
        ("3 m to the left", np.eye(3), 3.0, (0.0,)),
        ("the same, looked for beside", np.eye(3), 3.0, (-4.0, 0.0, 4.0)),
    ):
        right, best = 0, []
        for k in second:
            seen = [context(source.frame(k).cloud.points @ R - [0, left, 0], x) for x in looks]
            found = min((min(compare(a, known[j])[0] for a in seen), j) for j in first)
            apart = np.linalg.norm(places[found[1]] - places[k])
            right, best = right + (apart < 6), [*best, found[0]]
        results[name] = right
        print(f"{name:27}: {right:2} of {len(second)} right, distance {np.median(best):.2f}")
    return results


if __name__ == "__main__":
    main()
