"""Beginnings of well-known graphs, node by node: within one per cent of solving all of it."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from odomap.backend.graphs.incremental import IncrementalPoseGraph
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.solve import solve
from odomap.files.graphs import read_graph


@pytest.mark.parametrize(
    ("name", "nodes", "every"),
    [("manhattan", 500, 100), ("city10000", 700, 100), ("sphere2500", 200, 50)],
)
def test_growing_is_as_good_as_solving(
    data_folder: Path, name: str, nodes: int, every: int
) -> None:
    whole = read_graph(data_folder / "graphs" / f"{name}.g2o.gz")
    graph = IncrementalPoseGraph(whole.group)
    wholes, ratios = 0, []
    for node, edges in enumerate(edges_by_node(whole)[:nodes]):
        graph.add_node(node=int(whole.ids[node]))
        for e in edges:
            i, j = whole.ids[whole.first[e]], whole.ids[whole.second[e]]
            graph.add_edge(int(i), int(j), whole.Ts_first_second[e], whole.information[e])
        wholes += graph.update().scope == "whole"
        if (node + 1) % every == 0:
            now = graph.graph()
            least = min(solve(now, initial=how).cost_after for how in ("auto", "given"))
            ratios.append((graph.cost + 1e-9) / (least + 1e-9))
    assert max(ratios) < 1.01
    assert wholes < nodes / 3


def edges_by_node(graph: PoseGraph) -> list[list[int]]:
    """Return the edges of each node to older ones."""
    later = np.maximum(graph.first, graph.second)
    order = np.argsort(later, kind="stable")
    ends = np.searchsorted(later[order], np.arange(graph.num_nodes + 1))
    return [order[a:b].tolist() for a, b in itertools.pairwise(ends)]
