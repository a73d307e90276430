"""Flow against textures that are functions: where a point went is known exactly."""

import numpy as np
import pytest

from odomap.vision.flow import FlowConfig, facing_warp, pyramid, track
from odomap.vision.patches import _sample_template, align_patches

SHAPE = (180, 220)
CONFIG = FlowConfig()


@pytest.fixture(scope="module")
def still(texture):
    return texture.image(SHAPE)


@pytest.fixture(scope="module")
def grid():
    x, y = np.meshgrid(np.arange(40.3, 180, 15.7), np.arange(40.6, 140, 15.1))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def follow(first, second, points, guess=None, config=CONFIG, warp=None):
    return track(
        pyramid(first, config.levels),
        pyramid(second, config.levels),
        points,
        points if guess is None else guess,
        config,
        warp,
    )


def errors(flow, truth):
    return np.linalg.norm(flow.points - truth, axis=1)[flow.found]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.25), (3.37, -2.61), (-6.43, 4.2)])
def test_a_shift_is_found_to_hundredths_of_a_pixel(texture, still, grid, shift):
    moved = texture.image(SHAPE, lambda x, y: (x - shift[0], y - shift[1]))
    flow = follow(still, moved, grid)
    assert flow.found.mean() > 0.97
    assert np.sqrt(np.mean(errors(flow, grid + shift) ** 2)) < 0.02
    assert errors(flow, grid + shift).max() < 0.08
    # No pull towards whole pixels.
    np.testing.assert_allclose((flow.points - grid - shift)[flow.found].mean(axis=0), 0, atol=0.006)


def test_exposure_does_not_matter(texture, still, grid):
    moved = texture.image(SHAPE, lambda x, y: (x - 1.4, y + 0.7))
    dim = np.round(0.45 * moved + 70).astype(np.uint8)
    flow = follow(still, dim, grid)
    assert flow.found.mean() > 0.97
    assert errors(flow, grid + np.array([1.4, -0.7])).max() < 0.1
    assert np.median(errors(flow, grid + np.array([1.4, -0.7]))) < 0.02
    assert flow.correlation[flow.found].min() > 0.99


def test_vignetting_hardly_matters(texture, still, grid):
    moved = texture.image(SHAPE, lambda x, y: (x - 1.4, y + 0.7)).astype(float)
    falling = moved * np.linspace(1.0, 0.5, SHAPE[1])
    flow = follow(still, np.round(falling).astype(np.uint8), grid)
    assert flow.found.mean() > 0.95
    assert np.median(errors(flow, grid + np.array([1.4, -0.7]))) < 0.1


def turned(texture, angle, scale):
    """Return an image turned and scaled about its middle, where points go, and the warp."""
    c, s = np.cos(angle) / scale, np.sin(angle) / scale
    warp = np.array([[c, s], [-s, c]])  # template offset per target offset
    middle = np.array([SHAPE[1], SHAPE[0]]) / 2

    def back(x, y):
        dx, dy = x - middle[0], y - middle[1]
        return (
            middle[0] + warp[0, 0] * dx + warp[0, 1] * dy,
            middle[1] + warp[1, 0] * dx + warp[1, 1] * dy,
        )

    return texture.image(SHAPE, back), lambda p: middle + (p - middle) @ np.linalg.inv(warp).T, warp


@pytest.mark.parametrize(("angle", "scale"), [(0.5, 1.0), (0.0, 1.3), (-0.9, 0.8), (3.1, 1.1)])
def test_a_known_warp_makes_turns_and_zooms_exact(texture, still, angle, scale):
    image, forth, warp = turned(texture, angle, scale)
    x, y = np.meshgrid(np.arange(75.2, 150, 9.3), np.arange(60.4, 125, 9.1))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    guess = forth(points) + np.array([1.3, -0.9])
    warps = np.tile(warp, (len(points), 1, 1))
    flow = follow(still, image, points, guess, warp=warps)
    assert flow.found.mean() > 0.97
    assert errors(flow, forth(points)).max() < 0.08
    assert np.median(errors(flow, forth(points))) < 0.02
    without = follow(still, image, points, guess)
    assert without.found.mean() < 0.6 * flow.found.mean() or np.median(
        errors(without, forth(points))
    ) > 5 * np.median(errors(flow, forth(points)))


def test_patches_without_texture_or_with_an_edge_only_are_not_found(grid):
    flat = np.full(SHAPE, 90, np.uint8)
    assert not follow(flat, flat, grid).found.any()
    x = np.arange(SHAPE[1])
    edges = np.tile(np.round(128 + 80 * np.sin(x / 4.0)), (SHAPE[0], 1)).astype(np.uint8)
    assert not follow(edges, edges, grid).found.any()


def test_little_is_found_in_another_image(scene, grid):
    flow = follow(scene, np.ascontiguousarray(scene[::-1, ::-1]), grid)
    assert flow.found.mean() < 0.15
    assert follow(scene, scene, grid).found.mean() > 0.9


def test_points_that_leave_the_image_or_are_nowhere_are_not_found(texture, still):
    moved = texture.image(SHAPE, lambda x, y: (x - 12, y))
    points = np.array([[212.0, 90.0], [100.0, 90.0], [100.0, 91.0], [np.nan, 5.0], [-30.0, 2e9]])
    guess = points + np.array([12, 0])
    guess[2] = np.nan
    flow = follow(still, moved, points, guess)
    assert flow.found.tolist() == [False, True, False, False, False]
    assert flow.correlation[[0, 2, 3, 4]].tolist() == [0, 0, 0, 0]
    np.testing.assert_allclose(flow.points[1], [112, 90], atol=0.03)


def test_no_points_are_no_trouble(still):
    flow = follow(still, still, np.empty((0, 2)))
    assert flow.points.shape == (0, 2)
    assert flow.found.shape == (0,)


def test_backward_tracking_rejects_what_is_covered(texture, other_texture, still, grid):
    shift = np.array([2.3, 1.1])
    moved = texture.image(SHAPE, lambda x, y: (x - shift[0], y - shift[1]))
    covered = moved.copy()
    covered[:, 80:140] = other_texture.image(SHAPE)[:, 80:140]
    off = np.abs(grid[:, 0] + shift[0] - 109.5)
    behind, beside = off < 22, off > 38
    assert behind.sum() >= 15
    trusting = FlowConfig(min_correlation=0.3, max_backward_px=0.0)
    careful = FlowConfig(min_correlation=0.3)
    wrong = follow(still, covered, grid, config=trusting)
    checked = follow(still, covered, grid, config=careful)
    assert wrong.found[behind].sum() >= 3
    assert checked.found[behind].sum() <= 0.4 * wrong.found[behind].sum()
    assert checked.found[beside].mean() > 0.95


def test_a_wrong_guess_is_not_confirmed_by_its_own_way_back(grid):
    """A repeated pattern has a match at every period: going back from the wrong one must show."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    image = np.round(128 + 50 * np.sin(x * 2 * np.pi / 12) + 50 * np.sin(y * 2 * np.pi / 12))
    image = image.astype(np.uint8)
    right = follow(image, image, grid, grid + np.array([0.7, -0.5]), FlowConfig(levels=1))
    assert right.found.mean() > 0.95
    assert errors(right, grid).max() < 0.03


def test_coarse_levels_reach_further(texture, still, grid):
    moved = texture.image(SHAPE, lambda x, y: (x - 11, y))
    fine = follow(still, moved, grid, config=FlowConfig(levels=1))
    coarse = follow(still, moved, grid, config=FlowConfig(levels=3))
    assert coarse.found.mean() > 0.94
    assert np.mean(fine.found & (np.linalg.norm(fine.points - grid - (11, 0), axis=1) < 1)) < 0.7


def test_a_pyramid_halves_pixel_coordinates(texture):
    smooth = texture.image((120, 160), lambda x, y: (x / 4, y / 4))
    images = pyramid(smooth, 3)
    assert [i.shape for i in images] == [(120, 160), (60, 80), (30, 40)]
    inner = (slice(3, -3), slice(3, -3))
    for level in (1, 2):
        step = 2**level
        here = images[0][::step, ::step].astype(float)[inner]
        assert np.abs(images[level].astype(float)[inner] - here).mean() < 1.5 * level
    assert pyramid(smooth, 1)[0] is smooth


def test_what_is_not_aligned_stays_where_it_was_guessed(still):
    guess = np.array([[50.0, 60.0]])
    flat = np.full(SHAPE, 90, np.uint8)
    found = align_patches(flat, still, guess, guess + 3, np.eye(2)[None], 6, 10)
    np.testing.assert_array_equal(found.points, guess + 3)
    assert not found.found[0]


def test_facing_warp_is_the_derivative_of_the_view_of_a_facing_plane():
    rng = np.random.default_rng(4)
    for _ in range(20):
        angle = rng.normal(0, 0.2, 3)
        K = np.array([[0, -angle[2], angle[1]], [angle[2], 0, -angle[0]], [-angle[1], angle[0], 0]])
        R = np.linalg.qr(np.eye(3) + K)[0]
        R *= np.sign(np.diag(R))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, rng.normal(0, 0.3, 3)
        centre = rng.uniform([-1, -1, 2], [1, 1, 6])

        def seen(xy, centre=centre, T=T):
            """Project a point of the plane z = centre z, given by its image, into the template."""
            p = T[:3, :3] @ (np.append(xy, 1.0) * centre[2]) + T[:3, 3]
            return p[:2] / p[2]

        xy, h = centre[:2] / centre[2], 1e-6
        columns = [(seen(xy + d) - seen(xy - d)) / (2 * h) for d in h * np.eye(2)]
        np.testing.assert_allclose(
            facing_warp(centre[None], T)[0], np.stack(columns, axis=1), rtol=1e-6, atol=1e-8
        )


def test_patches_are_sampled_inside_the_image_only():
    """Rounding to single precision must not reach over the border: plain Python would raise."""
    sample = getattr(_sample_template, "py_func", _sample_template)
    image = np.arange(24 * 24, dtype=np.uint8).reshape(24, 24)
    patch = np.empty(49, np.float32)
    rng = np.random.default_rng(0)
    sampled = 0
    for _ in range(1500):
        B = np.eye(2) * rng.uniform(0.7, 1.4) + rng.normal(0, 0.2, (2, 2)) * rng.integers(0, 2)
        reach = (3.0 + rng.integers(0, 2) * 0.001) * np.abs(B).sum(axis=1)
        # On the very border, and a rounding error to either side of it.
        corner = np.where(rng.random(2) < 0.5, reach, 23.0 - reach)
        x, y = corner + rng.integers(-3, 4, 2) * 1e-7
        sampled += bool(sample(image, x, y, B, 2, patch))
    assert 100 < sampled < 1400
