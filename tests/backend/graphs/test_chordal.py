"""The chordal cost, written out."""

import numpy as np
import pytest

from graphworlds import EXP, random_information, world
from odomap.backend.graphs.chordal import chordal_cost, chordal_costs, isotropic_weights
from odomap.errors import InputError
from odomap.geometry.lie import se2_exp, se3_exp


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_the_cost_is_its_formula(group):
    graph, Ts = world(group, noise=0.3)
    graph = graph.placed(Ts)
    d = graph.space
    expected = []
    for e in range(graph.num_edges):
        omega_inverse = np.linalg.inv(graph.information[e])
        tau = d / np.trace(omega_inverse[:d, :d])
        kappa = graph.information[e, 2, 2]
        if d == 3:
            kappa = 3.0 / (2.0 * np.trace(omega_inverse[3:, 3:]))
        first, second, Z = Ts[graph.first[e]], Ts[graph.second[e]], graph.Ts_first_second[e]
        off = second - first @ Z
        expected.append(kappa * (off[:d, :d] ** 2).sum() + tau * (off[:d, d] ** 2).sum())
    np.testing.assert_allclose(chordal_costs(graph), expected, rtol=1e-12)
    assert chordal_cost(graph) == pytest.approx(sum(expected))


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_moving_all_changes_nothing(group):
    graph, Ts = world(group, noise=0.3)
    motion = EXP[group](np.linspace(-1.0, 2.0, graph.dim))
    moved = chordal_cost(graph.placed(motion @ Ts))
    assert moved == pytest.approx(chordal_cost(graph.placed(Ts)), rel=1e-12)


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_small_isotropic_errors_cost_what_they_do_in_the_tangent(group):
    graph, Ts = world(group, noise=0.0)
    rng = np.random.default_rng(0)
    k, d, n = graph.dim, graph.space, graph.num_edges
    xi = 1e-4 * rng.normal(size=(n, k))
    exp = se2_exp if group == "SE2" else se3_exp
    information = np.zeros((n, k, k))
    information[:, range(d), range(d)] = rng.uniform(1.0, 9.0, n)[:, None]
    information[:, range(d, k), range(d, k)] = rng.uniform(1.0, 9.0, n)[:, None]
    noisy = type(graph)(
        group, Ts, graph.first, graph.second, graph.Ts_first_second @ exp(xi), information
    )
    chi2 = np.einsum("ei,eij,ej->e", xi, information, xi)
    turned = np.einsum("ei,e,ei->e", xi[:, d:], information[:, d, d], xi[:, d:])
    # |R − I|² = 2 θ²: in the plane κ leaves that factor, in space it does not.
    extra = turned if d == 2 else 0.0
    np.testing.assert_allclose(chordal_costs(noisy), chi2 + extra, rtol=1e-3)


def test_weights_are_harmonic_means_of_the_diagonal_blocks():
    rng = np.random.default_rng(0)
    for k, d in ((3, 2), (6, 3), (7, 3)):
        omega = random_information(rng, 20, k)
        kappa, tau = isotropic_weights(omega, d)
        translations = np.linalg.eigvalsh(omega[:, :d, :d])
        np.testing.assert_allclose(tau, d / (1.0 / translations).sum(axis=1))
        if d == 3:
            turns = np.linalg.eigvalsh(omega[:, 3:6, 3:6])
            np.testing.assert_allclose(kappa, 1.5 / (1.0 / turns).sum(axis=1))
        else:
            np.testing.assert_array_equal(kappa, omega[:, 2, 2])


def test_singular_information_weighs_nothing():
    for k, d in ((3, 2), (6, 3)):
        omega = np.zeros((2, k, k))
        omega[1, 0, 0] = 1.0
        for weight in isotropic_weights(omega, d):
            np.testing.assert_array_equal(weight, 0.0)


def test_what_has_no_chordal_cost_says_so():
    graph, Ts = world("Sim3")
    with pytest.raises(InputError, match="not defined for Sim3"):
        chordal_cost(graph.placed(Ts))
    graph, _ = world("SE3")
    with pytest.raises(InputError, match="not known"):
        chordal_cost(graph)
