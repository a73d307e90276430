"""Normal equations and their reduction against dense differences."""

from dataclasses import replace

import numpy as np
import pytest

from bundleworlds import LENSES, world
from odomap.backend.adjustment.descent import Descent, state_of
from odomap.backend.adjustment.layout import lay_out
from odomap.backend.adjustment.lenses import WIDTH
from odomap.backend.adjustment.normal import Views, move_views
from odomap.backend.adjustment.points import retract
from odomap.backend.adjustment.reduced import Factored, Iterative
from odomap.geometry.robust import LOSSES, Loss

FREE = {
    "held": {},
    "shared": {"is_free_intrinsic": True},
    "own": {"own": True, "is_free_intrinsic": True},
}


def descent_of(problem, loss=None):
    layout = lay_out(problem)
    return Descent(
        state_of(problem, layout), layout, loss or Loss(), Factored(layout, problem.lens)
    )


def moved(descent, delta, points):
    """Return the state after a step of views and lenses, in unscaled unknowns, and of points."""
    views, lenses, places = descent.state
    new = Views(np.empty_like(views.R), np.empty_like(views.t), views.lens)
    theta = np.empty((len(lenses.theta), WIDTH))
    move_views(views, lenses, descent.layout.blocks, delta, new, theta)
    return descent.state._replace(
        views=new, lenses=lenses._replace(theta=theta), points=places + points
    )


def cost_at(descent, delta, points):
    return descent.evaluate(moved(descent, delta, points))[0]


def with_depth(problem, seed=0):
    """Return a problem in which the depths of most observations were measured as well."""
    rng = np.random.default_rng(seed)
    Ts = problem.Ts_camera_world[problem.view]
    X = np.einsum("nij,nj->ni", Ts[:, :3, :3], problem.points_world[problem.point]) + Ts[:, :3, 3]
    inverse = 1.0 / X[:, 2] + rng.normal(0.0, 0.01, len(X))
    inverse[rng.random(len(X)) < 0.3] = np.nan
    return replace(problem, inverse_depths=inverse, depth_weights=rng.uniform(50, 200, len(X)))


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("lens", FREE)
@pytest.mark.parametrize("name", LENSES)
def test_the_gradient_is_that_of_differences(name, lens, deep):
    problem, *_ = world(name, views=4, points=20, **FREE[lens])
    problem = with_depth(problem) if deep else problem
    descent = descent_of(problem, Loss("cauchy", 3.0))
    system = descent.linearise(0.1)
    n, still = len(system.a), np.zeros_like(descent.state.points)
    held = descent.layout.blocks.is_held
    for j in np.random.default_rng(0).choice(np.flatnonzero(~held), 24, replace=n < 24):
        h = 1e-5 * system.scale[j] * 100
        delta = h * np.eye(n)[j]
        slope = (cost_at(descent, delta, still) - cost_at(descent, -delta, still)) / (2 * h)
        assert system.a[j] / system.scale[j] == pytest.approx(slope, rel=2e-4, abs=2e-2)
    for m, k in ((0, 0), (3, 1), (7, 2)):
        step = np.zeros_like(still)
        step[m, k] = 1e-6
        zero = np.zeros(n)
        slope = (cost_at(descent, zero, step) - cost_at(descent, zero, -step)) / 2e-6
        assert system.c[m, k] == pytest.approx(slope, rel=2e-4, abs=2e-2)


def dense_system(descent, damping):
    """Return the reduced matrix and right side by differences of the residuals, all at once."""
    seen, state = descent.layout.seen, descent.state
    n, points = len(descent.system.a), state.points

    def residuals(delta, step):
        views, lenses, places = moved(descent, delta, step)
        rows = []
        point = np.repeat(np.arange(len(places)), np.diff(seen.start))
        for o, (k, m) in enumerate(zip(seen.of_view, point)):
            X, theta = views.R[k] @ places[m] + views.t[k], lenses.theta[views.lens[k]]
            plane = X[:2] / X[2]
            rows.append(seen.weight[o] * (theta[:2] * plane + theta[2:4] - seen.pixels[o]))
            rows.append(seen.depth_weight[o : o + 1] * (1 / X[2] - seen.inverse_depth[o]))
        return np.concatenate(rows)

    def column(delta, step, h):
        return (residuals(delta, step) - residuals(-delta, -step)) / (2 * h)

    still, zero, h = np.zeros_like(points), np.zeros(n), 1e-6
    A = [column(h * unit, still, h) for unit in np.eye(n)]
    units = np.eye(points.size).reshape(-1, *points.shape)
    P = [column(zero, h * unit, h) for unit in units]
    J = np.stack(A, axis=1) * descent.system.scale, np.stack(P, axis=1)
    r = residuals(zero, still)
    H, W, C = J[0].T @ J[0], J[0].T @ J[1], J[1].T @ J[1]
    H[np.diag_indices(n)] *= 1 + damping
    C[np.diag_indices(len(C))] *= 1 + damping
    return H - W @ np.linalg.solve(C, W.T), J[0].T @ r - W @ np.linalg.solve(C, J[1].T @ r)


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("lens", FREE)
def test_the_reduced_matrix_is_the_schur_complement(lens, deep):
    problem, *_ = world("pinhole", views=4, points=12, **FREE[lens])
    problem = with_depth(problem) if deep else problem
    fixed = np.array([True, False, False, False])
    problem = replace(problem, is_fixed_view=fixed & (lens != "own"))
    descent, damping = descent_of(problem), 0.01
    values, s = descent.reduced.assemble(descent.linearise(damping), damping)
    S = descent.reduced.pattern.to_scipy(values).toarray()
    expected, right = dense_system(descent, damping)
    np.testing.assert_allclose(S, expected, atol=2e-6 * np.abs(expected).max())
    np.testing.assert_allclose(s, right, atol=2e-6 * np.abs(right).max())


@pytest.mark.parametrize("lens", FREE)
def test_conjugate_gradients_find_what_the_factor_finds(lens):
    problem, *_ = world("double_sphere", **FREE[lens])
    descent = descent_of(problem)
    system = descent.linearise(0.01)
    exact = descent.reduced.step(system, 0.01, lambda: False)
    found = Iterative(descent.layout, problem.lens, 2000, 1e-14).step(system, 0.01, lambda: False)
    np.testing.assert_allclose(found, exact, rtol=1e-4, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("name", LOSSES)
def test_the_cost_is_that_of_the_loss(name):
    problem, *_ = world("pinhole", off=0.0)
    descent = descent_of(problem, Loss(name))
    expected = 0.5 * float(np.sum(Loss(name).cost(descent.chi2)))
    assert descent.cost == pytest.approx(expected, rel=1e-12)


def test_a_point_moves_in_inverse_distance():
    R, t = np.eye(3)[None], np.zeros((1, 3))
    far = retract(R, t, 0, (0.0, 0.0, 10.0), (0.0, 0.0, 5.0))
    np.testing.assert_allclose(far, (0, 0, 20.0))  # 1/d: 0.1 - 5/100
    near = retract(R, t, 0, (0.0, 0.0, 10.0), (0.0, 0.0, -90.0))
    np.testing.assert_allclose(near, (0, 0, 1.0))  # never behind, however long the step
    along = np.array(retract(R, t, 0, (1.0, 2.0, 10.0), (1e-6, 2e-6, -3e-6)))
    np.testing.assert_allclose(along - [1, 2, 10], [1e-6, 2e-6, -3e-6], rtol=1e-5)


def test_a_lens_of_its_own_stands_beside_its_view():
    problem, *_ = world("bal", own=True, is_free_intrinsic=True)
    assert lay_out(problem).blocks.size.tolist() == [9] * 6
    shared, *_ = world("bal", is_free_intrinsic=True)
    assert lay_out(shared).blocks.size.tolist() == [6] * 6 + [3]
    wide, *_ = world("rational", own=True, is_free_intrinsic=True)
    assert lay_out(wide).blocks.size.tolist() == [6] * 6 + [12] * 6
