"""Sweeps of a LiDAR on a flat road between walls, ring by ring, and files made of them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HEIGHT = 1.7
HALF_WIDTH = 12.0
PERIOD = 0.1


def elevations(beams: int) -> Array:
    """Return (beams,) from the highest beam down, radians, as uneven as those of an HDL-64E."""
    upper = np.linspace(2.0, -8.5, beams // 2)
    return np.radians(np.r_[upper, np.linspace(-9.0, -24.0, beams - beams // 2)])


def road(
    beams: int = 64, columns: int = 720, seed: int = 0, lost: float = 0.02, jitter: float = 0.002
) -> tuple[Array, NDArray[np.int64]]:
    """Return a sweep, ring by ring from the highest, each from ahead to the left and around.

    Args:
        beams: rings.
        columns: points of a ring, before some are lost.
        seed: of what is lost.
        lost: share of points that do not return.
        jitter: of azimuths, radians, as sorted rows have it.

    Returns:
        (N, 3) points, and (N,) which beam each is of, 0 for the lowest.
    """
    rng = np.random.default_rng(seed)
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    rows, numbers = [], []
    for k, elevation in enumerate(elevations(beams)):
        phi = azimuth + rng.normal(0, jitter, columns)
        ray = np.stack(
            [np.cos(elevation) * np.cos(phi), np.cos(elevation) * np.sin(phi),
             np.full(columns, np.sin(elevation))], axis=1,
        )  # fmt: skip
        with np.errstate(divide="ignore"):
            to_ground = np.where(ray[:, 2] < 0, -HEIGHT / ray[:, 2], np.inf)
            to_wall = HALF_WIDTH / np.abs(ray[:, 1])
        distance = np.minimum(to_ground, to_wall)
        kept = (rng.random(columns) >= lost) & (distance < 80)
        rows.append(ray[kept] * distance[kept, None])
        numbers.append(np.full(kept.sum(), beams - 1 - k))
    return np.concatenate(rows), np.concatenate(numbers)


def turning(frame: int, beams: int = 16, columns: int = 360) -> dict[str, NDArray[np.generic]]:
    """Return a sweep in the order in which a turning LiDAR measures, with beam and time in ns."""
    points, beam = road(beams, columns, seed=frame)
    share = (-np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)) % 1
    order = np.lexsort((beam, share))
    return {
        **{name: points[order, k].astype(np.float32) for k, name in enumerate(("x", "y", "z"))},
        "intensity": np.arange(len(order)).astype(np.float32),
        "ring": beam[order].astype(np.uint16),
        "t": (share[order] * 1e8).astype(np.uint32),
    }


def write_velodyne(root: Path, frames: int = 5, beams: int = 64, columns: int = 720) -> Path:
    """Write sweeps as KITTI does, with times and truth of a car at 10 m/s."""
    (root / "velodyne").mkdir(parents=True)
    for k in range(frames):
        points, _ = road(beams, columns, seed=k)
        rows = np.c_[points, np.linspace(0, 1, len(points))].astype("<f4")
        (root / "velodyne" / f"{k:06d}.bin").write_bytes(rows.tobytes())
    times = [k * PERIOD for k in range(frames)]
    (root / "times.txt").write_text("".join(f"{t:.6f}\n" for t in times))
    poses = [f"1 0 0 {10 * t} 0 1 0 0 0 0 1 0\n" for t in times]
    (root / "poses_velodyne.txt").write_text("".join(poses))
    return root


def compensated(points: Array, speed: float = 10.0, period: float = PERIOD) -> Array:
    """Return a sweep with the motion of a car taken out, as the odometry benchmark has them."""
    times = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * period
    return points + np.outer(times, [speed, 0.0, 0.0])


def lzf(data: bytes) -> bytes:
    """Pack bytes as LZF does: three equal ones that stood before are repeated."""
    out, literal, seen, at = bytearray(), bytearray(), {}, 0

    def flush() -> None:
        for k in range(0, len(literal), 32):
            part = literal[k : k + 32]
            out.extend([len(part) - 1, *part])
        literal.clear()

    while at < len(data):
        key = data[at : at + 3]
        before = seen.get(key, -1)
        seen[key] = at
        if len(key) == 3 and before >= 0 and at - before <= 8192:
            count = 3
            while count < 264 and data[at + count : at + count + 1] == (
                data[before + count : before + count + 1] or b"?"
            ) and at + count < len(data):  # fmt: skip
                count += 1
            flush()
            back, long = at - before - 1, count - 2
            first = min(long, 7)
            out.append(first << 5 | back >> 8)
            if first == 7:
                out.append(long - 7)
            out.append(back & 255)
            at += count
        else:
            literal.append(data[at])
            at += 1
    flush()
    return bytes(out)


def pcd_bytes(columns: dict[str, NDArray[np.generic]], form: str) -> bytes:
    """Return a PCD file of a form: "ascii", "binary", "binary_compressed"."""
    count = len(next(iter(columns.values())))
    kinds = [column.dtype for column in columns.values()]
    lines = [
        "# .PCD v0.7",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(k.itemsize) for k in kinds)}",
        f"TYPE {' '.join(k.kind.upper() for k in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        f"DATA {form}",
    ]
    head = ("\n".join(lines) + "\n").encode()
    if form == "ascii":
        rows = zip(*(column.tolist() for column in columns.values()))
        return head + "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    if form == "binary":
        rows = np.empty(count, [(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            rows[name] = column
        return head + rows.tobytes()
    data = b"".join(column.tobytes() for column in columns.values())
    packed = lzf(data)
    return head + np.array([len(packed), len(data)], "<u4").tobytes() + packed
