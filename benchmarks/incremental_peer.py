"""GTSAM's iSAM2 on one pose graph, node by node, in a process of its own.

    python incremental_peer.py PROBLEM.npz OUT.json [--factorization CHOLESKY|QR] [--most N]

The same steps and the same clock as odomap's: each node with its edges to older ones, `update`, and
the newest pose asked for; the parameters are the library's own. Needs gtsam and numpy, no odomap.
"""

import argparse
import json
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gtsam
import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("problem")
    parser.add_argument("out", type=Path)
    parser.add_argument("--factorization", default="CHOLESKY")
    parser.add_argument("--most", type=int)
    options = parser.parse_args()
    with np.load(options.problem) as arrays:
        problem = dict(arrays)
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization(options.factorization)
    result = replay(problem, gtsam.ISAM2(parameters), options.most)
    options.out.write_text(json.dumps(result), encoding="utf-8")


def replay(problem: dict[str, np.ndarray], isam: "gtsam.ISAM2", most: int | None) -> dict:
    """Return milliseconds of each step, and the last cost or why it ended early."""
    planar = problem["poses"].shape[1] == 3
    between = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
    prior = gtsam.PriorFactorPose2 if planar else gtsam.PriorFactorPose3
    estimate = isam.calculateEstimatePose2 if planar else isam.calculateEstimatePose3
    order = [0, 1, 2] if planar else [3, 4, 5, 0, 1, 2]
    first, second = problem["first"], problem["second"]
    later = np.maximum(first, second)
    by_node = np.argsort(later, kind="stable")
    ends = np.searchsorted(later[by_node], np.arange(len(problem["poses"])), side="right")
    every, ms, failed, begin = gtsam.NonlinearFactorGraph(), [], "", 0
    for node, end in enumerate(ends[:most].tolist()):
        edges, begin = by_node[begin:end].tolist(), end
        start = time.process_time()
        new, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if node == 0:
            origin = _pose(np.eye(3 if planar else 4))
            sigma = gtsam.noiseModel.Isotropic.Sigma(len(order), 1e-6)
            new.add(prior(0, origin, sigma))
            values.insert(0, origin)
        for e in edges:
            i, j, measured = int(first[e]), int(second[e]), _pose(problem["measured"][e])
            information = np.ascontiguousarray(problem["information"][e][np.ix_(order, order)])
            factor = between(i, j, measured, gtsam.noiseModel.Gaussian.Information(information))
            new.add(factor)
            every.add(factor)
            if not values.exists(node):
                step = measured if j == node else measured.inverse()
                values.insert(node, estimate(i if j == node else j).compose(step))
        try:
            isam.update(new, values)
            estimate(node)
        except RuntimeError as error:
            failed = f"node {node}: {str(error).split('.')[0].strip()}"
            break
        ms.append(1e3 * (time.process_time() - start))
    cost = None if failed else every.error(isam.calculateEstimate())
    return {"ms": ms, "cost": cost, "failed": failed}


def _pose(T: np.ndarray) -> "gtsam.Pose2 | gtsam.Pose3":
    if len(T) == 3:
        return gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0]))
    return gtsam.Pose3(T)


if __name__ == "__main__":
    main()
