"""Disparities of textures that are functions: what is true is known to any digit."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.vision.stereo import StereoConfig, match_sparse, sgbm_disparity

SHAPE = (120, 260)
CONFIG = StereoConfig(max_disparity_px=64)


@pytest.fixture(scope="module")
def left(texture):
    return texture.image(SHAPE)


@pytest.fixture(scope="module")
def points():
    x, y = np.meshgrid(np.arange(80, 245, 9), np.arange(12, 110, 8))
    rng = np.random.default_rng(0)
    return np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-0.5, 0.5, (x.size, 2))


def right_of(texture, disparity, down=0.0):
    """Return the right image of a wall: what is at x on the left is at x − disparity."""
    return texture.image(SHAPE, lambda x, y: (x + disparity, y - down))


@pytest.mark.parametrize("disparity", [0.5, 5.0, 10.25, 10.5, 10.75, 33.4])
def test_disparities_are_measured_without_pull_to_whole_pixels(texture, left, points, disparity):
    found = match_sparse(left, right_of(texture, disparity), points, CONFIG)
    good = np.isfinite(found)
    assert good.mean() > 0.85
    off = found[good] - disparity
    assert abs(np.mean(off)) < 0.005
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert np.abs(off).max() < 0.2


def test_a_slanted_wall(texture, left, points):
    """x_left − x_right = 8 + 0.08 (x_left − 80): surfaces seldom face the camera."""

    def left_of(x, y):
        return (x + 8 - 0.08 * 80) / (1 - 0.08), y

    found = match_sparse(left, texture.image(SHAPE, left_of), points, CONFIG)
    good = np.isfinite(found)
    assert good.mean() > 0.8
    off = (found - (8 + 0.08 * (points[:, 0] - 80)))[good]
    assert abs(off.mean()) < 0.02
    assert np.median(np.abs(off)) < 0.08


def test_exposure_of_the_two_cameras_may_differ(texture, left, points):
    right = np.round(0.9 * right_of(texture, 12.3) + 8).astype(np.uint8)
    found = match_sparse(left, right, points, CONFIG)
    good = np.isfinite(found)
    assert good.mean() > 0.9
    off = np.abs(found[good] - 12.3)
    assert np.median(off) < 0.02
    assert np.mean(off > 0.1) < 0.02


@pytest.mark.parametrize("down", [0.35, -0.35])
def test_rows_may_be_off_by_a_third_of_a_pixel(texture, left, points, down):
    found = match_sparse(left, right_of(texture, 15.2, down), points, CONFIG)
    good = np.isfinite(found)
    assert good.mean() > 0.6
    assert abs(np.mean(found[good]) - 15.2) < 0.01


def test_rows_that_disagree_are_refused(texture, left, points):
    found = match_sparse(left, right_of(texture, 15.2, 2.5), points, CONFIG)
    assert np.isfinite(found).mean() < 0.03


def test_what_repeats_has_no_disparity_unless_it_is_known_nearly(points):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)

    def fence(x):
        return np.round(128 + 60 * np.sin(2 * np.pi * x / 11) + 40 * np.sin(y / 5)).astype(np.uint8)

    left, right = fence(x), fence(x + 20.3)
    assert not np.isfinite(match_sparse(left, right, points, CONFIG)).any()
    n = len(points)
    found = match_sparse(left, right, points, CONFIG, np.full(n, 17.0), np.full(n, 24.0))
    good = np.isfinite(found)
    assert good.mean() > 0.9
    assert np.abs(found[good] - 20.3).max() < 0.1


def test_only_the_range_asked_for_is_searched(texture, left, points):
    right, n = right_of(texture, 30.4), len(points)
    near, far = np.full(n, 26.0), np.full(n, 35.0)
    assert np.isfinite(match_sparse(left, right, points, CONFIG, near, far)).mean() > 0.85
    for low, high in ((0.0, 24.0), (36.0, 64.0), (30.4, 29.0), (500.0, 600.0)):
        found = match_sparse(left, right, points, CONFIG, np.full(n, low), np.full(n, high))
        assert np.isfinite(found).mean() < 0.08
    small = match_sparse(left, right, points, replace(CONFIG, max_disparity_px=24), near, far)
    assert not np.isfinite(small).any()


def test_a_pair_that_is_swapped_has_hardly_a_match(texture, left, points):
    found = match_sparse(left, right_of(texture, -20.0), points, CONFIG)
    assert np.isfinite(found).mean() < 0.1
    # Barely beyond infinity is searched, so that it shows.
    found = match_sparse(left, right_of(texture, -1.2), points, CONFIG)
    assert np.nanmedian(found) == pytest.approx(-1.2, abs=0.01)


def test_points_at_the_border_or_beyond_have_none(texture, left):
    right = right_of(texture, 20.0)
    points = np.array(
        [
            [2.0, 60.0],
            [258.0, 60.0],
            [120.0, 1.0],
            [120.0, 118.5],
            [-40.0, 60.0],
            [1e6, 60.0],
            [120.0, 60.0],
        ]
    )
    found = match_sparse(left, right, points, CONFIG)
    assert np.isnan(found[:-1]).all()
    assert found[-1] == pytest.approx(20.0, abs=0.05)
    assert match_sparse(left, right, points[:0], CONFIG).shape == (0,)


def test_blank_images_and_different_ones_have_none(left, other_texture, points):
    blank = np.full(SHAPE, 77, np.uint8)
    assert not np.isfinite(match_sparse(left, blank, points, CONFIG)).any()
    assert not np.isfinite(match_sparse(blank, blank, points, CONFIG)).any()
    other = other_texture.image(SHAPE)
    assert np.isfinite(match_sparse(left, other, points, CONFIG)).mean() < 0.05


def test_the_error_is_that_of_the_noise(texture, left, points):
    """Twice the noise of the pictures, twice the noise of the disparities."""
    rng = np.random.default_rng(7)
    right = right_of(texture, 14.6).astype(float)
    spreads = []
    for noise in (2.0, 4.0):
        noisy = (left + rng.normal(0, noise, SHAPE)).round().clip(0, 255).astype(np.uint8)
        other = (right + rng.normal(0, noise, SHAPE)).round().clip(0, 255).astype(np.uint8)
        found = match_sparse(noisy, other, points, CONFIG)
        off = found[np.isfinite(found)] - 14.6
        assert len(off) > 0.8 * len(points)
        assert abs(np.median(off)) < 0.02
        spreads.append(1.4826 * np.median(np.abs(off)))
    assert 0.01 < spreads[0] < 0.1
    assert spreads[1] / spreads[0] == pytest.approx(2.0, rel=0.35)


def test_dense_disparities(texture, left):
    dense = sgbm_disparity(left, right_of(texture, 18.0), CONFIG)
    assert dense.shape == SHAPE
    assert dense.dtype == np.float32
    inner = dense[8:-8, 90:-8]
    assert np.isfinite(inner).mean() > 0.95
    assert np.nanmedian(inner) == pytest.approx(18.0, abs=0.07)
    assert np.nanmin(dense) > 0
    assert np.isnan(dense[:, :10]).all()  # the right camera does not see it
    blank = np.full(SHAPE, 77, np.uint8)
    assert not np.isfinite(sgbm_disparity(blank, blank, CONFIG)).any()


@pytest.mark.parametrize("largest", [1, 16, 40, 64])
def test_dense_matching_reaches_as_far_as_asked(texture, left, largest):
    dense = sgbm_disparity(left, right_of(texture, 35.0), replace(CONFIG, max_disparity_px=largest))
    right = np.abs(dense[8:-8, 90:-8] - 35) < 1
    assert right.mean() > 0.9 if largest >= 40 else right.mean() < 0.01
