"""The reduced system against dense normal equations, written out in full."""

import numpy as np
import pytest

import reference
from odomap.backend.bundle import _arrays
from odomap.backend.schur import SystemArrays, back_substitute, reduced_system, robust_cost
from odomap.geometry.lie import se3_exp

WIDTH = 2.5


def dense(bundle, damping=0.0):
    """Return H (all unknowns: free poses, then points), g, and the robust cost, by differences."""
    free = np.flatnonzero(~bundle.is_fixed)
    column = {int(k): 6 * i for i, k in enumerate(free)}
    offset, size = 6 * len(free), 6 * len(free) + 3 * len(bundle.points_world)
    H, g, cost = np.zeros((size, size)), np.zeros(size), 0.0
    for o in range(len(bundle.pose)):
        k, m = int(bundle.pose[o]), int(bundle.point[o])
        rest = bundle.xy[o], bundle.disparity[o], bundle.weights[o]
        mount, baseline = (
            bundle.Ts_camera_body[bundle.camera[o]],
            bundle.baselines[bundle.camera[o]],
        )
        T, p = bundle.Ts_world_body[k], bundle.points_world[m]
        r = reference.residual(T, mount, baseline, p, *rest)
        J = np.zeros((3, size))
        if k in column:
            f = column[k]
            J[:, f : f + 6] = reference.numeric_jacobian(
                lambda x, T=T, p=p, a=mount, b=baseline, rest=rest: reference.residual(
                    T @ se3_exp(x), a, b, p, *rest
                ),
                6,
            )
        at = offset + 3 * m
        J[:, at : at + 3] = reference.numeric_jacobian(
            lambda d, T=T, p=p, a=mount, b=baseline, rest=rest: reference.residual(
                T, a, b, p + d, *rest
            ),
            3,
        )
        c = np.linalg.norm(r)
        w = 1.0 if c <= WIDTH else WIDTH / c
        cost += 0.5 * c * c if c <= WIDTH else WIDTH * c - WIDTH**2 / 2
        H += w * J.T @ J
        g += w * J.T @ r
    return H + damping * np.diag(np.diag(H)), g, cost


def reduce(bundle, damping=0.0):
    """Return the compiled system, with what it was made from."""
    order = np.argsort(bundle.point, kind="stable")
    poses, cameras, seen = _arrays(bundle, order)
    size, n, m = 6 * int((~bundle.is_fixed).sum()), len(order), len(bundle.points_world)
    system = SystemArrays(
        np.full((size, size), np.nan),
        np.full(size, np.nan),
        np.full((n, 6, 3), np.nan),
        np.full((m, 3, 3), np.nan),
        np.full((m, 3), np.nan),
        np.full((n, 3), np.nan),
        np.full((n, 3, 6), np.nan),
        np.full((n, 3, 3), np.nan),
    )
    points = bundle.points_world.copy()
    cost = reduced_system(poses, points, cameras, seen, WIDTH, damping, system)
    chi2 = np.full(n, np.nan)
    assert robust_cost(poses, points, cameras, seen, WIDTH, chi2) == pytest.approx(cost)
    return system, cost, (poses, points, seen), chi2[np.argsort(order)]


@pytest.fixture(scope="module")
def bundle():
    """Two cameras, two poses held, a landmark nobody sees, some disparities missing."""
    from .conftest import make_scene

    rng = np.random.default_rng(1)
    scene = make_scene(poses=5, points=14, seed=2, share=0.7)
    bundle = scene.bundle(rng, 1.5, (0.001, 0.005), fixed=2)
    bundle.disparity[::3] = np.nan
    second = scene.T_camera_body.copy()
    second[:3, 3] += 0.1
    return type(bundle)(
        bundle.Ts_world_body,
        bundle.is_fixed,
        np.concatenate([bundle.points_world, [[0.0, 0.0, 1.0]]]),
        np.stack([scene.T_camera_body, second]),
        np.array([0.12, 0.3]),
        bundle.pose,
        bundle.point,
        rng.integers(0, 2, len(bundle.pose)),
        bundle.xy,
        bundle.disparity,
        bundle.weights,
    )


@pytest.mark.parametrize("damping", [0.0, 1e-2])
def test_the_reduced_system_is_the_dense_one_with_landmarks_eliminated(bundle, damping):
    H, g, expected_cost = dense(bundle, damping)
    system, cost, arrays, _ = reduce(bundle, damping)
    assert cost == pytest.approx(expected_cost, rel=1e-9)
    f, seen = len(system.s), slice(len(system.s), len(g) - 3)  # the last landmark is unseen
    W, C = H[:f, seen], H[seen, seen]
    S = H[:f, :f] - W @ np.linalg.solve(C, W.T)
    s = g[:f] - W @ np.linalg.solve(C, g[seen])
    scale = np.sqrt(np.outer(np.diag(S), np.diag(S)))
    np.testing.assert_allclose(np.tril(system.S / scale), np.tril(S / scale), atol=2e-6)
    np.testing.assert_allclose(system.s, s, rtol=1e-4, atol=1e-4 * np.abs(s).max())
    # Substituted back, poses and landmarks solve the whole.
    whole = -np.linalg.solve(H[:-3, :-3], g[:-3])
    np.testing.assert_allclose(-np.linalg.solve(S, s), whole[:f], rtol=1e-6, atol=1e-9)
    system.s[:] = whole[:f]
    poses, points, sights = arrays
    moved = np.full_like(points, np.nan)
    back_substitute(poses, sights, system, points, moved)
    np.testing.assert_allclose(
        (moved - points)[:-1].ravel(), whole[f:], rtol=1e-4, atol=1e-6 * np.abs(whole).max()
    )
    np.testing.assert_array_equal(moved[-1], points[-1])


def test_outliers_weigh_less_as_huber_says(bundle):
    _, cost, _, chi2 = reduce(bundle)
    assert 0.1 < np.mean(chi2 > WIDTH**2) < 0.95  # both branches are at work
    expected = np.where(chi2 <= WIDTH**2, chi2 / 2, WIDTH * np.sqrt(chi2) - WIDTH**2 / 2)
    assert cost == pytest.approx(expected.sum())


def test_sums_run_in_a_fixed_order(bundle):
    first, again = reduce(bundle)[0], reduce(bundle)[0]
    for a, b in zip(first, again):
        np.testing.assert_array_equal(a, b)
