"""Small pose graphs with known truth."""

import numpy as np

from odomap.backend.graphs.posegraph import PoseGraph, Sights
from odomap.geometry import lie

EXP = {"SE2": lie.se2_exp, "SE3": lie.se3_exp, "Sim3": lie.sim3_exp}
LOG = {"SE2": lie.se2_log, "SE3": lie.se3_log, "Sim3": lie.sim3_log}
INVERSE = {"SE2": lie.se2_inverse, "SE3": lie.se3_inverse, "Sim3": lie.sim3_inverse}
DIM = {"SE2": 3, "SE3": 6, "Sim3": 7}


def random_information(rng, count, k, spread=1.0):
    """Return well-conditioned, full information matrices (count, k, k)."""
    J = np.eye(k) + 0.3 * rng.normal(size=(count, k, k))
    return np.swapaxes(J, 1, 2) @ J * spread


def true_poses(group, rng, count, step=1.0):
    """Return poses (count, m, m) along a winding path that begins at the identity."""
    k = DIM[group]
    xi = 0.2 * rng.normal(size=(count, k))
    xi[:, 0] += step
    if group == "Sim3":
        xi[:, 6] *= 0.2
    Ts = [EXP[group](np.zeros(k))]
    for one in xi[1:]:
        Ts.append(Ts[-1] @ EXP[group](one))
    return np.stack(Ts)


def world(group, seed=0, count=30, loops=25, noise=0.02):
    """Return a graph whose edges measure a known path with noise, and that path.

    Args:
        group: SE2, SE3 or Sim3.
        seed: of all that is random.
        count: nodes. loops: edges beside the odometry, between random nodes.
        noise: standard deviation of each tangent component of an edge's error.
    """
    rng = np.random.default_rng(seed)
    Ts, k = true_poses(group, rng, count), DIM[group]
    first = np.concatenate([np.arange(count - 1), rng.integers(0, count - 3, loops)])
    second = np.concatenate([np.arange(1, count), np.zeros(loops, int)])
    second[count - 1 :] = [rng.integers(i + 2, count) for i in first[count - 1 :]]
    Zs = (
        INVERSE[group](Ts[first])
        @ Ts[second]
        @ EXP[group](noise * rng.normal(size=(len(first), k)))
    )
    information = np.tile(np.eye(k) / max(noise, 1e-3) ** 2, (len(first), 1, 1))
    unknown = np.full_like(Ts, np.nan)
    return PoseGraph(group, unknown, first, second, Zs, information), Ts


def with_landmarks(graph, Ts, seed=1, count=12, noise=0.02):
    """Return the graph with landmarks seen by several nodes each, and where they are."""
    rng = np.random.default_rng(seed)
    d = graph.space
    points = Ts[rng.integers(0, len(Ts), count), :d, d] + rng.normal(size=(count, d))
    node = np.concatenate([rng.choice(len(Ts), 4, replace=False) for _ in range(count)])
    point = np.repeat(np.arange(count), 4)
    inverse = INVERSE[graph.group](Ts[node])
    seen = (inverse[:, :d, :d] @ points[point, :, None])[:, :, 0] + inverse[:, :d, d]
    seen += noise * rng.normal(size=seen.shape)
    information = np.tile(np.eye(d) / max(noise, 1e-3) ** 2, (len(node), 1, 1))
    sights = Sights(
        np.full_like(points, np.nan), 1000 + np.arange(count), node, point, seen, information
    )
    return (
        PoseGraph(
            graph.group,
            graph.Ts_world_node,
            graph.first,
            graph.second,
            graph.Ts_first_second,
            graph.information,
            points=sights,
        ),
        points,
    )
