"""What edges, priors and sights add to the normal equations, against differences and NumPy."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from graphworlds import DIM, EXP, INVERSE, LOG, random_information, with_landmarks, world
from odomap.backend.descent import Linear
from odomap.backend.graphs.graphproblem import GraphProblem
from odomap.backend.graphs.posegraph import Priors
from odomap.geometry.robust import LOSSES, Loss

each_group = pytest.mark.parametrize("group", DIM)


def problem_of(graph, Ts, is_chordal=False, loss=None, held=(0,), weights=None, points=None):
    """Return a problem, the state at Ts and the problem linearised there."""
    is_held = np.zeros(graph.num_nodes, bool)
    is_held[list(held)] = True
    loss = loss or Loss()
    robust = np.full(graph.num_edges, loss.name != "quadratic")
    weights = np.ones(graph.num_edges) if weights is None else weights
    problem = GraphProblem(graph, is_held, is_chordal, loss, robust, weights)
    state = problem.state(Ts, graph.points.points_world if points is None else points)
    out = Linear.empty(problem.pattern)
    problem.linearise(state, out)
    return problem, state, out


def cost_at(problem, state, step):
    out = Linear.empty(problem.pattern)
    problem.linearise(problem.retract(state, step), out)
    return out.cost


def gradient_by_differences(problem, state, h=1e-6):
    steps = np.eye(problem.pattern.size) * h
    return np.array(
        [(cost_at(problem, state, s) - cost_at(problem, state, -s)) / (2 * h) for s in steps]
    )


def noisy(group, seed=3, noise=0.3):
    """Return a world of few nodes whose poses are off, so that residuals are large."""
    graph, Ts = world(group, seed, count=6, loops=4, noise=0.05)
    rng = np.random.default_rng(seed)
    graph = replace(graph, information=random_information(rng, graph.num_edges, graph.dim))
    return graph, Ts @ EXP[group](noise * rng.normal(size=(len(Ts), graph.dim)))


@each_group
@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_is_that_of_the_cost(group, seed):
    graph, Ts = noisy(group, seed)
    problem, state, out = problem_of(graph, Ts)
    np.testing.assert_allclose(
        out.gradient, gradient_by_differences(problem, state), atol=1e-6 * abs(out.gradient).max()
    )


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_the_gradient_of_the_chordal_cost(group):
    graph, Ts = noisy(group)
    problem, state, out = problem_of(graph, Ts, is_chordal=True)
    np.testing.assert_allclose(
        out.gradient, gradient_by_differences(problem, state), atol=1e-6 * abs(out.gradient).max()
    )


@each_group
@pytest.mark.parametrize("name", [n for n in LOSSES if n != "truncated"])
def test_the_gradient_of_each_loss(group, name):
    graph, Ts = noisy(group)
    problem, state, out = problem_of(graph, Ts, loss=Loss(name, 0.7))
    np.testing.assert_allclose(
        out.gradient, gradient_by_differences(problem, state), atol=1e-6 * abs(out.gradient).max()
    )


@each_group
def test_cost_and_residuals_are_those_of_the_formula(group):
    graph, Ts = noisy(group)
    problem, _, out = problem_of(graph, Ts)
    E = INVERSE[group](graph.Ts_first_second) @ (INVERSE[group](Ts[graph.first]) @ Ts[graph.second])
    r = LOG[group](E)
    chi2 = np.einsum("ea,eab,eb->e", r, graph.information, r)
    np.testing.assert_allclose(problem.chi2, chi2, rtol=1e-9)
    assert out.cost == pytest.approx(0.5 * chi2.sum(), rel=1e-10)


@each_group
def test_the_hessian_is_that_of_gauss_newton(group):
    """JᵀΩJ, with J by differences of the residuals themselves."""
    graph, Ts = noisy(group)
    problem, state, out = problem_of(graph, Ts)

    def residuals(step):
        moved = problem.retract(state, step).Ts[:-1]
        D = INVERSE[group](moved[graph.first]) @ moved[graph.second]
        return LOG[group](INVERSE[group](graph.Ts_first_second) @ D)

    h = 1e-6
    steps = np.eye(problem.pattern.size) * h
    J = np.stack([(residuals(s) - residuals(-s)) / (2 * h) for s in steps], axis=-1)
    H = np.einsum("eap,eab,ebq->pq", J, graph.information, J)
    ours = problem.pattern.to_scipy(out.values).toarray()
    np.testing.assert_allclose(ours, H, atol=1e-6 * np.abs(H).max())


@each_group
def test_priors_and_weights_count(group):
    graph, Ts = noisy(group)
    rng = np.random.default_rng(5)
    priors = Priors(
        np.array([1, 4]),
        Ts[[1, 4]] @ EXP[group](0.1 * rng.normal(size=(2, graph.dim))),
        random_information(rng, 2, graph.dim),
    )
    graph = replace(graph, priors=priors)
    weights = rng.uniform(0.0, 2.0, graph.num_edges)
    weights[2] = 0.0
    problem, state, out = problem_of(graph, Ts, held=(), weights=weights)
    r = LOG[group](INVERSE[group](priors.Ts_world_node) @ Ts[priors.node])
    of_priors = np.einsum("ea,eab,eb->e", r, priors.information, r)
    edges = problem.chi2[: graph.num_edges]
    assert out.cost == pytest.approx(0.5 * (weights @ edges + of_priors.sum()), rel=1e-10)
    np.testing.assert_allclose(
        out.gradient, gradient_by_differences(problem, state), atol=1e-6 * abs(out.gradient).max()
    )


@each_group
@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 0.5)])
def test_sights_of_landmarks(group, loss):
    graph, Ts = noisy(group)
    graph, points = with_landmarks(graph, Ts, count=4, noise=0.5)
    information = random_information(np.random.default_rng(2), 16, graph.space)
    graph = replace(graph, points=replace(graph.points, information=information))
    problem, state, out = problem_of(graph, Ts, loss=loss, points=points)
    np.testing.assert_allclose(
        out.gradient, gradient_by_differences(problem, state), atol=1e-6 * abs(out.gradient).max()
    )
    H = problem.pattern.to_scipy(out.values).toarray()
    np.testing.assert_allclose(H, H.T, atol=1e-9 * np.abs(H).max())
    assert np.linalg.eigvalsh(H).min() > 0.0


@each_group
def test_moving_the_whole_world_changes_nothing(group):
    graph, Ts = noisy(group)
    move = EXP[group](np.linspace(0.3, 1.1, graph.dim))
    one, other = (problem_of(graph, poses)[2] for poses in (Ts, move @ Ts))
    assert other.cost == pytest.approx(one.cost, rel=1e-9)
    np.testing.assert_allclose(other.gradient, one.gradient, atol=1e-8 * abs(one.gradient).max())


@each_group
def test_a_step_moves_as_the_exponential_says(group):
    graph, Ts = noisy(group)
    problem, state, _ = problem_of(graph, Ts, held=(2,))
    step = np.random.default_rng(1).normal(size=problem.pattern.size)
    moved = problem.retract(state, step).Ts[:-1]
    free = np.arange(len(Ts)) != 2
    np.testing.assert_array_equal(moved[2], Ts[2])
    expected = Ts[free] @ EXP[group](step.reshape(-1, graph.dim))
    np.testing.assert_allclose(moved[free], expected, atol=1e-12)


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_half_a_turn_is_no_trouble(group):
    graph, Ts = world(group, count=4, loops=1, noise=0.0)
    flip = np.zeros(graph.dim)
    flip[-1] = np.pi - 1e-9
    turned = Ts.copy()
    turned[2] = turned[2] @ EXP[group](flip)
    _, _, out = problem_of(graph, turned)
    assert np.isfinite(out.cost)
    assert np.isfinite(out.gradient).all()
    assert np.isfinite(out.values).all()


@pytest.mark.parametrize(
    ("group", "with_sights", "names"),
    [
        ("SE2", False, {"planeedges"}),
        ("SE3", True, {"spaceedges", "sights"}),
        ("Sim3", False, {"similarities"}),
    ],
)
def test_only_what_a_group_needs_is_there_to_be_compiled(group, with_sights, names):
    code = (
        "import sys; from odomap.backend.graphs.graphproblem import import_group; "
        f"import_group({group!r}, {with_sights}); "
        "from odomap.kernels import needed_modules; "
        "print(*(name.rpartition('.')[2] for name in needed_modules()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    several = {"planeedges", "spaceedges", "similarities", "sights"}
    assert several & set(done.stdout.split()) == names
