"""KISS-ICP on sweeps that come through a pipe, in a Python that has it.

    ... | python lidar3d_peer.py OUT.npz [--deskew] [--voxel 1.0] [--farthest 100]

On standard input one sweep after the other: the number of its points as int64, then of each as
float64 x, y, z, and when in the sweep it was measured, seconds. Written: poses (M, 4, 4) and of
each sweep the milliseconds that passed and those of processors (M, 2). With --deskew KISS-ICP takes
out the motion that it found for the sweep before; its poses are then those at the end of a sweep.
Needs numpy and kiss_icp; odomap is not imported.
"""

import argparse
import sys
import time

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out")
    parser.add_argument("--deskew", action="store_true")
    parser.add_argument("--voxel", type=float, default=1.0)
    parser.add_argument("--farthest", type=float, default=100.0)
    options = parser.parse_args()
    config = KISSConfig()
    config.data.deskew = options.deskew
    config.data.max_range = options.farthest
    config.mapping.voxel_size = options.voxel
    odometry = KissICP(config)
    poses, ms = [], []
    while (rows := next_sweep()) is not None:
        points = np.ascontiguousarray(rows[:, :3], np.float64)
        times = np.array(rows[:, 3], np.float64) if options.deskew else np.array([])
        start = time.perf_counter(), time.process_time()
        odometry.register_frame(points, times)
        end = time.perf_counter(), time.process_time()
        ms.append([1e3 * (after - before) for before, after in zip(start, end)])
        poses.append(np.array(odometry.last_pose))
    np.savez(options.out, Ts=np.array(poses), ms=np.array(ms))
    return 0


def next_sweep() -> np.ndarray | None:
    """Return the next sweep (N, 4) of standard input, None where it ends."""
    stream = sys.stdin.buffer
    count = stream.read(8)
    if not count:
        return None
    data = stream.read(32 * int(np.frombuffer(count, np.int64)[0]))
    return np.frombuffer(data, np.float64).reshape(-1, 4)


if __name__ == "__main__":
    sys.exit(main())
