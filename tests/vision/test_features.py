"""Corners: strong ones, everywhere, at a distance from each other."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import reference
from odomap.vision.features import (
    Corners,
    FeatureConfig,
    corner_strength,
    describe,
    detect,
    spread,
)

DETECTORS = ["fast", "harris", "orb", "sift"]
NONE = np.empty((0, 2), np.float32)


def nearest(points, others):
    """Distance of each point to the nearest of the others, itself left out."""
    d = np.linalg.norm(points[:, None].astype(float) - others[None].astype(float), axis=2)
    if points is others:
        np.fill_diagonal(d, np.inf)
    return d.min(axis=1)


def test_corner_strength_is_the_smaller_eigenvalue(scene):
    rng = np.random.default_rng(0)
    points = rng.integers([4, 4], [436, 296], (200, 2))
    expected = [reference.corner_strength(scene, x, y) for x, y in points.tolist()]
    found = corner_strength(scene, points.astype(np.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert np.max(expected) > 100


def test_corner_strength_tells_a_corner_from_an_edge_and_is_zero_at_the_border():
    image = np.zeros((40, 40), np.uint8)
    image[20:, 20:] = 200
    corner, edge, flat, border = corner_strength(
        image, np.array([[20, 20], [20, 33], [8, 8], [3, 20]], np.float32)
    )
    assert corner > 100
    assert (edge, flat, border) == pytest.approx((0, 0, 0), abs=1e-9)


@pytest.mark.parametrize(
    ("count", "radius", "others"),
    [(60, 14.0, 0), (60, 14.0, 30), (500, 9.0, 10), (40, 0.5, 5), (5, 300.0, 0)],
)
def test_spread_is_the_greedy_choice(count, radius, others):
    rng = np.random.default_rng(count)
    points = rng.uniform(0, [280, 200], (400, 2)).astype(np.float32)
    points[50:60] = points[:10]  # the same place twice
    strength = rng.integers(0, 50, 400).astype(float)  # many ties
    occupied = rng.uniform(-5, [285, 205], (others, 2)).astype(np.float32)
    chosen = spread(points, strength, count, radius, (200, 280), occupied)
    assert chosen.tolist() == reference.spread(points, strength, count, radius, occupied)


def test_spread_keeps_its_distance_and_takes_the_strongest():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, [280, 200], (3000, 2)).astype(np.float32)
    strength = rng.uniform(0, 1, 3000)
    occupied = rng.uniform(0, [280, 200], (20, 2)).astype(np.float32)
    chosen = spread(points, strength, 50, 12.0, (200, 280), occupied)
    assert len(chosen) == 50
    assert nearest(points[chosen], points[chosen].copy()).min() == 0.0  # the twin set holds itself
    picked = points[chosen]
    assert nearest(picked, picked).min() >= 12.0
    assert nearest(picked, occupied).min() >= 12.0
    free = nearest(points, occupied) >= 12.0
    assert chosen[0] == np.flatnonzero(free)[np.argmax(strength[free])]


def test_spread_of_nothing():
    empty = spread(NONE, np.empty(0), 10, 5.0, (200, 280), NONE)
    assert empty.shape == (0,)
    one = np.array([[3.0, 4.0]], np.float32)
    assert spread(one, np.ones(1), 0, 5.0, (200, 280), NONE).shape == (0,)


@pytest.mark.parametrize("detector", DETECTORS)
def test_detectors_find_corners_all_over_the_image(scene, detector):
    config = FeatureConfig(detector=detector, count=120)
    corners = detect(scene, config)
    assert 90 <= len(corners.keypoints) <= 120
    assert len(corners.strength) == len(corners.level) == len(corners.keypoints)
    assert corners.keypoints.dtype == np.float32
    x, y = corners.keypoints.T
    assert x.min() >= 12
    assert y.min() >= 12
    assert x.max() < 440 - 12
    assert y.max() < 300 - 12
    cells = np.histogram2d(y, x, bins=(4, 5), range=((31, 269), (31, 409)))[0]
    assert (cells > 0).all()
    assert cells.max() <= 16  # six in the mean: no crowd anywhere


@pytest.mark.parametrize("detector", DETECTORS)
def test_the_same_image_gives_the_same_corners(scene, detector):
    config = FeatureConfig(detector=detector, count=60)
    first, again = detect(scene, config), detect(scene.copy(), config)
    np.testing.assert_array_equal(first.keypoints, again.keypoints)
    np.testing.assert_array_equal(first.strength, again.strength)


@pytest.mark.parametrize("detector", DETECTORS)
def test_levels_are_those_of_a_pyramid_from_the_finest_on(scene, detector):
    level = detect(scene, FeatureConfig(detector=detector, count=150)).level
    assert level.min() == 0
    assert level.max() <= (7 if detector == "orb" else 6)
    assert np.mean(level == 0) > 0.3


@pytest.mark.parametrize("detector", DETECTORS)
def test_corners_stay_in_the_mask_and_away_from_what_is_tracked(scene, detector):
    config = FeatureConfig(detector=detector, count=60)
    mask = np.zeros(scene.shape, bool)
    mask[:, 90:] = True
    occupied = np.random.default_rng(2).uniform([90, 150], [440, 300], (60, 2)).astype(np.float32)
    corners = detect(scene, config, 60, occupied, mask)
    assert len(corners.keypoints) > 20
    assert corners.keypoints[:, 0].min() >= 90
    radius = 0.75 * np.sqrt(300 * 440 / 120)
    assert nearest(corners.keypoints, occupied).min() >= 0.5 * radius
    # Where nothing is tracked, more is found.
    assert np.mean(corners.keypoints[:, 1] < 150) > 0.55


def test_fewer_are_wanted_than_there_are(scene):
    assert len(detect(scene, FeatureConfig(), 7).keypoints) == 7
    assert len(detect(scene, FeatureConfig(), 0).keypoints) == 0
    assert len(detect(scene, FeatureConfig(), -3).keypoints) == 0


def test_fast_ranks_by_strength_in_the_finest_pass(scene):
    corners = detect(scene, FeatureConfig(count=20))
    assert corners.strength[0] == corners.strength.max()
    np.testing.assert_array_equal(corners.strength, corner_strength(scene, corners.keypoints))


def test_where_contrast_is_low_the_threshold_gives_way(scene):
    faint = np.round(128 + (scene.astype(float) - 128) * 0.07).astype(np.uint8)
    strict = cv2.FastFeatureDetector.create(12, True).detect(faint, None)
    found = detect(faint, FeatureConfig(threshold=12, count=60))
    assert len(found.keypoints) > len(strict)
    assert len(found.keypoints) >= 20


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("grey", [0, 128, 255])
def test_a_blank_image_has_no_corners(detector, grey):
    blank = np.full((120, 160), grey, np.uint8)
    corners = detect(blank, FeatureConfig(detector=detector))
    assert corners.keypoints.shape == (0, 2)
    assert describe(blank, corners, detector)[0].shape == (0, 128 if detector == "sift" else 32)


@pytest.mark.parametrize("detector", DETECTORS)
def test_descriptors_belong_to_the_corners_named(scene, detector):
    found = detect(scene, FeatureConfig(detector=detector, count=40))
    border = np.array([[2.0, 2.0], [438.0, 100.0]], np.float32)  # OpenCV may leave these out
    corners = Corners(
        np.concatenate([border[:1], found.keypoints, border[1:]]),
        np.ones(len(found.keypoints) + 2),
        np.concatenate([[0], found.level, [0]]).astype(np.uint8),
    )
    descriptors, kept = describe(scene, corners, detector)
    assert descriptors.shape == (len(kept), 128 if detector == "sift" else 32)
    assert descriptors.dtype == np.uint8
    assert len(set(kept.tolist())) == len(kept)
    assert len(kept) >= 0.6 * len(corners.keypoints)
    for row, k in list(zip(descriptors, kept))[::7]:
        one = Corners(corners.keypoints[k : k + 1], np.ones(1), corners.level[k : k + 1])
        alone, of = describe(scene, one, detector)
        assert of.tolist() == [0]
        np.testing.assert_array_equal(alone[0], row)


def test_binary_descriptors_turn_with_the_image(scene):
    corners = detect(scene, FeatureConfig(count=60, border_px=40))
    turned = np.ascontiguousarray(np.rot90(scene, -1))  # (x, y) goes to (H - 1 - y, x)
    x, y = corners.keypoints.T
    there = replace(corners, keypoints=np.stack([299 - y, x], axis=1).astype(np.float32))
    before, of_before = describe(scene, corners, "fast")
    after, of_after = describe(turned, there, "fast")
    both = np.intersect1d(of_before, of_after)
    assert len(both) >= 20
    a = before[np.searchsorted(of_before, both)]
    b = after[np.searchsorted(of_after, both)]
    bits = reference.distances(a, b)
    assert np.median(np.diag(bits)) < 30
    assert np.median(bits) > 100
    assert np.mean(bits.argmin(axis=1) == np.arange(len(both))) > 0.9
