"""The published optima of well-known graphs are reached and proven, from their edges alone."""

from pathlib import Path

import numpy as np
import pytest

from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.certificate import certify
from odomap.backend.graphs.chordal import chordal_cost
from odomap.backend.graphs.initialization import chordal
from odomap.backend.graphs.solve import solve
from odomap.files.graphs import read_graph

# Rosen et al., "SE-Sync", IJRR 2019, table 1, of those in it; of small grids the full matrix'
# eigenvalues agree.
OPTIMA = {
    "CSAIL": 31.70,
    "city10000": 638.6,
    "intel": 52.35,
    "kitti_00": 125.69,
    "manhattan": 6432.0,
    "parking-garage": 1.263,
    "smallGrid3D": 1025.0,
    "sphere2500": 1687.0,
    "sphere_bignoise_vertex3": 2961756.0,
    "tinyGrid3D": 18.52,
    "torus3D": 24230.0,
}


@pytest.mark.parametrize("name", OPTIMA)
def test_a_published_optimum_is_proven(data_folder: Path, name: str) -> None:
    graph = read_graph(data_folder / "graphs" / f"{name}.g2o.gz")
    start = chordal_cost(graph.placed(chordal(graph)))
    assert start < 1.6 * OPTIMA[name]
    best = solve(graph, cost="chordal", initial="chordal")
    certificate = certify(best.graph)
    assert certificate.cost == pytest.approx(OPTIMA[name], rel=1e-3)
    assert certificate.certified, certificate.reason
    assert certificate.smallest_eigenvalue > -1e-6 * certificate.norm
    assert certificate.suboptimality < 1e-3 * certificate.cost


def test_a_basin_that_is_not_the_best_is_not_certified(data_folder: Path) -> None:
    graph = read_graph(data_folder / "graphs" / "sphere_bignoise_vertex3.g2o.gz")
    given = solve(graph, cost="chordal", initial="given", config=SolverConfig(iterations=8))
    certificate = certify(given.graph)
    assert not certificate.certified
    assert certificate.smallest_eigenvalue < -1e-3 * certificate.norm
    best = certify(solve(graph, cost="chordal", initial="chordal").graph)
    assert best.certified, best.reason
    assert best.cost < 0.9 * certificate.cost
    assert certificate.lower_bound <= best.cost


def test_the_geodesic_optimum_is_no_minimum_of_the_chordal_cost(data_folder: Path) -> None:
    graph = read_graph(data_folder / "graphs" / "CSAIL.g2o.gz")
    certificate = certify(solve(graph).graph)
    assert not certificate.certified
    assert "no minimum of the chordal cost" in certificate.reason
    assert np.isfinite(certificate.smallest_eigenvalue)
