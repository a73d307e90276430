"""False loops for pose graphs: edges that two places which look alike might give.

Places recognised wrongly tie a map together where it does not belong; how many of them a solver
bears is measured by adding them to a graph whose solution is known. A false loop joins two nodes at
random, and measures the motion between two poses drawn at random from the box of the map, turned
anyhow; it claims the information of a true loop, drawn at random, too. So nothing about it is
suspicious by itself.

Reference: N. Sünderhauf, P. Protzel, "Switchable constraints for robust pose graph SLAM", IROS
2012.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.errors import InputError
from odomap.geometry.lie import (
    rotation_from_quaternion,
    se2_inverse,
    se3_inverse,
    sim3_inverse,
    so2_exp,
)

__all__ = ["with_false_loops"]

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.int64]


def with_false_loops(graph: PoseGraph, count: int, seed: int) -> tuple[PoseGraph, Bool]:
    """Return a graph with false loops after its own edges, and which edges are false.

    Args:
        graph: with known poses, which say how large the map is, and with loop edges.
        count: false loops to add.
        seed: of all that is random.

    Returns:
        The graph, and (E + count,) bool.

    Raises:
        InputError: poses are not known, or there are no loops whose information to claim.
    """
    loops = np.flatnonzero(graph.is_loop)
    if not (np.isfinite(graph.Ts_world_node).all() and len(loops)):
        raise InputError("false loops: give a graph with loops, at its solution")
    rng = np.random.default_rng(seed)
    first, second = _pairs(graph, rng, count)
    inverse = {"SE2": se2_inverse, "SE3": se3_inverse, "Sim3": sim3_inverse}[graph.group]
    measured = inverse(_poses(graph, rng, count)) @ _poses(graph, rng, count)
    claimed = graph.information[rng.choice(loops, count)]
    added = replace(
        graph,
        first=np.concatenate([graph.first, first]),
        second=np.concatenate([graph.second, second]),
        Ts_first_second=np.concatenate([graph.Ts_first_second, measured]),
        information=np.concatenate([graph.information, claimed]),
    )
    return added, np.arange(added.num_edges) >= graph.num_edges


def _pairs(graph: PoseGraph, rng: np.random.Generator, count: int) -> Index:
    """Return nodes (2, count) that do not follow each other."""
    if count and len(graph.ids) < 3:
        raise InputError("false loops: a graph of fewer than 3 nodes has no room for any")
    pairs = np.zeros((2, 0), np.int64)
    while pairs.shape[1] < count:
        drawn = rng.integers(0, graph.num_nodes, (2, 2 * count))
        apart = np.abs(graph.ids[drawn[0]] - graph.ids[drawn[1]]) > 1
        pairs = np.concatenate([pairs, drawn[:, apart]], axis=1)
    return pairs[:, :count]


def _poses(graph: PoseGraph, rng: np.random.Generator, count: int) -> Array:
    """Return poses (count, m, m) anywhere in the box of the map, turned anyhow."""
    d, at = graph.space, graph.positions
    Ts = np.zeros((count, d + 1, d + 1))
    if d == 2:
        Ts[:, :2, :2] = so2_exp(rng.uniform(-np.pi, np.pi, count))
    else:
        q = rng.normal(size=(count, 4))
        Ts[:, :3, :3] = rotation_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))
    Ts[:, :d, d] = rng.uniform(at.min(axis=0), at.max(axis=0), (count, d))
    Ts[:, d, d] = 1.0
    return Ts
