"""Matching against a plain search through all pairs."""

import numpy as np
import pytest

import reference
from odomap.vision.matching import MatchConfig, match_all, match_guided

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
