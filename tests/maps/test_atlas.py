"""Pieces of a map: where they begin, what makes them one, and that culling keeps them apart."""

import numpy as np
import pytest

from maps.test_map_properties import random_pose
from odomap.files.mapexport import map_graph
from odomap.files.mapfile import load_map, save_map
from odomap.maps.atlas import Atlas, beginnings
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map


def grown(m, keyframes, rng, gap=False, parent=-1):
    """Add a chain of keyframes, the first after a gap; return their ids."""
    ids = []
    for n in range(keyframes):
        k = m.new_keyframe_id()
        m.add_keyframe(Keyframe(k, 10 * k), random_pose(rng), parent=parent if n == 0 else -1)
        if n == 0 and gap:
            m.begin_piece(k)
        ids.append(k)
    return ids


def tied(m, i, j):
    m.add_edge(i, j, random_pose(np.random.default_rng(i)), np.eye(6), "loop")


def three_pieces():
    m, rng = Map(), np.random.default_rng(0)
    return m, [grown(m, 4, rng), grown(m, 3, rng, gap=True), grown(m, 5, rng, gap=True)]


def test_a_map_without_gaps_is_one_piece_and_an_empty_one_none():
    m = Map()
    assert Atlas(m).pieces == ()
    ids = grown(m, 5, np.random.default_rng(0))
    m.begin_piece(ids[0])  # the first keyframe of all begins nothing that is apart
    assert not len(m.edges().i)
    (piece,) = Atlas(m).pieces
    assert (piece.first_id, piece.after_id, piece.merged) == (0, -1, ())
    np.testing.assert_array_equal(piece.keyframe_ids, ids)


def test_pieces_begin_at_gaps_which_say_nothing():
    m, parts = three_pieces()
    pieces = Atlas(m).pieces
    assert [p.keyframe_ids.tolist() for p in pieces] == parts
    assert [p.after_id for p in pieces] == [-1, 3, 6]
    np.testing.assert_array_equal(beginnings(m), [4, 7])
    edges = m.edges()
    assert edges.kind == ("gap", "gap")
    assert not edges.information.any()
    np.testing.assert_allclose(m.T_world_body(3) @ edges.Ts_i_j[0], m.T_world_body(4), atol=1e-12)


@pytest.mark.parametrize("loops", [[(5, 9)], [(9, 5)], [(5, 8), (6, 11)]])
def test_a_loop_makes_two_pieces_one_named_by_the_older(loops):
    m, parts = three_pieces()
    for ends in loops:
        tied(m, *ends)
    first, second = Atlas(m).pieces
    assert first.keyframe_ids.tolist() == parts[0]
    assert second.keyframe_ids.tolist() == parts[1] + parts[2]
    assert (second.first_id, second.merged) == (4, (7,))


def test_pieces_are_one_through_a_chain_of_loops_and_not_through_one_inside():
    m, _ = three_pieces()
    tied(m, 8, 11)
    assert len(Atlas(m).pieces) == 3
    tied(m, 9, 1)
    tied(m, 5, 10)
    (piece,) = Atlas(m).pieces
    assert (piece.first_id, piece.merged) == (0, (4, 7))


def test_culling_keeps_pieces_apart_and_stubs_in_theirs():
    m, _ = three_pieces()
    tied(m, 5, 9)
    m.cull_keyframes([0, 3, 4, 5, 6, 7, 9])  # both ends of each gap stay
    np.testing.assert_array_equal(m.keyframe_ids, [1, 2, 3, 4, 6, 7, 8, 10, 11])
    atlas = Atlas(m)
    assert [p.keyframe_ids.tolist() for p in atlas.pieces] == [[1, 2, 3], [4, 6, 7, 8, 10, 11]]
    assert atlas.piece_of(0).first_id == 1
    assert atlas.piece_of(5) is atlas.piece_of(9) is atlas.pieces[1]
    with pytest.raises(KeyError, match="keyframe 12 was never in the map"):
        atlas.piece_of(12)


def test_a_saved_map_keeps_its_pieces_and_exports_them_apart(tmp_path):
    m, parts = three_pieces()
    tied(m, 5, 9)
    save_map(tmp_path / "map.odomap", m)
    again = load_map(tmp_path / "map.odomap")
    assert [p.keyframe_ids.tolist() for p in Atlas(again).pieces] == [parts[0], parts[1] + parts[2]]
    graph, unmeasured = map_graph(again)
    assert unmeasured == 12 - 3
    assert sorted(zip(graph.first.tolist(), graph.second.tolist()))[:4] == [
        (0, 1), (1, 2), (2, 3), (4, 5)
    ]  # fmt: skip
