"""Pose graphs as TORO text: its own order of entries, Euler angles, and what it cannot say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.errors import InputError
from odomap.files.g2o import read_g2o, write_g2o
from odomap.files.graphposes import euler_from_rotation, rotation_from_euler
from odomap.files.graphs import read_graph, read_graph_file, write_graph
from odomap.files.toro import read_toro, write_toro
from odomap.geometry.lie import se2_exp, se3_exp, so3_exp

NAMES = ("Ts_world_node", "first", "second", "Ts_first_second", "information", "ids")


def graph(group: str, nodes: int = 20, turn: float = 2.0) -> PoseGraph:
    rng = np.random.default_rng(2)
    exp, k = (se2_exp, 3) if group == "SE2" else (se3_exp, 6)
    root = rng.normal(size=(nodes - 1, k, k))
    return PoseGraph(
        group,
        exp(turn * rng.normal(size=(nodes, k))),
        np.arange(nodes - 1),
        np.arange(1, nodes),
        exp(turn * rng.normal(size=(nodes - 1, k))),
        root @ np.swapaxes(root, 1, 2),
        ids=rng.permutation(100)[:nodes],
    )


def text(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "a.graph"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("name", ["a.graph", "a.toro.gz"])
@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_there_and_back(tmp_path, group, name):
    before = graph(group)
    write_graph(tmp_path / name, before)
    once = read_toro(tmp_path / name)
    for field in NAMES:
        np.testing.assert_allclose(getattr(once, field), getattr(before, field), atol=3e-14)
    write_toro(tmp_path / f"b{name}", once)
    assert read_graph_file(tmp_path / f"b{name}").format == "toro"
    for field in NAMES:
        np.testing.assert_array_equal(
            getattr(read_graph(tmp_path / f"b{name}"), field), getattr(once, field)
        )


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_g2o_says_the_same(tmp_path, group):
    write_toro(tmp_path / "a.graph", graph(group))
    once = read_toro(tmp_path / "a.graph")
    write_g2o(tmp_path / "a.g2o", once)
    other = read_g2o(tmp_path / "a.g2o")
    for field in NAMES:
        np.testing.assert_array_equal(getattr(other, field), getattr(once, field))


def test_order_of_the_entries_in_the_plane(tmp_path):
    path = text(
        tmp_path, "VERTEX2 4 1 2 0.5", "VERTEX2 2 3 4 1", "EDGE2 4 2 1 0 0.25 11 1.2 22 33 1.3 2.3"
    )
    found = read_toro(path)
    assert found.information.tolist() == [[[11, 1.2, 1.3], [1.2, 22, 2.3], [1.3, 2.3, 33]]]
    assert found.ids.tolist() == [4, 2]
    assert (found.first.tolist(), found.second.tolist()) == ([0], [1])
    write_toro(tmp_path / "b.graph", found)
    last = (tmp_path / "b.graph").read_text().splitlines()[-1]
    assert last == "EDGE2 4 2 1.0 0.0 0.25 11.0 1.2 22.0 33.0 1.3 2.3"


def test_order_of_the_angles_in_space(tmp_path):
    upper = " ".join(["1 0 0 0 0 0", "2 0 0 0 0", "3 0 0 0", "4 0 0", "5 0", "6"])
    path = text(tmp_path, f"EDGE3 0 1 1 2 3 0.1 0.2 0.3 {upper}")
    found = read_toro(path)
    turns = [so3_exp(v) for v in ([0, 0, 0.3], [0, 0.2, 0], [0.1, 0, 0])]
    np.testing.assert_allclose(
        found.Ts_first_second[0, :3, :3], turns[0] @ turns[1] @ turns[2], atol=1e-13
    )
    np.testing.assert_array_equal(np.diag(found.information[0]), np.arange(1, 7))
    assert np.isnan(found.Ts_world_node).all()


@settings(max_examples=50, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), off=st.sampled_from([0.0, 1e-15, 1e-9, 1e-4, 1.0]))
def test_euler_angles_are_exact_also_where_pitch_is_upright(seed, off):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-np.pi, np.pi, (50, 3))
    angles[:, 1] = rng.choice([-1, 1], 50) * (np.pi / 2 - off * rng.uniform(0, 1, 50))
    R = rotation_from_euler(angles)
    np.testing.assert_allclose(rotation_from_euler(euler_from_rotation(R)), R, atol=2e-15)


def test_what_toro_cannot_say(tmp_path):
    flat = graph("SE2")
    held = replace(flat, is_fixed=np.arange(20) == 0)
    with pytest.raises(InputError, match=r"a\.graph: TORO files have no nodes that are held"):
        write_graph(tmp_path / "a.graph", held)
    with pytest.raises(InputError, match=r"no scales: write a \.g2o file"):
        write_toro(
            tmp_path / "a.graph",
            replace(
                graph("SE3"),
                group="Sim3",
                information=np.zeros((19, 7, 7)),
                priors=None,
                points=None,
            ),
        )
    assert not (tmp_path / "a.graph").exists()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE2 0 1 1 0 0 1 0 1 1 0", ":3: EDGE2 takes 2 names and 9 numbers, 10 of 11"),
        ("EDGE2 0 1 1 0 0 1 5 1 1 0 0", ":3: edge 0 (0 to 1): its information is indefinite"),
        ("EDGE2 0 7 1 0 0 1 0 1 1 0 0", ":3: pose 7 is declared nowhere"),
        ("EDGE3 0 1 1 0 0 0 0 0" + " 0" * 21, ":3: EDGE3 does not go with the VERTEX2"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", ":3: tag 'EDGE_SE2' is unknown"),
        ("", ": has no edges"),
    ],
)
def test_broken_lines(tmp_path, line, message):
    path = text(tmp_path, "VERTEX2 0 0 0 0", "VERTEX2 1 0 0 0", line)
    with pytest.raises(InputError) as error:
        read_graph(path)
    assert str(error.value).startswith(f"{path}{message}")
