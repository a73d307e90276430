"""The shared pose graphs and the bundle problem are read, and written without loss."""

from pathlib import Path

import numpy as np
import pytest

from odomap.files.bal import read_bal, write_bal
from odomap.files.g2o import write_g2o
from odomap.files.graphs import read_graph, read_graph_file

GRAPHS = {
    "CSAIL": ("SE2", 1045, 1172),
    "city10000": ("SE2", 10000, 20687),
    "intel": ("SE2", 1728, 2512),
    "kitti_00": ("SE2", 4541, 4677),
    "manhattan": ("SE2", 3500, 5453),
    "parking-garage": ("SE3", 1661, 6275),
    "smallGrid3D": ("SE3", 125, 297),
    "sphere2500": ("SE3", 2500, 4949),
    "sphere_bignoise_vertex3": ("SE3", 2200, 8647),
    "tinyGrid3D": ("SE3", 9, 11),
    "torus3D": ("SE3", 5000, 9048),
}
EDGES_ONLY = {"CSAIL", "kitti_00", "manhattan"}


@pytest.mark.parametrize("name", GRAPHS)
def test_a_graph_there_and_back(data_folder: Path, tmp_path: Path, name: str) -> None:
    file = read_graph_file(data_folder / "graphs" / f"{name}.g2o.gz")
    graph = file.graph
    assert (graph.group, graph.num_nodes, graph.num_edges) == GRAPHS[name]
    assert (file.format, file.skipped) == ("g2o", {})
    assert np.isnan(graph.Ts_world_node).all() == (name in EDGES_ONLY)
    assert graph.is_loop.any()
    write_g2o(tmp_path / "a.g2o", graph)
    again = read_graph(tmp_path / "a.g2o")
    for field in ("Ts_world_node", "first", "second", "Ts_first_second", "information", "ids"):
        np.testing.assert_array_equal(getattr(again, field), getattr(graph, field))


def test_a_bundle_problem_there_and_back(data_folder: Path, tmp_path: Path) -> None:
    problem = read_bal(data_folder / "bundle" / "problem-49-7776-pre.txt.gz")
    assert (problem.num_views, problem.num_points, problem.num_observations) == (49, 7776, 31843)
    view, lenses = problem.view, problem.intrinsics
    Ts = problem.Ts_camera_world[view]
    P = np.einsum("nij,nj->ni", Ts[:, :3, :3], problem.points_world[problem.point]) + Ts[:, :3, 3]
    q = -P[:, :2] / P[:, 2:]
    f, k1, k2 = lenses[problem.lens[view]].T
    r2 = np.sum(q * q, axis=1)
    errors = (f * (1 + k1 * r2 + k2 * r2**2))[:, None] * q - problem.pixels
    assert 0.5 * np.sum(errors**2) == pytest.approx(850_912.46, abs=0.01)
    write_bal(tmp_path / "a.txt", problem)
    again = read_bal(tmp_path / "a.txt")
    for name in ("Ts_camera_world", "points_world", "view", "point", "pixels", "intrinsics"):
        np.testing.assert_array_equal(getattr(again, name), getattr(problem, name))
