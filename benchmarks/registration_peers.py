"""small_gicp or Open3D on one pair of clouds, in a Python that has them.

    python registration_peers.py small_gicp|open3d PAIR.npz OUT.npz --threads 1 --repeats 5

PAIR.npz holds source, target, starts (N, 4, 4), voxel and reach. Written: seconds of the whole and
of the alignment alone, the smallest over the repeats, of each of the peer's methods, and where each
ended from the identity and from each start. Seconds are of the processor with one thread.
Down-sampling, normals and trees count as the whole; reading files does not. Needs numpy and the
peer; odomap is not imported.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

OPTIONS = argparse.ArgumentParser()
OPTIONS.add_argument("peer", choices=("small_gicp", "open3d"))
OPTIONS.add_argument("pair")
OPTIONS.add_argument("out")
OPTIONS.add_argument("--threads", type=int, default=1)
OPTIONS.add_argument("--repeats", type=int, default=5)

if __name__ == "__main__":  # before a library reads it
    CHOSEN = OPTIONS.parse_args()
    os.environ["OMP_NUM_THREADS"] = str(CHOSEN.threads)

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

Array = NDArray[np.float64]
Prepare = Callable[[], Any]
Align = Callable[[Any, Array], Array]
MOST_ITERATIONS = 100


def small_gicp_methods(pair: Any, threads: int) -> dict[str, tuple[Prepare, Align]]:
    """Return how small_gicp prepares the clouds, and aligns them from a start."""
    import small_gicp

    def prepare() -> Any:
        return [
            small_gicp.preprocess_points(pair[name], float(pair["voxel"]), num_threads=threads)
            for name in ("target", "source")
        ]

    def method(name: str) -> Align:
        def align(prepared: Any, start: Array) -> Array:
            (target, tree), (source, _) = prepared
            return np.array(
                small_gicp.align(
                    target, source, tree, start, registration_type=name,
                    max_correspondence_distance=float(pair["reach"]), num_threads=threads,
                    max_iterations=MOST_ITERATIONS,
                ).T_target_source
            )  # fmt: skip

        return align

    names = {"gicp": "GICP", "plane": "PLANE_ICP", "icp": "ICP"}
    return {ours: (prepare, method(theirs)) for ours, theirs in names.items()}


def open3d_methods(pair: Any, threads: int) -> dict[str, tuple[Prepare, Align]]:
    """Return the same for Open3D."""
    import open3d

    reg = open3d.pipelines.registration
    points = {n: open3d.utility.Vector3dVector(pair[n]) for n in ("target", "source")}

    def prepare() -> Any:
        clouds = []
        for name in ("target", "source"):
            cloud = open3d.geometry.PointCloud(points[name]).voxel_down_sample(float(pair["voxel"]))
            cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(10))
            clouds.append(cloud)
        return clouds

    limits = reg.ICPConvergenceCriteria(1e-6, 1e-6, MOST_ITERATIONS)
    reach = float(pair["reach"])

    def method(run: Any, estimation: Any) -> Align:
        def align(prepared: Any, start: Array) -> Array:
            target, source = prepared
            return np.array(run(source, target, reach, start, estimation, limits).transformation)

        return align

    return {
        "gicp": (prepare, method(
            reg.registration_generalized_icp, reg.TransformationEstimationForGeneralizedICP()
        )),
        "plane": (prepare, method(
            reg.registration_icp, reg.TransformationEstimationPointToPlane()
        )),
        "icp": (prepare, method(
            reg.registration_icp, reg.TransformationEstimationPointToPoint()
        )),
    }  # fmt: skip


def measure(
    methods: dict[str, tuple[Prepare, Align]], starts: Array, repeats: int, threads: int
) -> Any:
    """Return seconds of each method, and where it ended: from the identity, then from starts."""
    clock = time.process_time if threads == 1 else time.perf_counter
    about: dict[str, Any] = {}
    ended: dict[str, Array] = {}
    for name, (prepare, align) in methods.items():
        whole, alone = [], []
        for _ in range(repeats):
            begin = clock()
            prepared = prepare()
            middle = clock()
            first = align(prepared, np.eye(4))
            end = clock()
            whole.append(end - begin)
            alone.append(end - middle)
        about[name] = {"whole_s": min(whole), "align_s": min(alone)}
        ended[name] = np.stack([first, *(align(prepared, start) for start in starts)])
    return about, ended


def main() -> int:
    with np.load(CHOSEN.pair) as arrays:
        pair = {name: np.array(arrays[name]) for name in arrays}
    makers = {"small_gicp": small_gicp_methods, "open3d": open3d_methods}
    methods = makers[CHOSEN.peer](pair, CHOSEN.threads)
    about, ended = measure(methods, pair["starts"], CHOSEN.repeats, CHOSEN.threads)
    np.savez(CHOSEN.out, about=json.dumps(about), **ended)
    return 0


if __name__ == "__main__":
    sys.exit(main())
