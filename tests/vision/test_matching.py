"""Matching against a plain search through all pairs."""

import numpy as np
import pytest

import reference
from odomap.vision.hamming import as_words, hamming
from odomap.vision.matching import (
    EpipolarView,
    KeypointGrid,
    MatchConfig,
    match_all,
    match_epipolar,
    match_guided,
    match_projected,
    nearest,
)

CONFIG = MatchConfig()


def images(length, seed, number=80, noise=12, extra=30):
    """Return descriptors of two images that share most features, and (index in the second)."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 256, (number, length)).astype(np.uint8)
    if length == 32:
        flips = rng.random((number, 256)) < noise / 256
        second = first ^ np.packbits(flips, axis=1)
    else:
        first = (first // 3).astype(np.uint8)
        second = (first + rng.normal(0, noise, first.shape)).round().clip(0, 255).astype(np.uint8)
    others = rng.permutation(second.ravel()).reshape(second.shape)[:extra]
    order = rng.permutation(number + extra)
    second = np.concatenate([second, others])[order]
    return first, second, np.argsort(order)[:number]


@pytest.mark.parametrize("length", [32, 128])
def test_guided_matching_is_the_plain_search(length):
    first, second, truth = images(length, 1, noise=40 if length == 32 else 6)
    first[5:9] = first[4]  # several landmarks that look the same
    rng = np.random.default_rng(2)
    keypoints = rng.uniform(0, 90, (len(second), 2)).astype(np.float32)
    guess = rng.uniform(0, 90, (len(first), 2))
    guess[::2] = keypoints[truth[::2]] + rng.uniform(-20, 20, (len(first) // 2, 2))
    guess[3] = np.nan
    found = match_guided(first, guess, second, keypoints, CONFIG)
    near = np.linalg.norm(guess[:, None] - keypoints[None], axis=2) <= CONFIG.radius_px
    ratio = CONFIG.ratio if length == 32 else CONFIG.ratio**2
    limit = CONFIG.max_hamming if length == 32 else CONFIG.max_euclidean**2
    rows = reference.match_guided(near, reference.distances(first, second), ratio, limit)
    # Of landmarks that claim the same feature the nearest keeps it, of equals the first.
    best = {}
    for m, (n, d) in enumerate(rows):
        if n >= 0 and d < best.get(n, (np.inf, 0))[0]:
            best[n] = (d, m)
    expected = [n if n >= 0 and best[n][1] == m else -1 for m, (n, d) in enumerate(rows)]
    assert found.tolist() == expected
    assert 10 < np.sum(found >= 0) < len(first)


@pytest.mark.parametrize("length", [32, 128])
def test_guided_matching_finds_what_is_there(length):
    first, second, truth = images(length, 3)
    rng = np.random.default_rng(4)
    keypoints = rng.uniform(0, 300, (len(second), 2)).astype(np.float32)
    guess = keypoints[truth] + rng.uniform(-10, 10, (len(first), 2))
    found = match_guided(first, guess, second, keypoints, CONFIG)
    assert np.mean(found == truth) > 0.97
    far = match_guided(first, guess + 200, second, keypoints, CONFIG)
    assert not np.any(far == truth)


def test_no_feature_is_given_twice():
    one = np.random.default_rng(5).integers(0, 256, 32).astype(np.uint8)
    wanted = np.tile(one, (6, 1))
    wanted[:, 0] ^= np.array([7, 3, 1, 0, 1, 15], np.uint8)
    at = np.zeros((6, 2))
    found = match_guided(wanted, at, one[None], np.zeros((1, 2), np.float32), CONFIG)
    assert found.tolist() == [-1, -1, -1, 0, -1, -1]


def test_the_second_best_must_be_clearly_worse():
    rng = np.random.default_rng(6)
    one = rng.integers(0, 256, 32).astype(np.uint8)
    bits = np.unpackbits(one)
    ten, eleven, thirty = (np.packbits(bits ^ (np.arange(256) < n)) for n in (10, 11, 30))
    at, here = np.zeros((1, 2)), np.zeros((2, 2), np.float32)
    assert match_guided(one[None], at, np.stack([eleven, ten]), here, CONFIG).tolist() == [-1]
    assert match_guided(one[None], at, np.stack([thirty, ten]), here, CONFIG).tolist() == [1]
    # A rival out of reach is none.
    away = np.array([[100, 0], [0, 0]], np.float32)
    assert match_guided(one[None], at, np.stack([eleven, ten]), away, CONFIG).tolist() == [1]
    many = np.packbits(bits ^ (np.arange(256) < 65))
    assert match_guided(one[None], at, many[None], here[:1], CONFIG).tolist() == [-1]


@pytest.mark.parametrize("length", [32, 128])
def test_matching_of_whole_images_is_the_plain_search(length):
    first, second, truth = images(length, 7, noise=30 if length == 32 else 12)
    second[3:6] = second[2]  # something that repeats
    found = match_all(first, second, CONFIG)
    d = reference.distances(first, second)
    d = d if length == 32 else np.sqrt(d)
    limit = CONFIG.max_hamming if length == 32 else CONFIG.max_euclidean
    rows = reference.match_guided(np.ones_like(d, bool), d, CONFIG.ratio, limit)
    expected = [n if n >= 0 and d[:, n].argmin() == m else -1 for m, (n, _) in enumerate(rows)]
    assert found.tolist() == expected
    assert np.mean(found == truth) > 0.8


def test_what_is_not_seen_from_both_sides_is_no_match():
    rng = np.random.default_rng(8)
    a, b = rng.integers(0, 256, (2, 32)).astype(np.uint8)
    nearly = a.copy()
    nearly[0] ^= 1
    found = match_all(np.stack([nearly, a]), np.stack([a, b]), CONFIG)
    assert found.tolist() == [-1, 0]


@pytest.mark.parametrize("length", [32, 128])
def test_nothing_matches_nothing(length):
    none, some = np.empty((0, length), np.uint8), np.ones((5, length), np.uint8)
    at, nowhere = np.zeros((5, 2)), np.empty((0, 2))
    assert match_guided(none, nowhere, some, at.astype(np.float32), CONFIG).shape == (0,)
    lost = match_guided(some, at, none, nowhere.astype(np.float32), CONFIG)
    assert lost.tolist() == [-1] * 5
    assert match_all(none, some, CONFIG).shape == (0,)
    assert match_all(some, none, CONFIG).tolist() == [-1] * 5
    assert match_all(some, some[:1], CONFIG).tolist() == [-1] * 5


def test_hamming_counts_the_bits_that_differ():
    rng = np.random.default_rng(9)
    a, b = rng.integers(0, 256, (2, 40, 32)).astype(np.uint8)
    b[3], b[4] = a[3], ~a[4]
    expected = reference.distances(a, b)
    x, y = as_words(a), as_words(b)
    found = [[hamming(x, i, y, j) for j in range(40)] for i in range(40)]
    assert found == expected.tolist()
    assert (found[3][3], found[4][4]) == (0, 256)
    np.testing.assert_array_equal(as_words(a[::2]), x[::2])
    raw = np.frombuffer(b"x" + a.tobytes(), np.uint8, offset=1).reshape(40, 32)
    assert as_words(raw).flags.aligned
    np.testing.assert_array_equal(as_words(raw), x)


def test_nearest_is_the_plain_search():
    first, second, _ = images(32, 10, noise=30)
    second[7] = second[2]
    first[0] = second[2]
    index, best, other = nearest(first, second)
    d = reference.distances(first, second).astype(int)
    assert index.tolist() == d.argmin(axis=1).tolist()
    assert np.array_equal(best, d.min(axis=1))
    assert np.array_equal(other, np.sort(d, axis=1)[:, 1])
    assert (index[0], best[0], other[0]) == (2, 0, 0)
    none = nearest(first[:2], second[:0])
    assert [a.tolist() for a in none] == [[-1, -1], [257, 257], [257, 257]]
    assert nearest(first[:1], second[:1])[2].tolist() == [257]


def test_a_grid_holds_every_keypoint_once():
    rng = np.random.default_rng(11)
    keypoints = rng.uniform(-30, [350, 250], (500, 2)).astype(np.float32)
    grid = KeypointGrid.of(keypoints, (240, 320))
    assert sorted(grid.order.tolist()) == list(range(500))
    assert len(grid.start) == grid.rows * grid.cols + 1
    assert KeypointGrid.of(keypoints[:0], (240, 320)).order.shape == (0,)


def best_two(distance, allowed):
    """The nearest and the next of those allowed, of equals the first; -1 where there is none."""
    order = sorted(np.flatnonzero(allowed).tolist(), key=lambda n: (distance[n], n))
    return ([*order, -1, -1])[:2]


def is_clear(distance, levels, best, rival):
    rivals = rival >= 0 and levels[rival] == levels[best]
    within = best >= 0 and distance[best] <= CONFIG.max_hamming
    return within and not (rivals and distance[best] >= CONFIG.ratio * distance[rival])


def test_projected_matching_is_the_plain_search():
    first, second, truth = images(32, 12, number=150, noise=40, extra=60)
    first[5:9] = first[4]
    second[truth[20]] = second[truth[21]]
    rng = np.random.default_rng(13)
    keypoints = rng.uniform(-10, 110, (len(second), 2)).astype(np.float32)  # some outside
    guess = keypoints[truth] + rng.uniform(-20, 20, (len(first), 2))
    guess[3], guess[6] = np.nan, [1e12, -1e12]
    radius = rng.uniform(0, 60, len(first))
    radius[10], radius[11] = 1e6, np.nan
    levels = rng.integers(0, 4, len(second)).astype(np.uint8)
    lowest = levels[truth].astype(np.int64) - rng.integers(0, 2, len(first))
    highest = lowest + rng.integers(0, 3, len(first))
    for of_two in (guess, radius, lowest, highest):
        of_two[41:47:2] = of_two[40:46:2]  # landmarks in the same place, the second nearer
    first[41:47:2] = first[40:46:2]
    first[41:47:2] ^= (first[41:47:2] ^ second[truth[40:46:2]]) & 1
    grid = KeypointGrid.of(keypoints, (90, 100))
    found = match_projected(
        first, guess, radius, lowest, highest, second, keypoints, levels, grid, CONFIG
    )
    bits = reference.distances(first, second).astype(int)
    near = np.linalg.norm(guess[:, None] - keypoints[None], axis=2) <= radius[:, None]
    near &= (levels >= lowest[:, None]) & (levels <= highest[:, None])
    owner = {}
    for m in range(len(first)):
        n, rival = best_two(bits[m], near[m])
        if is_clear(bits[m], levels, n, rival):
            owner.setdefault(n, []).append((bits[m, n], m))
    expected = np.full(len(first), -1)
    for n, claims in owner.items():
        expected[min(claims)[1]] = n
    assert found.tolist() == expected.tolist()
    assert 50 < np.sum(found >= 0) < len(first)
    assert max(map(len, owner.values())) > 1


def test_a_rival_on_another_level_is_none():
    bits = np.unpackbits(np.random.default_rng(14).integers(0, 256, 32).astype(np.uint8))
    one, ten, eleven = (np.packbits(bits ^ (np.arange(256) < n)) for n in (0, 10, 11))
    at, here = np.zeros((1, 2)), np.zeros((2, 2), np.float32)
    grid = KeypointGrid.of(here, (50, 50))
    low, high = np.zeros(1, np.int64), np.full(1, 7)

    def match(*levels):
        return match_projected(
            one[None],
            at,
            np.ones(1),
            low,
            high,
            np.stack([eleven, ten]),
            here,
            np.array(levels, np.uint8),
            grid,
            CONFIG,
        ).tolist()

    assert match(2, 2) == [-1]
    assert match(3, 2) == [1]
    assert match(3, 8) == [0]


def views(seed, number=200):
    """Return two views of random points, (T_second_first, truth): the second in other order."""
    first, second, truth = images(32, seed, number=number, noise=20, extra=40)
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -2, 4], [3, 2, 12], (number, 3))
    angle = 0.1
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = [0.5, -0.1, 0.3]
    there = rng.uniform([-3, -2, 4], [3, 2, 12], (len(second), 3))
    there[truth] = points @ T[:3, :3].T + T[:3, 3]
    plane = there / there[:, 2:]
    plane[:, :2] += rng.normal(0, 0.001, (len(second), 2))
    levels = rng.integers(0, 3, (2, len(second))).astype(np.uint8)
    usable = rng.random((2, len(second))) < 0.9
    a = EpipolarView(first, points * 0.1, levels[0, :number], usable[0, :number])
    b = EpipolarView(second, plane, levels[1], usable[1])
    return a, b, T, truth


def plain_epipolar(a, b, T, sigma, scale):
    t = T[:3, 3]
    hat = reference.hat3(t)
    lines = a.bearings @ (hat @ T[:3, :3]).T
    plane = b.bearings / b.bearings[:, 2:]
    variance = (sigma * scale ** b.levels.astype(float)) ** 2
    off = (lines @ plane.T) ** 2 / np.sum(lines[:, :2] ** 2, axis=1)[:, None]
    near = (off <= 3.84 * variance) & a.usable[:, None] & b.usable
    near &= b.bearings[:, 2] > 0
    if abs(t[2]) > 0:
        apart = np.sum((plane[:, :2] - t[:2] / t[2]) ** 2, axis=1)
        near &= apart >= 100 * variance
    bits = reference.distances(a.descriptors, b.descriptors).astype(int)
    pairs = []
    for i in range(len(bits)):
        j, rival = best_two(bits[i], near[i])
        if is_clear(bits[i], b.levels, j, rival) and best_two(bits[:, j], near[:, j])[0] == i:
            pairs.append((i, j))
    return pairs


@pytest.mark.parametrize("forward", [0.0, 0.3])
def test_epipolar_matching_is_the_plain_search(forward):
    a, b, T, truth = views(15)
    T[2, 3] = forward
    b.bearings[3] *= -1  # behind the camera
    a.descriptors[7] = a.descriptors[8]
    b.descriptors[truth[30]] = b.descriptors[truth[31]]
    found = match_epipolar(a, b, T, 0.002, 1.2, CONFIG)
    expected = plain_epipolar(a, b, T, 0.002, 1.2)
    assert found.dtype == np.int64
    assert [tuple(p) for p in found.tolist()] == expected
    assert len(expected) > 20


def test_epipolar_matching_finds_what_is_there():
    a, b, T, truth = views(16)
    found = match_epipolar(a, b, T, 0.002, 1.2, CONFIG)
    could = np.sum(a.usable & b.usable[truth])
    assert len(found) > 0.85 * could
    assert np.mean(truth[found[:, 0]] == found[:, 1]) > 0.99
    assert len(set(found[:, 1].tolist())) == len(found)
    wrong = T.copy()
    wrong[:3, 3] = [-0.1, 0.5, 0.0]
    lost = match_epipolar(a, b, wrong, 0.002, 1.2, CONFIG)
    assert len(lost) < 0.1 * len(found)


def test_nothing_is_found_near_the_epipole_or_without_a_baseline():
    one = np.random.default_rng(17).integers(0, 256, (1, 32)).astype(np.uint8)
    level, usable = np.zeros(1, np.uint8), np.ones(1, bool)
    T = np.eye(4)
    T[2, 3] = 0.5  # straight ahead: the epipole is the centre

    def match(x, T):
        view = EpipolarView(one, np.array([[x, 0.0, 1.0]]), level, usable)
        return match_epipolar(view, view, T, 0.001, 1.2, CONFIG).tolist()

    assert match(0.02, T) == [[0, 0]]
    assert match(0.005, T) == []
    assert match(0.02, np.eye(4)) == []


def test_new_searches_of_nothing():
    none = EpipolarView(
        np.empty((0, 32), np.uint8), np.empty((0, 3)), np.empty(0, np.uint8), np.empty(0, bool)
    )
    a, _, T, _ = views(18, number=60)
    assert match_epipolar(none, a, T, 0.01, 1.2, CONFIG).shape == (0, 2)
    assert match_epipolar(a, none, T, 0.01, 1.2, CONFIG).shape == (0, 2)
    nowhere = np.empty((0, 2), np.float32)
    grid = KeypointGrid.of(nowhere, (50, 50))
    low = np.zeros(60, np.int64)
    found = match_projected(
        a.descriptors,
        np.zeros((60, 2)),
        np.ones(60),
        low,
        low,
        none.descriptors,
        nowhere,
        none.levels,
        grid,
        CONFIG,
    )
    assert found.tolist() == [-1] * 60
