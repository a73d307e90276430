"""Fusing: what is one point becomes one landmark, and what is two stays two."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.system.fusing import FuseConfig, Fusions, find_fusions, fused
from odomap.system.joining import join
from odomap.vision.matching import MatchConfig
from windowworlds import (
    circle,
    keep_observations,
    row,
    with_duplicates,
    with_features,
    world,
)

CONFIG, MATCHING = FuseConfig(), MatchConfig()
WORLDS = {
    "row": {},
    "noisy": {"sigma_px": 1.0, "flips": 0.1},
    "depth": {"sigma_depth": 0.002},
    "circle": {"Ts": circle(8)},
    "crowded": {"count": 1500, "clutter": 300},
}


def find(window, **how):
    return find_fusions(window, replace(CONFIG, **how), MATCHING)


def forgetting(w, part, keyframes, seed=0):
    """Return the window without part of the observations in some keyframes, and which went."""
    window = w.window
    lost = np.isin(window.obs_keyframe, keyframes)
    lost &= np.random.default_rng(seed).random(len(lost)) < part
    return keep_observations(window, ~lost), lost


def doubled(w, count=40, from_keyframe=3, **how):
    """Return the window with duplicates, and the point of each of its landmarks."""
    often = np.flatnonzero(np.bincount(w.window.obs_landmark) == len(w.window.keyframes))
    rows = np.random.default_rng(1).choice(often, count, replace=False)
    return with_duplicates(w.window, rows, from_keyframe, **how), np.r_[
        w.landmarks, w.landmarks[rows]
    ]


def triples(keyframe, landmark, keypoint):
    return set(zip(keyframe.tolist(), landmark.tolist(), keypoint.tolist(), strict=True))


@pytest.mark.parametrize("name", WORLDS)
def test_what_was_missed_is_found(name):
    w = world(known=0.8, **WORLDS[name])
    newest = w.window.newest
    window, lost = forgetting(w, 0.4, [newest])
    found = find(window)
    right = [
        w.point_at[k][i] == w.landmarks[m]
        for k, m, i in zip(found.keyframe, found.landmark, found.keypoint, strict=True)
    ]
    assert np.mean(right) > 0.99
    assert len(right) > 0.85 * lost.sum()
    assert len(found.gone) == 0


def test_its_own_are_found_in_free_neighbours():
    w = world(known=0.8, fixed=2)
    window, lost = forgetting(w, 0.5, [0, 1, 2, 3])
    found = find(window)
    wanted = {
        t
        for t in triples(*(c[lost] for c in observations(w.window)))
        if t[0] >= 2 and w.landmarks[t[1]] in w.point_at[5]
    }
    got = triples(found.keyframe, found.landmark, found.keypoint)
    assert {k for k, _, _ in got} == {2, 3}  # the others are fixed
    assert len(got - wanted) <= 0.01 * len(got)
    assert len(got & wanted) > 0.85 * len(wanted)


def observations(window):
    return window.obs_keyframe, window.obs_landmark, window.obs_keypoint


@pytest.mark.parametrize("name", WORLDS)
def test_duplicates_become_one(name):
    w = world(known=0.5, **WORLDS[name])
    window, truth = doubled(w)
    found = find(window)
    assert np.array_equal(truth[found.gone], truth[found.survivors])
    assert len(found.gone) >= 36  # of 40
    after = fused(window, found)
    counts = np.bincount(after.obs_landmark, minlength=len(truth))
    assert np.all(counts[found.gone] == 0)
    assert np.all(counts[found.survivors] == len(window.keyframes))
    np.testing.assert_array_equal(after.num_observers[counts > 0], counts[counts > 0])
    assert after.points_world is window.points_world  # rows stay
    assert np.all(window.num_observers[found.survivors] >= window.num_observers[found.gone])
    # once all is found nothing is left to find
    again = find(after)
    assert len(again.gone) == len(again.keyframe) == 0


def test_three_that_are_one_have_one_survivor():
    w = world(known=0.6)
    window, truth = doubled(w, 30, 4)
    window = with_duplicates(window, np.arange(len(w.landmarks), len(truth)), 5)
    truth = np.r_[truth, truth[len(w.landmarks) :]]
    found = find(window)
    assert len(found.gone) > 48  # of 60
    assert len(set(found.gone.tolist())) == len(found.gone)
    assert not set(found.gone.tolist()) & set(found.survivors.tolist())
    assert np.array_equal(truth[found.gone], truth[found.survivors])
    assert np.all(np.bincount(fused(window, found).obs_landmark)[found.survivors] >= 5)


def test_two_that_a_keyframe_sees_apart_stay_two():
    w = world(known=0.6)
    window, truth = doubled(w)
    # an old keyframe sees each new twin at a keypoint of nothing, far from the first one's
    twins = np.arange(len(w.landmarks), len(truth))
    nothing = np.flatnonzero(w.point_at[1] < 0)[: len(twins)]
    apart = replace(
        window,
        obs_keyframe=np.r_[window.obs_keyframe, np.full(len(twins), 1)],
        obs_landmark=np.r_[window.obs_landmark, twins],
        obs_keypoint=np.r_[window.obs_keypoint, nothing],
    )
    # their points being the same, the sighting is taken for wrong
    same = replace(apart, points_world=w.points[truth])
    assert len(find(same).gone) >= 36
    # so are they not when the points are apart by more than the noise, along the ray
    center = window.center(5)
    moved = window.points_world.copy()
    moved[twins] = center + 1.4 * (moved[twins] - center)
    assert len(find(replace(apart, points_world=moved)).gone) == 0


def test_look_alikes_elsewhere_are_left_alone():
    w = world(known=0.8, sigma_px=0.3)
    window, lost = forgetting(w, 0.4, [5])
    # every point looks like four others
    looks = np.random.default_rng(0).integers(0, 256, (len(w.points), 32), np.uint8)[
        np.arange(len(w.points)) % 100
    ]
    for k in range(6):
        who = w.point_at[k]
        alike = np.where(who[:, None] >= 0, looks[who], window.features(k).descriptors)
        window = with_features(window, k, descriptors=alike)
    found = find(replace(window, descriptors=looks[w.landmarks]))
    right = [
        w.point_at[5][i] == w.landmarks[m]
        for m, i in zip(found.landmark, found.keypoint, strict=True)
    ]
    assert np.mean(right) > 0.99
    assert len(right) > 0.85 * lost.sum()
    assert len(found.gone) == 0


def test_what_looks_different_is_not_found():
    w = world(known=0.6)
    window, _ = doubled(w)
    window = keep_observations(window, np.arange(len(window.obs_keyframe)) % 5 > 0)
    strange = np.random.default_rng(0).integers(0, 256, window.descriptors.shape, np.uint8)
    found = find(replace(window, descriptors=strange))
    assert len(found.gone) == len(found.keyframe) == 0


def test_depth_tells_what_a_pixel_does_not():
    w = world(known=0.8, sigma_depth=0.001)
    window, lost = forgetting(w, 0.4, [5])
    center, own = window.center(5), set(w.window.obs_landmark[lost].tolist())
    further = center + 1.1 * (window.points_world - center)
    assert len(find(replace(window, points_world=further)).keyframe) < 0.1 * len(own)
    blind = with_features(window, 5, depth=np.full(len(window.features(5)), np.nan))
    assert len(find(replace(blind, points_world=further)).keyframe) > 0.8 * len(own)


def test_the_far_side_is_not_looked_for():
    # opposite views of the same points
    w = world(circle(2, 180.0), known=1.0, fixed=0, count=300)
    window = keep_observations(w.window, w.window.obs_keyframe == 0)
    assert len(find(window).keyframe) == 0
    assert len(find(window, max_angle_deg=180.0).keyframe) > 10


def test_nor_is_what_shows_too_small_or_too_large():
    w = world(row(3), known=0.8)
    window, lost = forgetting(w, 0.5, [2])
    usual = len(find(window).keyframe)
    finer = with_features(window, 2, level=np.maximum(window.features(2).level, 3) - 3)
    assert usual > 0.85 * lost.sum()
    assert len(find(finer).keyframe) < 0.4 * usual


def test_where_there_is_one_level_it_says_nothing():
    w = world(row(3, 1.0), known=0.8, sigma_px=0.2)
    window, lost = forgetting(w, 0.5, [2])
    for k in range(3):
        window = with_features(window, k, level=np.zeros(len(window.features(k)), np.uint8))
    assert len(find(window).keyframe) > 0.5 * lost.sum()


@pytest.mark.parametrize("are_doubled", [False, True])
def test_the_order_of_rows_does_not_matter(are_doubled):
    w = world(known=0.6, flips=0.1)
    rng = np.random.default_rng(0)
    if are_doubled:
        window, _ = doubled(w, 30)
    else:
        window, _ = forgetting(w, 0.3, [2, 3, 4, 5])
    landmark = rng.permutation(len(window.points_world))
    back, order = np.argsort(landmark), rng.permutation(len(window.obs_keyframe))
    # equal numbers of observers would be told apart by their row
    window = replace(window, num_observers=window.num_observers * 1000 + landmark)
    shuffled = replace(
        window,
        points_world=window.points_world[back],
        descriptors=window.descriptors[back],
        num_observers=window.num_observers[back],
        obs_keyframe=window.obs_keyframe[order],
        obs_landmark=landmark[window.obs_landmark[order]],
        obs_keypoint=window.obs_keypoint[order],
    )
    one, other = find(window), find(shuffled)
    assert len(one.gone if are_doubled else one.keyframe) > 25
    pairs = set(zip(landmark[one.survivors], landmark[one.gone], strict=True))
    assert set(zip(other.survivors, other.gone, strict=True)) == pairs
    seen = triples(one.keyframe, landmark[one.landmark], one.keypoint)
    assert triples(other.keyframe, other.landmark, other.keypoint) == seen


def test_applying_keeps_one_observation_a_keyframe():
    w = world(row(3), known=0.2, count=100)
    none = np.empty(0, np.int64)
    window = replace(
        w.window,
        obs_keyframe=np.array([0, 0, 1, 1, 2, 2]),
        obs_landmark=np.array([3, 2, 2, 1, 1, 5]),
        obs_keypoint=np.array([10, 11, 12, 13, 14, 15]),
        num_observers=np.array([0, 3, 2, 4, 0, 1] + [0] * (len(w.landmarks) - 6)),
    )
    joined = Fusions(none, none, none, np.array([3, 3]), np.array([1, 2]))
    after = fused(window, joined)
    # in the first keyframe the survivor's stays, in the second that of the lowest row
    assert triples(*observations(after)) == {(0, 3, 10), (1, 3, 13), (2, 3, 14), (2, 5, 15)}
    assert after.num_observers[:6].tolist() == [0, 0, 0, 3 + 2 + 4 - 2, 0, 1]
    more = replace(joined, keyframe=np.array([1]), landmark=np.array([5]), keypoint=np.array([16]))
    after = fused(window, more)
    assert (1, 5, 16) in triples(*observations(after))
    assert after.num_observers[5] == 2


def test_a_survivor_is_seen_once_a_keyframe_and_keypoints_once():
    w = world(known=0.7, count=1000, flips=0.1, sigma_px=1.0)
    window, _ = doubled(w, 100)
    window = keep_observations(
        window, np.random.default_rng(0).random(len(window.obs_keyframe)) > 0.3
    )
    after = fused(window, find(window))
    seen = list(zip(after.obs_keyframe.tolist(), after.obs_landmark.tolist(), strict=True))
    assert len(set(seen)) == len(seen)
    used = list(zip(after.obs_keyframe.tolist(), after.obs_keypoint.tolist(), strict=True))
    assert len(set(used)) == len(used)


def test_groups_do_not_join_what_stands_apart():
    pairs = np.array([[0, 1], [2, 3], [1, 2], [5, 4], [4, 4], [3, 0]])
    weight = np.array([1, 2, 3, 3, 1, 1])

    def apart(a, b):
        return (a == 0) & (b == 3)

    survivors, gone = join(pairs, weight, apart)
    # {0, 1} and {2, 3} would bring 0 and 3 together; equals go by the lower row
    assert survivors.tolist() == [1, 2, 4]
    assert gone.tolist() == [0, 3, 5]
    survivors, gone = join(pairs, weight, lambda a, b: np.zeros(len(a), bool))
    assert survivors.tolist() == [2, 2, 2, 4]
    assert gone.tolist() == [0, 1, 3, 5]
    # better pairs come first
    survivors, gone = join(pairs[[2, 0, 1]], weight, apart)
    assert survivors.tolist() == [2, 2]
    assert gone.tolist() == [0, 1]
    assert [len(a) for a in join(pairs[4:5], weight, apart)] == [0, 0]


def test_nothing_in_a_window_of_one():
    w = world(row(1), fixed=0)
    found = find(w.window)
    assert len(found.keyframe) == len(found.gone) == 0
    after = fused(w.window, found)
    assert triples(*observations(after)) == triples(*observations(w.window))


def test_nothing_where_nothing_is_seen():
    window = world(row(3)).window
    empty = keep_observations(window, np.zeros(len(window.obs_keyframe), bool))
    bare = replace(
        empty,
        points_world=np.empty((0, 3)),
        descriptors=np.empty((0, 32), np.uint8),
        num_observers=np.empty(0, np.int64),
    )
    for nothing in (empty, bare):
        found = find(nothing)
        assert len(found.keyframe) == len(found.gone) == 0
        assert len(fused(nothing, found).obs_keyframe) == 0


def test_limits():
    with pytest.raises(ConfigError, match="radius_px"):
        FuseConfig(radius_px=0.0)
    with pytest.raises(ConfigError, match="max_angle_deg"):
        FuseConfig(max_angle_deg=200.0)
