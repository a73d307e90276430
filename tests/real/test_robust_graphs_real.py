"""Real maps with false loops: the map stays, and the false edges are named."""

import numpy as np
import pytest

from odomap.backend.graphs.solve import solve
from odomap.files.g2o import read_g2o
from odomap.geometry.align import umeyama
from odomap.simulation.loops import with_false_loops


def ate(graph, reference):
    """Return the root mean square distance after the best alignment, metres."""
    path, truth = (np.pad(g.positions, ((0, 0), (0, 3 - g.space))) for g in (graph, reference))
    return float(np.sqrt(((umeyama(path, truth) @ path - truth) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("name", "share", "bound"),
    [("intel", 0.1, 0.05), ("intel", 0.5, 0.05), ("CSAIL", 0.5, 0.05), ("sphere2500", 0.5, 0.5)],
)
def test_false_loops_are_named_and_the_map_stays(data_folder, name, share, bound):
    clean = solve(read_g2o(data_folder / "graphs" / f"{name}.g2o.gz")).graph
    added, is_false = with_false_loops(clean, round(share * clean.is_loop.sum()), seed=1)
    solution = solve(added, robust="gnc")
    named = solution.is_rejected
    assert ate(solution.graph, clean) < bound
    assert is_false[named].mean() > 0.95
    assert named[is_false].mean() > 0.95
