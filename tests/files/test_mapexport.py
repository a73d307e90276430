"""What other programs get of a map, and what the command line says about one."""

import json

import numpy as np
import pytest

from maps.test_map_properties import random_pose
from mapworlds import rich_map
from odomap.cli import main
from odomap.errors import InputError
from odomap.files.clouds import read_ply
from odomap.files.g2o import read_g2o
from odomap.files.mapexport import keyframe_trajectory, map_graph, write_map_parts
from odomap.files.mapfile import VERSION, save_map
from odomap.files.trajectories import read_tum
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map


def chain(scale=1.0):
    """Five keyframes placed one against the other, with one measured edge and one landmark each."""
    rng = np.random.default_rng(0)
    m = Map()
    for n in range(5):
        m.add_keyframe(Keyframe(m.new_keyframe_id(), 1000 * n), random_pose(rng), scale=scale**n)
        m.add_landmarks(n, rng.normal(size=(1, 3)))
    T = np.linalg.inv(m.T_world_body(1)) @ m.T_world_body(2)
    m.add_edge(1, 2, T, 7 * np.eye(6), "odometry")
    return m


def test_landmarks_keyframes_and_edges_are_what_the_map_says(tmp_path):
    m = chain()
    said = write_map_parts(m, tmp_path / "p.ply", tmp_path / "k.tum", tmp_path / "g.g2o")
    assert [line.split(": ")[1] for line in said] == [
        "5 landmarks",
        "5 keyframes",
        "5 poses (SE3), 4 edges, 3 of them from the poses",
    ]
    cloud, path, graph = (
        read_ply(tmp_path / "p.ply"),
        read_tum(tmp_path / "k.tum"),
        read_g2o(tmp_path / "g.g2o"),
    )
    np.testing.assert_allclose(cloud.points, m.points_world(m.landmark_ids), rtol=1e-6)
    assert path.stamps_ns.tolist() == [0, 1000, 2000, 3000, 4000]
    np.testing.assert_allclose(path.Ts_world_body, m.Ts_world_body(range(5)), atol=1e-8)
    np.testing.assert_allclose(graph.Ts_world_node, m.Ts_world_body(range(5)), atol=1e-12)
    T_i_j = np.linalg.inv(graph.Ts_world_node[graph.first]) @ graph.Ts_world_node[graph.second]
    np.testing.assert_allclose(T_i_j, graph.Ts_first_second, atol=1e-12)
    assert graph.is_fixed.tolist() == [True, False, False, False, False]
    assert sorted(graph.information[:, 0, 0].tolist()) == [1.0, 1.0, 1.0, 7.0]


def test_keyframes_with_scales_make_a_graph_of_similarities(tmp_path):
    m = chain(scale=1.5)
    write_map_parts(m, graph=tmp_path / "g.g2o")
    graph = read_g2o(tmp_path / "g.g2o")
    assert graph.group == "Sim3"
    scales = np.cbrt(np.linalg.det(graph.Ts_world_node[:, :3, :3]))
    np.testing.assert_allclose(scales, 1.5 ** np.arange(5), rtol=1e-12)
    of_tree = graph.information[:, 0, 0] == 1.0
    S_i_j = np.linalg.inv(graph.Ts_world_node[graph.first]) @ graph.Ts_world_node[graph.second]
    np.testing.assert_allclose(S_i_j[of_tree], graph.Ts_first_second[of_tree], atol=1e-9)


def test_culled_keyframes_that_edges_name_are_nodes():
    m = rich_map()
    graph, links = map_graph(m)
    assert graph.ids.tolist() == list(range(8))  # 0 and 3 are stubs
    np.testing.assert_allclose(graph.Ts_world_node[3, :3, 3], m.T_world_body(3)[:3, 3])
    assert graph.num_edges == 8 + links
    assert len(keyframe_trajectory(m)) == 6


def test_keyframes_of_one_stamp_give_one_row():
    m = chain()
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 2000), np.eye(4))
    path = keyframe_trajectory(m)
    assert len(path) == 5
    np.testing.assert_array_equal(path.Ts_world_body[2], m.T_world_body(2))


def test_an_empty_map_has_nothing_to_export(tmp_path):
    with pytest.raises(InputError, match="the map is empty"):
        write_map_parts(Map(), tmp_path / "p.ply")


def test_the_command_writes_what_was_asked_for(tmp_path, capsys):
    save_map(tmp_path / "map.odomap", chain())
    out = tmp_path / "out"
    words = ["--points", "p.ply", "--trajectory", "k.tum", "--graph", "g.g2o"]
    words = [word if word.startswith("--") else str(out / word) for word in words]
    assert main(["export", str(tmp_path / "map.odomap"), *words]) == 0
    text = capsys.readouterr().out
    assert "p.ply: 5 landmarks" in text
    first = {p.name: p.read_bytes() for p in out.iterdir()}
    assert sorted(first) == ["g.g2o", "k.tum", "p.ply"]
    assert main(["export", str(tmp_path), *words]) == 0  # the folder of a run
    assert {p.name: p.read_bytes() for p in out.iterdir()} == first


def test_what_is_wrong_with_the_words(tmp_path, capsys):
    file = tmp_path / "map.odomap"
    save_map(file, chain())
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.odomap").write_bytes(file.read_bytes()[:-40])
    for words, message in (
        ([str(file)], "say what of the map: --points, --trajectory, --graph or --grid FILE"),
        ([str(file), "--points", "p.obj"], "--points p.obj: give a name that ends in .ply"),
        ([str(file), "--graph", "p.tum"], "--graph p.tum: give a name that ends in .g2o"),
        ([str(file), "--trajectory", "a.gz", "--graph", "a.gz"], "give names of their own"),
        ([str(tmp_path / "empty"), "--points", "p.ply"], "has no map.odomap"),
        ([str(tmp_path / "none.odomap"), "--points", "p.ply"], "cannot be read: No such file"),
        ([str(tmp_path / "broken.odomap"), "--points", "p.ply"], "its end is missing"),
    ):
        assert main(["export", *words]) == 2, words
        assert message in capsys.readouterr().err, words


def test_info_says_what_is_inside(tmp_path, capsys):
    m = rich_map()
    file = tmp_path / "map.odomap"
    save_map(file, m, settings={"preset": "stereo", "evil\x1b[2J": "a\nb"})
    assert main(["info", str(file), "--check"]) == 0
    text = capsys.readouterr().out
    for part in (
        f"map.odomap (odomap map, version {VERSION})",
        "6, and 2 culled ones",
        f"{m.num_landmarks}, seen {m.num_observations} times",
        "features of 4, scan of 2, cloud of 3, imu of 4",
        "8 (7 odometry, 1 loop)",
        "0.30 s from 1403636579.8",
        "not said",
        "stereo",
        "all of it was read and fits",
    ):
        assert part in text, part
    assert "\x1b" not in text
    assert main(["info", str(file), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["landmarks"] == m.num_landmarks
    assert facts["checked"] is False
    data = bytearray(file.read_bytes())
    data[data.index(b"features/bearings.npy") + 300] ^= 1
    file.write_bytes(data)
    assert main(["info", str(file)]) == 0  # it is not read
    assert main(["info", str(file), "--check"]) == 2
    assert "features/bearings.npy: its checksum is wrong" in capsys.readouterr().err


def test_info_of_an_empty_map(tmp_path, capsys):
    save_map(tmp_path / "m.odomap", Map())
    assert main(["info", str(tmp_path / "m.odomap")]) == 0
    assert "0, and 0 culled ones" in capsys.readouterr().out
