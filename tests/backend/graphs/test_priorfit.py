"""Components are moved to where their priors say they are."""

from dataclasses import replace

import numpy as np
import pytest

from graphworlds import DIM, EXP, true_poses, world
from odomap.backend.graphs.components import find_components
from odomap.backend.graphs.posegraph import Priors
from odomap.backend.graphs.priorfit import fit_to_priors

each_group = pytest.mark.parametrize("group", DIM)


def with_priors(group, nodes, diagonal=1.0):
    """Return a graph whose priors measure its poses after a motion of all, and these."""
    graph, Ts = world(group, count=8, loops=0, noise=0.0)
    moved = EXP[group](np.linspace(-1.0, 0.8, DIM[group])) @ Ts
    information = np.tile(np.eye(DIM[group]) * diagonal, (len(nodes), 1, 1))
    return replace(graph, priors=Priors(nodes, moved[nodes], information)), Ts, moved


@each_group
@pytest.mark.parametrize("nodes", [[3], [0, 5, 7]])
def test_exact_priors_are_met(group, nodes):
    graph, Ts, moved = with_priors(group, nodes)
    fitted = fit_to_priors(graph, Ts, find_components(graph))
    np.testing.assert_allclose(fitted, moved, atol=1e-10)


@each_group
def test_positions_alone_turn_a_component(group):
    d = 2 if group == "SE2" else 3
    diagonal = np.zeros(DIM[group])
    diagonal[:d] = 1.0
    if group == "Sim3":
        diagonal[6] = 1.0
    graph, Ts, moved = with_priors(group, [0, 2, 5, 7], diagonal)
    fitted = fit_to_priors(graph, Ts, find_components(graph))
    np.testing.assert_allclose(fitted, moved, atol=1e-10)


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_a_turn_that_is_not_measured_is_not_made(group):
    d = 2 if group == "SE2" else 3
    diagonal = (np.arange(DIM[group]) < d).astype(float)
    graph, Ts, moved = with_priors(group, [4], diagonal)
    fitted = fit_to_priors(graph, Ts, find_components(graph))
    np.testing.assert_allclose(fitted[:, :d, :d], Ts[:, :d, :d], atol=1e-12)
    np.testing.assert_allclose(fitted[4, :d, d], moved[4, :d, d], atol=1e-12)


@each_group
def test_without_information_all_stays(group):
    graph, Ts, _ = with_priors(group, [4], 0.0)
    np.testing.assert_allclose(fit_to_priors(graph, Ts, find_components(graph)), Ts, atol=1e-12)


def test_fixed_components_stay_and_others_move_apart():
    group = "SE3"
    graph, Ts, moved = with_priors(group, [1, 6])
    graph = replace(graph, is_fixed=np.arange(8) == 0, Ts_world_node=Ts)
    graph = graph.without(np.arange(7) == 3)
    fitted = fit_to_priors(graph, Ts, find_components(graph))
    np.testing.assert_array_equal(fitted[:4], Ts[:4])
    np.testing.assert_allclose(fitted[4:], moved[4:], atol=1e-12)


def test_more_precise_priors_count_more():
    rng = np.random.default_rng(0)
    Ts = true_poses("SE2", rng, 5)
    graph, _ = world("SE2", count=5, loops=0)
    targets = np.stack([Ts[2], Ts[2]])
    targets[1, 0, 2] += 1.0
    priors = Priors([2, 2], targets, np.eye(3) * np.array([3.0, 1.0])[:, None, None])
    fitted = fit_to_priors(replace(graph, priors=priors), Ts, find_components(graph))
    np.testing.assert_allclose(fitted[2, :2, 2] - Ts[2, :2, 2], [0.25, 0.0], atol=1e-12)
