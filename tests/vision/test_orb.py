"""ORB: spread over the image and its levels, the same bits as OpenCV's, turning with the image."""

import cv2
import numpy as np
import pytest

import reference
from odomap.errors import ConfigError
from odomap.vision.brief import BORDER_PX, rotated_brief
from odomap.vision.fast import fast_corners, refine
from odomap.vision.orb import OrbConfig, describe_at, extract

CONFIG = OrbConfig(count=300)
CIRCLE = [(0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3)]
CIRCLE += [(-x, -y) for x, y in CIRCLE]


@pytest.fixture(scope="module")
def features(scene):
    return extract(scene, CONFIG)


def score(image, x, y):
    """Largest difference at which 9 contiguous pixels of the circle still pass."""
    d = np.array([int(image[y + v, x + u]) - int(image[y, x]) for u, v in CIRCLE])
    arcs = np.stack([np.roll(d, -k)[:9] for k in range(16)])
    return max(arcs.min(axis=1).max(), (-arcs).min(axis=1).max(), 0)


def test_fast_scores_are_those_of_the_definition(scene):
    _, scores = fast_corners(scene, 10)
    rng = np.random.default_rng(0)
    for x, y in rng.integers([3, 3], [437, 297], (300, 2)).tolist():
        assert scores[y, x] == score(scene, x, y)


@pytest.mark.parametrize("threshold", [7, 20, 60])
def test_fast_corners_are_the_peaks(scene, threshold):
    corners, scores = fast_corners(scene, threshold, 8)
    inner = scores[8:-8, 8:-8].astype(int)
    around = [scores[8 + v : 292 + v, 8 + u : 432 + u] for u in (-1, 0, 1) for v in (-1, 0, 1)]
    highest = np.max(around, axis=0)
    peaks = (inner == highest) & (inner > threshold)
    alone = np.sum([a == highest for a in around], axis=0) == 1
    x, y, s = corners.T
    found = np.zeros_like(peaks)
    found[y - 8, x - 8] = True
    assert not np.any(found & ~peaks)
    assert not np.any(peaks & alone & ~found)
    assert np.array_equal(s, scores[y, x])
    blocks = [found[v : v + 283, u : u + 423] for u in (0, 1) for v in (0, 1)]
    assert np.sum(blocks, axis=0).max() == 1  # of a plateau one is left
    theirs = cv2.FastFeatureDetector.create(threshold, True).detect(scene, None)
    theirs = {(round(k.pt[0]), round(k.pt[1])) for k in theirs}
    ours = set(zip(x.tolist(), y.tolist()))
    assert {p for p in theirs if 8 <= p[0] < 432 and 8 <= p[1] < 292} <= ours


def test_sub_pixel_positions_follow_a_shift(texture):
    shift = 0.4
    before = texture.image((240, 320))
    after = texture.image((240, 320), lambda x, y: (x - shift, y))
    a, b = (fast_corners(i, 15, 16) for i in (before, after))
    p, q = refine(*a).astype(float), refine(*b).astype(float)
    d = np.linalg.norm(p[:, None] + [shift, 0] - q[None], axis=2)
    near = d.min(axis=1) < 1.0
    assert near.sum() > 15
    moved = q[d.argmin(axis=1)][near] - p[near]
    whole = b[0][d.argmin(axis=1), :2][near] - a[0][near, :2]
    error = np.abs(moved[:, 0] - shift).mean()
    assert error < 0.75 * np.abs(whole[:, 0] - shift).mean()
    assert abs(moved[:, 0].mean() - shift) < 0.1
    assert np.abs(p - a[0][:, :2]).max() <= 0.5


def test_features_are_all_over_the_image_and_on_all_levels(features):
    assert 290 <= len(features) <= 300
    x, y = features.keypoints.T
    assert features.keypoints.dtype == np.float32
    cells = np.histogram2d(y, x, bins=(4, 5), range=((16, 284), (16, 424)))[0]
    assert (cells > 3).all()
    counts = np.bincount(features.level)
    assert len(counts) == 8
    assert np.all(counts[:4] > counts[1:5])
    assert (features.strength > CONFIG.least_threshold).all()
    assert features.angle.min() >= 0
    assert features.angle.max() < 360


def test_the_same_image_gives_the_same_features(scene, features):
    again = extract(np.asfortranarray(scene), CONFIG)
    for name in ("keypoints", "level", "angle", "strength", "descriptors"):
        np.testing.assert_array_equal(getattr(again, name), getattr(features, name))


def test_descriptors_are_those_of_opencv():
    """Where position, level and angle agree, nearly all bits do."""
    rng = np.random.default_rng(1)
    waves = [rng.uniform(0, 255 / 3, (540 // k, 780 // k)) for k in (4, 12, 36)]
    image = sum(cv2.resize(w, (780, 540), interpolation=cv2.INTER_CUBIC) for w in waves)
    image = image.round().clip(0, 255).astype(np.uint8)
    keypoints, theirs = cv2.ORB.create(600).detectAndCompute(image, None)
    levels = np.array([k.octave for k in keypoints], np.uint8)
    scale = 1.2 ** levels[:, None].astype(float)
    pixels = np.round(np.array([k.pt for k in keypoints]) / scale)  # of the level, as OpenCV's
    size = np.array([780, 540])
    ratio = size / np.round(size / scale)
    ours, kept = describe_at(image, ((pixels + 0.5) * ratio - 0.5).astype(np.float32), levels)
    assert len(kept) == len(keypoints) > 500
    bits = np.diag(reference.distances(ours, theirs[kept]))
    assert bits[levels == 0].mean() < 0.5
    assert bits.mean() < 6  # on coarser levels images are reduced with another rounding
    assert set(levels.tolist()) == set(range(8))


def test_what_is_extracted_is_what_is_described(scene, features):
    # Sub-pixel positions round to the whole pixel they came from, but for ties.
    again, kept = describe_at(scene, features.keypoints, features.level)
    assert len(kept) > 0.98 * len(features)
    same = (again == features.descriptors[kept]).all(axis=1)
    assert same.mean() > 0.95


def test_descriptors_turn_with_the_image(scene):
    rng = np.random.default_rng(2)
    points = rng.integers(25, [415, 275], (200, 2)).astype(np.float32)
    turned = np.ascontiguousarray(np.rot90(scene, -1))  # (x, y) goes to (H - 1 - y, x)
    there = np.stack([299 - points[:, 1], points[:, 0]], axis=1)
    a, _ = describe_at(scene, points)
    b, _ = describe_at(turned, there)
    bits = reference.distances(a, b)
    assert np.diag(bits).mean() < 2
    assert np.median(bits) > 100
    before, _ = rotated_brief(scene, points.astype(np.int32))
    after, _ = rotated_brief(turned, there.astype(np.int32))
    np.testing.assert_allclose((after - before) % 360, 90, atol=0.01)


def test_the_angle_is_that_of_a_ramp():
    y, x = np.mgrid[:64, :64]
    for degrees in (0, 30, 135, 250):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        ramp = np.round(128 + 2 * ((x - 32) * c + (y - 32) * s)).astype(np.uint8)
        angle, _ = rotated_brief(ramp, np.array([[32, 32]], np.int32))
        assert abs(float(angle[0]) - degrees + 180) % 360 - 180 == pytest.approx(0, abs=0.5)


def test_a_smaller_image_shows_its_features_on_finer_levels(scene):
    big = cv2.resize(scene, None, fx=1.44, fy=1.44, interpolation=cv2.INTER_LINEAR)
    a, b = extract(scene, OrbConfig(count=600)), extract(big, OrbConfig(count=800))
    there = (a.keypoints + 0.5) * 1.44 - 0.5
    bits = reference.distances(a.descriptors, b.descriptors)
    best = bits.argmin(axis=1)
    close = np.linalg.norm(b.keypoints[best] - there, axis=1) < 3 * 1.2**a.level
    close &= bits.min(axis=1) < 40
    assert close.sum() > 150
    step = b.level[best].astype(int)[close] - a.level[close]
    assert np.median(step) == 2
    assert np.mean(np.abs(step - 2) <= 1) > 0.9


def test_nothing_is_taken_outside_the_mask(scene):
    mask = np.zeros(scene.shape, bool)
    mask[:, 200:] = True
    found = extract(scene, CONFIG, mask)
    assert len(found) > 200
    assert (found.keypoints[:, 0] >= 199).all()


def test_weak_corners_come_only_where_there_are_no_strong_ones(scene):
    faint = scene.copy()
    faint[:, :220] = np.round(128 + (scene[:, :220].astype(float) - 128) * 0.07)
    config = OrbConfig(count=100, levels=1)
    found = extract(faint, config)
    left = found.keypoints[:, 0] < 200
    assert left.sum() >= 8
    assert (found.strength[left] <= 20).all()
    assert np.mean(found.strength[~left] > 20) > 0.95
    strict = extract(faint, OrbConfig(count=100, levels=1, least_threshold=20))
    assert np.sum(strict.keypoints[:, 0] < 200) < left.sum() / 4


def test_many_are_not_more_than_there_are(scene):
    few = extract(scene, OrbConfig(count=1, levels=1))
    assert len(few) == 1
    some, all_of_them = (extract(scene, OrbConfig(count=n, levels=1)) for n in (200, 10**6))
    corners, _ = fast_corners(scene, 7, BORDER_PX)
    assert len(some) == 200
    assert 200 < len(all_of_them) <= len(corners)
    assert len(np.unique(all_of_them.keypoints, axis=0)) == len(all_of_them)


@pytest.mark.parametrize("shape", [(0, 0), (10, 400), (33, 33), (120, 160)])
def test_blank_and_small_images_have_none(shape):
    blank = np.full(shape, 90, np.uint8)
    found = extract(blank, CONFIG)
    assert found.keypoints.shape == (0, 2)
    assert found.descriptors.shape == (0, 32)
    assert describe_at(blank, found.keypoints)[0].shape == (0, 32)


def test_points_at_the_border_or_nowhere_are_left_out(scene):
    points = [[15, 50], [16, 16], [np.nan, 40], [423, 283], [424, 100], [1e9, -1e9], [100, 100]]
    descriptors, kept = describe_at(scene, np.array(points, np.float32))
    assert kept.tolist() == [1, 3, 6]
    assert descriptors.shape == (3, 32)
    none, of = describe_at(scene, np.array([[100, 100]], np.float32), np.array([60], np.uint8))
    assert none.shape == (0, 32)
    assert of.tolist() == []


def test_thresholds_must_be_in_order():
    with pytest.raises(ConfigError, match="least_threshold: 30 must be at most threshold, 20"):
        OrbConfig(least_threshold=30)
    with pytest.raises(ConfigError, match="scale"):
        OrbConfig(scale=1.0)
