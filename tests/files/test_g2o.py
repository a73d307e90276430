"""Pose graphs survive the way through g2o text, and a broken line is named by its number."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.backend.graphs.posegraph import GROUPS, PoseGraph, Priors, Sights
from odomap.errors import InputError
from odomap.files.g2o import read_g2o, write_g2o
from odomap.files.graphposes import numbers_from_poses, poses_from_numbers
from odomap.files.graphs import read_graph, read_graph_file, write_graph
from odomap.geometry.lie import (
    se2_exp,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    sim3_exp,
    so2_exp,
)

EXP = {"SE2": se2_exp, "SE3": se3_exp, "Sim3": sim3_exp}
TOLERANCE = {"SE2": 3e-14, "SE3": 3e-14, "Sim3": 2e-12}
I2, I3 = "500 0 0 500 0 5000", "10 0 0 0 0 0 10 0 0 0 0 10 0 0 0 4 0 0 4 0 4"


def spd(rng: np.random.Generator, count: int, k: int) -> np.ndarray:
    root = rng.normal(size=(count, k, k))
    information = root @ np.swapaxes(root, 1, 2) + np.eye(k)
    return 0.5 * (information + np.swapaxes(information, 1, 2))


def world(group: str, seed: int = 0, nodes: int = 12) -> PoseGraph:
    """Return a graph with everything that a file can say."""
    rng = np.random.default_rng(seed)
    k, d = GROUPS[group].dim, GROUPS[group].space
    exp = EXP[group]
    first = np.concatenate([np.arange(nodes - 1), rng.integers(0, nodes - 5, 6)])
    second = np.concatenate([np.arange(1, nodes), first[-6:] + 3])
    sights = Sights(
        rng.normal(size=(4, d)),
        np.array([900, 3000, 901, -7]),
        rng.integers(0, nodes, 9),
        rng.integers(0, 4, 9),
        rng.normal(size=(9, d)),
        spd(rng, 9, d),
    )
    held = np.zeros(nodes, bool)
    held[[0, 5]] = True
    return PoseGraph(
        group,
        exp(2.0 * rng.normal(size=(nodes, k))),
        first,
        second,
        exp(rng.normal(size=(len(first), k))),
        spd(rng, len(first), k),
        rng.permutation(500)[:nodes],
        held,
        Priors(np.array([2, 2]), exp(rng.normal(size=(2, k))), spd(rng, 2, k)),
        sights,
    )


def arrays(graph: PoseGraph) -> dict[str, np.ndarray]:
    names = "Ts_world_node first second Ts_first_second information ids is_fixed"
    found = {name: getattr(graph, name) for name in names.split()}
    for part in (graph.priors, graph.points):
        found |= {f"{type(part).__name__}.{name}": value for name, value in vars(part).items()}
    return found


def assert_same(a: PoseGraph, b: PoseGraph, tolerance: float = 0.0) -> None:
    assert a.group == b.group
    other = arrays(b)
    for name, value in arrays(a).items():
        assert value.dtype == other[name].dtype, name
        if tolerance:
            np.testing.assert_allclose(
                value, other[name], atol=tolerance, rtol=tolerance, err_msg=name
            )
        else:
            np.testing.assert_array_equal(value, other[name], err_msg=name)


def text(tmp_path: Path, *lines: str, name: str = "a.g2o") -> Path:
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n")
    return path


# ---- there and back ----


@pytest.mark.parametrize("name", ["a.g2o", "a.g2o.gz"])
@pytest.mark.parametrize("group", list(GROUPS))
def test_there_and_back(tmp_path, group, name):
    before = world(group)
    write_g2o(tmp_path / name, before)
    once = read_g2o(tmp_path / name)
    assert_same(before, once, TOLERANCE[group])
    write_g2o(tmp_path / f"again_{name}", once)
    assert_same(once, read_g2o(tmp_path / f"again_{name}"))
    assert (tmp_path / name).read_bytes() == (tmp_path / f"again_{name}").read_bytes()
    assert read_graph_file(tmp_path / name).format == "g2o"


@pytest.mark.parametrize("group", list(GROUPS))
@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), size=st.sampled_from([0.0, 1e-12, 1e-7, 1e-3, 1.0, 30.0]))
def test_poses_fall_on_their_grid(group, seed, size):
    rng = np.random.default_rng(seed)
    Ts = EXP[group](size * rng.normal(size=(200, GROUPS[group].dim)) / (1 + (group == "Sim3")))
    once = poses_from_numbers(numbers_from_poses(Ts, group), group)
    scale = np.abs(Ts).max() if group == "Sim3" else 1.0
    np.testing.assert_allclose(once, Ts, atol=TOLERANCE[group] * scale)
    np.testing.assert_array_equal(poses_from_numbers(numbers_from_poses(once, group), group), once)


@pytest.mark.parametrize("angle", [0.0, np.pi, -np.pi, np.pi / 2, 3.1415926535897, 17.0, -1e-15])
def test_angles_at_the_ends_of_the_circle(angle):
    once = poses_from_numbers(np.array([[1.0, 2.0, angle]]), "SE2")
    np.testing.assert_allclose(once[0, :2, :2], so2_exp(angle), atol=5e-14)
    twice = poses_from_numbers(numbers_from_poses(once, "SE2"), "SE2")
    np.testing.assert_array_equal(twice, once)


def test_half_turns_keep_their_axis():
    turns = np.eye(4)[:, [1, 2, 3, 0]]
    halves = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, -1], [1, -1, 1, -1]]) / 1.7
    q = np.vstack([turns, halves, -halves])
    numbers = np.column_stack([np.zeros((len(q), 3)), q])
    once = poses_from_numbers(numbers, "SE3")
    np.testing.assert_array_equal(poses_from_numbers(numbers_from_poses(once, "SE3"), "SE3"), once)
    np.testing.assert_array_equal(once[8:], once[4:8])  # q and -q are one rotation


def test_order_of_names_numbers_and_entries(tmp_path):
    upper = [9, 0.1, 0.2, 0.3, 0.4, 0.5, 8, 0.6, 0.7, 0.8, 0.9, 7, 1, 1.1, 1.2, 6, 1.3, 1.4, 5]
    upper += [1.5, 4]
    path = text(
        tmp_path,
        "# a comment",
        "EDGE_SE3:QUAT 7 3 1 2 3 0 0 3 3 " + " ".join(map(str, upper)),
        "",
        "VERTEX_SE3:QUAT 7 0 0 0 0 0 0.7071067811865476 0.7071067811865476  # to the left",
        "VERTEX_SE3:QUAT 3 4 5 6 0 0 0 -1\r",
        "FIX 3",
    )
    graph = read_g2o(path)
    assert graph.ids.tolist() == [7, 3]
    assert (graph.first.tolist(), graph.second.tolist()) == ([0], [1])
    assert graph.is_fixed.tolist() == [False, True]
    left = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(graph.Ts_world_node[0, :3, :3], left, atol=1e-14)
    np.testing.assert_allclose(graph.Ts_first_second[0, :3, :3], left, atol=1e-14)
    np.testing.assert_array_equal(graph.Ts_first_second[0, :3, 3], [1, 2, 3])
    np.testing.assert_array_equal(graph.Ts_world_node[1, :3, :3], np.eye(3))
    assert graph.positions.tolist() == [[0, 0, 0], [4, 5, 6]]
    np.testing.assert_array_equal(graph.information[0][np.triu_indices(6)], upper)
    np.testing.assert_array_equal(graph.information[0], graph.information[0].T)


def test_plane_with_landmarks(tmp_path):
    path = text(
        tmp_path,
        "VERTEX_XY 50 3 4",
        "VERTEX_SE2 1 0 0 0.5",
        "VERTEX_SE2 2 1 0 -0.5",
        f"EDGE_SE2 1 2 1 0.25 -1 {I2}",
        "EDGE_SE2_XY 2 50 0.5 0.25 9 1 4",
        f"EDGE_PRIOR_SE2 1 0.125 0 0.5 {I2}",
    )
    graph = read_g2o(path)
    assert graph.points.ids.tolist() == [50]
    assert (graph.points.node.tolist(), graph.points.point.tolist()) == ([1], [0])
    assert graph.points.information.tolist() == [[[9, 1], [1, 4]]]
    assert graph.priors.node.tolist() == [0]
    assert graph.priors.Ts_world_node[0, :2, 2].tolist() == [0.125, 0]
    # numbers keep their text: 0.5 stays 0.5
    write_g2o(tmp_path / "b.g2o", graph)
    assert (
        "EDGE_SE2 1 2 1.0 0.25 -1.0 500.0 0.0 0.0 500.0 0.0 5000.0\n"
        in (tmp_path / "b.g2o").read_text()
    )


def test_sensors_beside_a_pose(tmp_path):
    """A prior and a sight of a mounted sensor have the cost that the sensor would give."""
    rng = np.random.default_rng(4)
    P, T, Z = se3_exp(rng.normal(size=(3, 6)))
    information, sight_information = spd(rng, 1, 6)[0], spd(rng, 1, 3)[0]
    point, seen = rng.normal(size=(2, 3))

    def words(values: np.ndarray) -> str:
        return " ".join(map(repr, np.ravel(values).tolist()))

    pose = [words(numbers_from_poses(X[None], "SE3")) for X in (P, T, Z)]
    path = text(
        tmp_path,
        f"PARAMS_SE3OFFSET 5 {pose[0]}",
        "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1",
        f"VERTEX_SE3:QUAT 0 {pose[1]}",
        "VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1",
        f"VERTEX_TRACKXYZ 2 {words(point)}",
        f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {I3}",
        f"EDGE_SE3_PRIOR 0 5 {pose[2]} {words(information[np.triu_indices(6)])}",
        f"EDGE_SE3_PRIOR 0 0 {pose[2]} {words(information[np.triu_indices(6)])}",
        f"EDGE_SE3_TRACKXYZ 0 2 5 {words(seen)} {words(sight_information[np.triu_indices(3)])}",
    )
    graph = read_g2o(path)
    error = se3_log(se3_inverse(Z) @ T @ P)
    mine = se3_log(se3_inverse(graph.priors.Ts_world_node[0]) @ T)
    np.testing.assert_allclose(
        mine @ graph.priors.information[0] @ mine, error @ information @ error, rtol=1e-10
    )
    np.testing.assert_allclose(se3_adjoint(se3_inverse(P)) @ mine, error, atol=1e-10)
    np.testing.assert_array_equal(graph.priors.information[1], information)
    world_to_sensor = se3_inverse(T @ P)
    error = world_to_sensor[:3, :3] @ point + world_to_sensor[:3, 3] - seen
    world_to_node = se3_inverse(T)
    mine = world_to_node[:3, :3] @ point + world_to_node[:3, 3] - graph.points.points_node[0]
    np.testing.assert_allclose(
        mine @ graph.points.information[0] @ mine, error @ sight_information @ error, rtol=1e-10
    )
    write_g2o(tmp_path / "b.g2o", graph)
    assert_same(graph, read_g2o(tmp_path / "b.g2o"))


# ---- what a file leaves out ----


def test_edges_alone_name_the_nodes(tmp_path):
    path = text(tmp_path, f"EDGE_SE2 9 4 1 0 0 {I2}", f"EDGE_SE2 4 6 1 0 0 {I2}")
    graph = read_g2o(path)
    assert graph.ids.tolist() == [4, 6, 9]
    assert (graph.first.tolist(), graph.second.tolist()) == ([2, 0], [0, 1])
    assert np.isnan(graph.Ts_world_node).all()
    write_g2o(tmp_path / "b.g2o", graph)
    assert "VERTEX" not in (tmp_path / "b.g2o").read_text()
    assert_same(graph, read_g2o(tmp_path / "b.g2o"))


def test_landmarks_may_be_unknown(tmp_path):
    path = text(
        tmp_path,
        "VERTEX_SE2 0 0 0 0",
        "VERTEX_SE2 1 1 0 0",
        f"EDGE_SE2 0 1 1 0 0 {I2}",
        "EDGE_SE2_XY 0 8 1 1 1 0 1",
    )
    graph = read_g2o(path)
    assert np.isnan(graph.points.points_world).all()
    write_g2o(tmp_path / "b.g2o", graph)
    assert_same(graph, read_g2o(tmp_path / "b.g2o"))


def test_unknown_tags_can_be_skipped(tmp_path):
    path = text(
        tmp_path,
        f"EDGE_SE2 0 1 1 0 0 {I2}",
        "EDGE_BEARING_SE2_XY 0 3 0.1 5",
        "EDGE_BEARING_SE2_XY 1 3 0.2 5",
    )
    with pytest.raises(InputError, match=r"a\.g2o:2: tag 'EDGE_BEARING_SE2_XY' is unknown"):
        read_g2o(path)
    assert read_g2o(path, skip_unknown=True).num_edges == 1
    assert read_graph_file(path, skip_unknown=True).skipped == {"EDGE_BEARING_SE2_XY": 2}


# ---- broken files ----

START = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", f"EDGE_SE2 0 1 1 0 0 {I2}"]
SPACE = [
    "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1",
    "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1",
    f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {I3}",
]


@pytest.mark.parametrize(
    ("start", "line", "message"),
    [
        (START, "EDGE_SE2 0 1 1 0 0 500 0 0 500 0", ":4: EDGE_SE2 takes 2 names and 9 numbers, 10"),
        (START, f"EDGE_SE2 0 1 1 0 0 {I2} 7", ":4: EDGE_SE2 takes 2 names and 9 numbers, 12 of 11"),
        (START, f"EDGE_SE2 0 1 1 zero 0 {I2}", ":4: EDGE_SE2: 'zero' is not a number"),
        (START, f"EDGE_SE2 0 1 1 1_0 0 {I2}", ":4: EDGE_SE2: '1_0' is not a number"),
        (START, f"EDGE_SE2 0 1.5 1 0 0 {I2}", ":4: EDGE_SE2: '1.5' is not a whole number"),
        (START, f"EDGE_SE2 0 {10**30} 1 0 0 {I2}", "is too large for the name of a vertex"),
        (START, f"EDGE_SE2 0 1 nan 0 0 {I2}", ":4: EDGE_SE2: 'nan' is not finite"),
        (START, "EDGE_SE2 0 1 1 0 0 500 0 0 inf 0 5000", ":4: EDGE_SE2: 'inf' is not finite"),
        (START, f"EDGE_SE2 0 5 1 0 0 {I2}", ":4: pose 5 is declared nowhere"),
        (START, "FIX 5", ":4: pose 5 is declared nowhere"),
        (START, "FIX x", ":4: FIX: 'x' is not a whole number"),
        (START, "VERTEX_SE2 1 9 9 9", ":4: vertex 1 is there twice, first in line 2"),
        (START, "VERTEX_XY 1 9 9", ":4: vertex 1 is there twice, first in line 2"),
        (START, f"EDGE_SE2 1 1 1 0 0 {I2}", ":4: edge 1 (1 to 1): a node cannot be tied to itself"),
        (START, "EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1", ":4: edge 1 (0 to 1): its information is indef"),
        (START, "EDGE_PRIOR_SE2 0 1 0 0 1 5 0 1 0 1", ":4: prior 0: its information is indefinite"),
        (START, "EDGE_SE2_XY 0 1 1 0 1 0 1", ":4: vertex 1 is a pose and a landmark at once"),
        (
            START,
            SPACE[0].replace(" 0", " 9", 1),
            ":4: VERTEX_SE3:QUAT does not go with the EDGE_SE2",
        ),
        (START, "49 7776 31843", ":4: a line begins with a tag, not 49: is it a BAL problem"),
        (START, "EDGE_SE22 0 1", ":4: tag 'EDGE_SE22' is unknown (did you mean 'EDGE_SE2'?)"),
        (SPACE, f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 0 {I3}", ":4: a quaternion of zeros"),
        (SPACE, "VERTEX_SE3:QUAT 2 1 0 0 0 0 0 0", ":4: a quaternion of zeros"),
        (SPACE, "VERTEX_SIM3:QUAT 2 1 0 0 0 0 0 1 2", ":4: VERTEX_SIM3:QUAT does not go with"),
        (SPACE, "VERTEX_XY 2 1 0", ":4: VERTEX_XY does not go with"),
    ],
)
def test_broken_lines(tmp_path, start, line, message):
    path = text(tmp_path, *start, line)
    with pytest.raises(InputError) as error:
        read_g2o(path)
    assert message in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_broken_offsets(tmp_path):
    edge = f"EDGE_SE3_PRIOR 0 4 1 0 0 0 0 0 1 {I3}"
    offset = "PARAMS_SE3OFFSET 3 0 0 1 0 0 0 1"
    with pytest.raises(InputError, match=r":5: offset 4 is declared nowhere"):
        read_g2o(text(tmp_path, *SPACE, offset, edge))
    with pytest.raises(InputError, match=r":5: offset 3 is there twice"):
        read_g2o(text(tmp_path, *SPACE, offset, offset, edge))
    with pytest.raises(InputError, match=r":4: a quaternion of zeros"):
        read_g2o(text(tmp_path, *SPACE, "PARAMS_SE3OFFSET 3 0 0 1 0 0 0 0", edge))


@pytest.mark.parametrize("scale", ["0", "-1", "1e-320", "1e300"])
def test_scales_are_positive_and_not_absurd(tmp_path, scale):
    start = ["VERTEX_SIM3:QUAT 0 0 0 0 0 0 0 1 2", f"VERTEX_SIM3:QUAT 1 0 0 0 0 0 0 1 {scale}"]
    edge = "EDGE_SIM3:QUAT 0 1 0 0 0 0 0 0 1 1 " + " ".join(["0"] * 28)
    with pytest.raises(InputError, match=r":2: a scale that cannot be"):
        read_g2o(text(tmp_path, *start, edge))


def test_no_edges_no_text_no_file(tmp_path):
    with pytest.raises(InputError, match=r"a\.g2o: has no edges"):
        read_g2o(text(tmp_path, ""))
    with pytest.raises(InputError, match=r"a\.g2o: has no edges"):
        read_graph(text(tmp_path, *START[:2]))
    with pytest.raises(InputError, match=r"is held, but|FIX 0: its pose is not in the file"):
        read_g2o(text(tmp_path, START[2], "FIX 0"))
    with pytest.raises(InputError, match="No such file"):
        read_g2o(tmp_path / "none.g2o")
    with pytest.raises(InputError, match="directory"):
        read_g2o(tmp_path)
    (tmp_path / "b.g2o").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"b\.g2o: is not text"):
        read_g2o(tmp_path / "b.g2o")
    (tmp_path / "c.g2o").write_bytes(b"\xff\xd8\xe0 1 2\n")
    with pytest.raises(InputError, match=r"c\.g2o:1: is not text"):
        read_g2o(tmp_path / "c.g2o")
    (tmp_path / "d.g2o.gz").write_bytes(gzip.compress("\n".join(START).encode())[:-9])
    with pytest.raises(InputError, match=r"d\.g2o\.gz: broken gzip"):
        read_g2o(tmp_path / "d.g2o.gz")


def test_what_no_file_could_say_is_not_written(tmp_path):
    graph = read_g2o(text(tmp_path, *START))
    Ts = graph.Ts_world_node.copy()
    Ts[1] = np.nan
    with pytest.raises(InputError, match="the pose of vertex 1 is not known: solve first"):
        write_g2o(tmp_path / "b.g2o", graph.placed(Ts))
    point = Sights([[1.0, 2.0]], [4], [0], [0], [[1.0, 2.0]], [np.eye(2)])
    tied = ([0], [1], Ts[:1], [np.eye(3)])
    twice = PoseGraph("SE2", Ts[[0, 0]], *tied, ids=[4, 5], points=point)
    with pytest.raises(InputError, match="two vertices have the name 4"):
        write_g2o(tmp_path / "b.g2o", twice)
    alone = PoseGraph("SE2", np.full((3, 3, 3), np.nan), [0], [1], Ts[:1], [np.eye(3)])
    with pytest.raises(InputError, match="the pose of vertex 2 is not known"):
        write_graph(tmp_path / "b.g2o", alone)
    assert not (tmp_path / "b.g2o").exists()


@pytest.mark.parametrize("group", ["SE2", "SE3", "Sim3"])
def test_priors_alone_are_a_graph(group, tmp_path):
    whole = world(group)
    d, index = GROUPS[group].space, np.zeros(0, np.int64)
    none = Sights(np.zeros((0, d)), index, index, index, np.zeros((0, d)), np.zeros((0, d, d)))
    alone = replace(whole.without(np.ones(whole.num_edges, bool)), points=none)
    write_g2o(tmp_path / "a.g2o", alone)
    found = read_g2o(tmp_path / "a.g2o")
    assert (found.num_edges, found.num_nodes) == (0, whole.num_nodes)
    np.testing.assert_array_equal(found.priors.node, whole.priors.node)
    np.testing.assert_allclose(found.priors.information, whole.priors.information, rtol=1e-12)


def test_a_message_names_its_file_once(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text(f"EDGE_SE2 0 1 1 0 0 {I2}\nFIX 0\n")
    with pytest.raises(InputError, match="FIX 0: its pose is not in the file") as error:
        read_g2o(path)
    assert str(error.value).startswith(f"{path}:2: FIX 0: ")
    assert str(error.value).count("a.g2o") == 1
