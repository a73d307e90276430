"""The information matrix against the scatter of repeated registrations, and by its definition."""

import numpy as np
import pytest

import odomap
from lidarworlds import ROOM, ROOM_2D
from odomap.geometry.lie import se2_log, se3_exp, se3_log
from odomap.lidar.degeneracy import judge
from odomap.lidar.target import sample


def squared_errors(world, seeds, **settings):
    """Errors of registrations of a world with itself, in units of their information, over d.o.f."""
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        shift = rng.uniform(-1, 1, 3)
        source, target = world.seen(rng), world.seen(rng)
        shift = shift[: source.shape[1]]
        r = odomap.register(source + shift, target + shift, **settings)
        xi = se3_log(r.T_target_source) if len(shift) == 3 else se2_log(r.se2)
        found.append(xi @ r.information @ xi / len(xi))
    return np.array(found)


@pytest.mark.parametrize("method", ["plane", "gicp"])
@pytest.mark.parametrize(("world", "voxel"), [(ROOM, 0.25), (ROOM_2D, 0.1)])
def test_errors_scatter_as_the_information_says(world, voxel, method):
    mean = squared_errors(world, 20, voxel=voxel, method=method).mean()
    assert 0.4 < mean < 2.0


def test_a_wall_cut_by_voxels_is_not_off_to_one_side():
    rng = np.random.default_rng(0)
    off = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        r = odomap.register(ROOM_2D.seen(rng), ROOM_2D.seen(rng), voxel=0.1)
        off.append(r.se2[:2, 2])
    assert np.sqrt(np.mean(np.square(off))) < 1e-3  # 3 mm by means alone; the noise is 10 mm


def pairs(rng, n=300, noise=0.01):
    p = rng.uniform(-4, 4, (n, 3))
    p -= p.mean(axis=0)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spreads = np.tile([1e12, 0.0, 1.0, 1.0, 1.0], (n, 1))
    e = noise * rng.normal(size=n)[:, None] * normals
    return p, e, normals, spreads, np.ones(n)


def test_information_is_that_of_the_residuals_slopes():
    rng = np.random.default_rng(1)
    p, e, n, spreads, own = pairs(rng)
    R, origin = se3_exp(np.array([0, 0, 0, 0.3, -0.2, 0.5]))[:3, :3], np.array([3.0, -1.0, 2.0])
    got = judge(p, e, n, spreads, own, R, origin, False)

    def residuals(xi):  # of q - T exp(ξ) p, with p in the source's frame
        step = se3_exp(xi)
        moved = (p + origin) @ step[:3, :3].T + step[:3, 3] - origin
        return np.sum(n * (e - (moved - p) @ R.T), axis=1)

    J = np.stack([(residuals(d) - residuals(-d)) / 2e-6 for d in 1e-6 * np.eye(6)], axis=1)
    ratio = got.information / (J.T @ J / 1e-4)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.2)  # σ² is of what was drawn
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-4)
    assert got.error == pytest.approx(0.01, rel=0.15)
    assert len(got.weak_directions) == 0


def test_gross_residuals_do_not_count_for_the_noise():
    rng = np.random.default_rng(2)
    p, e, n, spreads, own = pairs(rng)
    plain = judge(p, e, n, spreads, own, np.eye(3), np.zeros(3), False)
    e[::10] *= 100.0
    gross = judge(p, e, n, spreads, own, np.eye(3), np.zeros(3), False)
    assert np.trace(gross.information) == pytest.approx(np.trace(plain.information), rel=0.2)


def test_noisy_normals_do_not_make_a_corridor_known():
    rng = np.random.default_rng(3)
    p, e, n, spreads, own = pairs(rng, 4000)
    n = np.tile([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (2000, 1))
    tilt = 0.05
    n += tilt * rng.normal(size=n.shape)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    spreads[:, :3] = [10, 10 * tilt**2, 1.0]  # λ₀ λ₁ / (n (λ₁ - λ₀)²) = δ², nearly
    known = judge(p, e, n, spreads, own, np.eye(3), np.zeros(3), False)
    assert len(known.weak_directions) == 1
    assert abs(known.weak_directions[0][0]) == pytest.approx(1.0, abs=0.05)
    assert known.information[0, 0] < 1e-3 * known.information[1, 1]
    assert "translation along (1.00" in known.reason


def test_nothing_met_fixes_nothing():
    none = np.empty((0, 3))
    got = judge(none, none, none, np.empty((0, 5)), np.empty(0), np.eye(3), np.zeros(3), True)
    assert not got.information.any()
    assert got.weak_directions.shape == (3, 3)
    assert got.reason


def test_points_are_moved_across_their_surface_alone():
    rng = np.random.default_rng(4)
    sampled = sample(odomap.Cloud.of(ROOM.seen(rng)), 0.25, 10, "source")
    points = sampled.points + sampled.origin
    floor = (np.abs(points[:, :2]) < 2).all(axis=1)
    assert floor.sum() > 100
    assert np.std(points[floor, 2]) < 0.003  # drawn with 10 mm, nine cells of seven points
