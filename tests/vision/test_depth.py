"""Depth between pixels: exact on planes, bridged over holes, unknown where objects end."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.vision.depth import DepthConfig, inverse_depth_at

CONFIG = DepthConfig()
FOCAL = 250.0
SHAPE = (120, 160)


def plane(normal=(0.0, -0.6, 0.8), distance=1.5, shape=SHAPE):
    """Return depth (H, W) of the plane n·x = d, and its inverse depth at any pixels."""
    normal = np.array(normal) / np.linalg.norm(normal)
    height, width = shape

    def inverse(pixels):
        x, y = ((np.asarray(pixels) - (width / 2, height / 2)) / FOCAL).T
        return (normal[0] * x + normal[1] * y + normal[2]) / distance

    v, u = np.mgrid[:height, :width]
    grid = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    return (1.0 / inverse(grid)).reshape(shape).astype(np.float32), inverse


def between(count, seed=0, shape=SHAPE, rim=3.0):
    rng = np.random.default_rng(seed)
    return rng.uniform([rim, rim], [shape[1] - 1 - rim, shape[0] - 1 - rim], (count, 2))


def twin(depth, pixels, config):
    """The rule in words, one point at a time."""
    height, width = depth.shape
    ok = (depth >= config.nearest) & (depth <= config.farthest)
    out = []
    for x, y in pixels:
        value = np.nan
        if 0 <= x <= width - 1 and 0 <= y <= height - 1:
            c, r = min(int(x), width - 2), min(int(y), height - 2)
            four = depth[r : r + 2, c : c + 2].astype(float)
            if ok[r : r + 2, c : c + 2].all() and np.ptp(four) <= config.edge * four.min():
                a, b = x - c, y - r
                value = np.array([1 - b, b]) @ (1.0 / four) @ np.array([1 - a, a])
            else:
                r, c = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
                around = np.s_[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3]
                known = np.sort(depth[around][ok[around]].astype(float))
                if len(known) >= 6 and known[-1] - known[0] <= config.edge * known[0]:
                    value = 1.0 / known[len(known) // 2]
        out.append(value)
    return np.array(out)


@pytest.mark.parametrize(
    ("normal", "distance"),
    [
        ((0, 0, 1), 2.0),  # a wall ahead
        ((0.0, -0.9, 0.45), 1.0),  # a floor
        ((0.6, 0.1, 0.8), 3.0),  # a wall aside
    ],
)
def test_slanted_planes_are_read_exactly_between_pixels(normal, distance):
    depth, inverse = plane(normal, distance)
    pixels = between(200)
    pixels = pixels[(1 / inverse(pixels) < 7.5) & (1 / inverse(pixels) > 0.3)]
    assert len(pixels) > 80
    found = inverse_depth_at(depth, pixels, CONFIG)
    # Depth is stored in 24 bits; nothing else is lost.
    np.testing.assert_allclose(found, inverse(pixels), rtol=3e-7)


def test_the_nearest_pixel_would_be_centimetres_off():
    """A floor 1.2 m below a level camera, seen at two to four metres."""
    normal = np.array([0.0, 1.0, 0.05])
    depth, inverse = plane(normal, 1.2, (240, 160))
    pixels = between(400, shape=(240, 160))
    true = 1.0 / inverse(pixels)
    keep = (true > 2.0) & (true < 4.0)
    pixels, true = pixels[keep], true[keep]
    found = 1.0 / inverse_depth_at(depth, pixels, CONFIG)
    column, row = np.floor(pixels + 0.5).astype(int).T
    nearest = depth[row, column].astype(float)
    assert np.abs(nearest - true).max() > 0.015
    assert np.sqrt(np.mean((nearest - true) ** 2)) > 0.007
    assert np.abs(found - true).max() < 1e-5


def test_where_an_object_ends_depth_is_not_known():
    depth = np.full(SHAPE, 3.0, np.float32)
    depth[:, 80:] = 1.0
    at = np.array([[79.5, 60.0], [79.0, 60.2], [80.0, 60.0], [77.4, 60.0], [82.6, 60.0]])
    found = inverse_depth_at(depth, at, CONFIG)
    # Between the two nothing is known; a pixel that is all on one side knows its own.
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2:], [1.0, 1 / 3, 1.0])


def test_the_edge_is_a_fraction_of_depth():
    for depth_m in (0.5, 4.0):
        for step, known in ((0.9 * CONFIG.edge, True), (1.1 * CONFIG.edge, False)):
            depth = np.full(SHAPE, depth_m, np.float32)
            depth[:, 80:] *= 1 + step
            found = inverse_depth_at(depth, np.array([[79.5, 60.5]]), CONFIG)
            assert np.isfinite(found).all() == known


@pytest.mark.parametrize("invalid", [0.0, np.nan, np.inf, -1.0, 20.0, 0.05])
def test_holes_are_bridged_by_the_median(invalid):
    depth, inverse = plane()
    at = np.array([[50.3, 40.6]])
    expected = inverse(at)
    depth[40, 50] = invalid
    found = inverse_depth_at(depth, at, CONFIG)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, expected, rtol=0.01)
    # Not so one that is all hole.
    depth[36:45, 46:55] = invalid
    assert np.isnan(inverse_depth_at(depth, at, CONFIG)).all()


def test_too_few_pixels_around_a_hole_are_not_believed():
    depth = np.zeros(SHAPE, np.float32)
    depth[40, 50:55] = 2.0
    at = np.array([[52.0, 40.0]])
    assert np.isnan(inverse_depth_at(depth, at, CONFIG)).all()
    depth[41, 52] = 2.0
    np.testing.assert_allclose(inverse_depth_at(depth, at, CONFIG), 0.5)


def test_depth_out_of_range_is_not_believed():
    at = np.array([[50.5, 40.5]])
    for z, known in ((0.19, False), (0.21, True), (7.9, True), (8.1, False), (65.535, False)):
        found = inverse_depth_at(np.full(SHAPE, z, np.float32), at, CONFIG)
        assert np.isfinite(found).all() == known


def test_borders():
    depth, inverse = plane((0.1, 0.1, 1.0), 2.0)
    height, width = SHAPE
    inside = np.array(
        [[0.0, 0.0], [width - 1, height - 1], [width - 1, 0.5], [0.5, height - 1], [0.0, 60.5]]
    )
    np.testing.assert_allclose(inverse_depth_at(depth, inside, CONFIG), inverse(inside), rtol=1e-6)
    outside = np.array(
        [
            [-1e-9, 5.0],
            [5.0, -0.3],
            [width - 1 + 1e-9, 5.0],
            [5.0, height - 0.5],
            [np.nan, 5.0],
            [5.0, np.nan],
            [np.inf, 5.0],
            [-1e18, 1e18],
        ]
    )
    assert np.isnan(inverse_depth_at(depth, outside, CONFIG)).all()
    # A hole in the corner: the window ends where the image does.
    depth[0, 0] = 0
    found = inverse_depth_at(depth, np.array([[0.2, 0.2]]), CONFIG)
    np.testing.assert_allclose(found, inverse([[0.2, 0.2]]), rtol=0.02)


def test_the_kernel_is_its_twin():
    rng = np.random.default_rng(2)
    depth, _ = plane((0.3, -0.4, 0.8), 2.0)
    depth[:, 100:] *= 0.6
    depth[rng.random(SHAPE) < 0.25] = 0
    depth[20:40, 20:50] = 0
    depth[rng.random(SHAPE) < 0.02] = np.nan
    depth[80:, :40] = 9.0
    pixels = np.concatenate(
        [
            rng.uniform([-2, -2], [SHAPE[1] + 1, SHAPE[0] + 1], (1500, 2)),
            rng.integers(0, [SHAPE[1], SHAPE[0]], (300, 2)),
            rng.integers(0, [SHAPE[1], SHAPE[0]], (300, 2)) + 0.5,
        ]
    )
    found = inverse_depth_at(depth, pixels, CONFIG)
    expected = twin(depth, pixels, CONFIG)
    np.testing.assert_allclose(found, expected, rtol=1e-12, equal_nan=True)
    share = np.isfinite(found).mean()
    assert 0.3 < share < 0.9


def test_any_layout_and_no_points():
    depth, inverse = plane()
    pixels = between(20)
    found = inverse_depth_at(np.asfortranarray(depth), pixels, CONFIG)
    np.testing.assert_allclose(found, inverse(pixels), rtol=1e-6)
    assert inverse_depth_at(depth, np.empty((0, 2)), CONFIG).shape == (0,)
    assert np.isnan(inverse_depth_at(np.zeros((1, 1), np.float32), pixels, CONFIG)).all()
    with pytest.raises(InputError, match=r"depth: shape \(120, 160, 1\)"):
        inverse_depth_at(depth[:, :, None], pixels, CONFIG)
