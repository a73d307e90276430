"""A pose graph refuses what cannot be one, and says which edge it is."""

import numpy as np
import pytest

from graphworlds import world
from odomap.backend.graphs.posegraph import PoseGraph, Priors, Sights
from odomap.errors import InputError

I3 = np.eye(3)


def graph(**changes):
    """Return three nodes in a row with one thing changed."""
    step = np.eye(3)
    step[0, 2] = 1.0
    parts = {
        "group": "SE2",
        "Ts_world_node": np.full((3, 3, 3), np.nan),
        "first": [0, 1],
        "second": [1, 2],
        "Ts_first_second": [step, step],
        "information": [I3, I3],
        "ids": [10, 11, 12],
    }
    return PoseGraph(**{**parts, **changes})


def test_what_is_left_out_is_filled_in():
    g = graph(ids=None)
    assert g.ids.tolist() == [0, 1, 2]
    assert not g.is_fixed.any()
    assert (g.num_nodes, g.num_edges, g.dim, g.space) == (3, 2, 3, 2)
    assert len(g.priors.node) == len(g.points.node) == 0
    assert g.first.dtype == g.second.dtype == np.int64


def test_loops_are_edges_between_nodes_that_do_not_follow_each_other():
    g = graph(first=[0, 2], second=[1, 0])
    assert g.is_loop.tolist() == [False, True]


def test_without_leaves_the_rest_as_it_was():
    g = graph().without([True, False])
    assert g.num_edges == 1
    assert g.first.tolist() == [1]
    assert g.ids.tolist() == [10, 11, 12]


def lopsided():
    information = np.eye(3)
    information[0, 1] = 0.5
    return information


def reflected():
    T = np.eye(3)
    T[0, 0] = -1.0
    return T


def lower():
    matrix = np.zeros((3, 3))
    matrix[2, 0] = 5.0
    return matrix


nan = np.full((3, 3), np.nan)

WRONG = {
    "group 'SO9' is unknown": {"group": "SO9"},
    "first must be a list of whole numbers": {"first": [0.5, 1.0]},
    "second names a node or landmark that does not exist": {"second": [1, 3]},
    "edge arrays differ in length": {"information": [I3]},
    "ids and is_fixed must have one entry per node": {"ids": [1, 2]},
    r"Ts_first_second has shape \(2, 4, 4\), give \(n, 3, 3\)": {
        "Ts_first_second": np.stack([np.eye(4)] * 2)
    },
    r"edge 1 \(11 to 11\): a node cannot be tied to itself": {"second": [1, 1]},
    r"edge 1 \(11 to 12\): a value is not finite": {"Ts_first_second": [I3, nan]},
    r"edge 1 \(11 to 12\): not a rotation": {"Ts_first_second": [I3, reflected()]},
    r"edge 0 \(10 to 11\): its information is not finite": {"information": [nan, I3]},
    r"edge 0 \(10 to 11\): its information is not symmetric": {"information": [lopsided(), I3]},
    r"edge 1 \(11 to 12\): its information is indefinite": {
        "information": [I3, np.diag([1.0, -2.0, 1.0])]
    },
    "node 10 is to be held, but its pose is not known": {"is_fixed": [True, False, False]},
    "node 11: not a rotation": {"Ts_world_node": np.stack([I3, np.diag([2.0, 2.0, 1.0]), I3])},
    "prior 0: its information is indefinite": {
        "priors": Priors(np.array([0]), I3[None], -I3[None])
    },
    "prior 0: not a rotation": {
        "priors": Priors(np.array([0]), np.diag([3.0, 3.0, 1.0])[None], I3[None])
    },
    "priors.node names a node or landmark that does not exist": {
        "priors": Priors(np.array([7]), I3[None], I3[None])
    },
    "node 12: the last row must be 0 … 0 1": {"Ts_world_node": np.stack([I3, I3, I3 + lower()])},
    "two nodes are called 7: ids must differ": {"ids": [7, 8, 7]},
    "information is not an array of numbers": {"information": [[1.0], [2.0, 3.0]]},
    "priors must be given as `Priors`": {"priors": (np.array([0]), I3[None], I3[None])},
    "a sight of a landmark is not finite": {
        "points": Sights(
            np.zeros((1, 2)),
            np.array([0]),
            np.array([0]),
            np.array([0]),
            np.array([[np.inf, 0.0]]),
            np.eye(2)[None],
        )
    },
}


@pytest.mark.parametrize("message", WRONG)
def test_what_is_wrong_is_named(message):
    with pytest.raises(InputError, match=message):
        graph(**WRONG[message])


def test_information_may_be_singular_but_for_rounding():
    assert graph(information=[np.diag([1.0, 0.0, 1.0]), np.diag([1.0, -1e-12, 1.0])]).dim == 3


def test_a_similarity_may_have_any_scale():
    g, Ts = world("Sim3")
    scaled = g.Ts_first_second.copy()
    scaled[:, :3, :3] *= 7.0
    assert PoseGraph("Sim3", Ts, g.first, g.second, scaled, g.information).group == "Sim3"


def test_what_the_caller_writes_later_changes_nothing():
    information = np.stack([I3, I3])
    g = graph(information=information)
    information[:] = -5.0
    assert (g.information == I3).all()


def test_ids_may_be_far_apart():
    lowest, highest = np.iinfo(np.int64).min, np.iinfo(np.int64).max
    assert graph(ids=[lowest, highest, 5]).is_loop.all()
