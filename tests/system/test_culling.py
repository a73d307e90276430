"""Culling: what goes is what the map does not need, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.system.culling import CullConfig, poor_landmarks, redundant_keyframes
from windowworlds import circle, keep_observations, row, world

CONFIG = CullConfig(keyframes=10, redundant=0.9, min_found=0.25)


def with_levels(window, level_of):
    """Return the window with all levels of keyframe row k set to level_of[k]."""
    keyframes = tuple(
        replace(
            k, features=replace(k.features, level=np.full_like(k.features.level, level_of[row_]))
        )
        for row_, k in enumerate(window.keyframes)
    )
    return replace(window, keyframes=keyframes)


def observers_without(window, gone):
    stays = ~np.isin(window.obs_keyframe, gone)
    return np.bincount(window.obs_landmark[stays], minlength=len(window.points_world))


def test_a_crowd_is_thinned_until_every_landmark_has_its_observers():
    window = with_levels(world(row(10, 0.02), fixed=1).window, [0] * 10)
    gone = redundant_keyframes(window, CONFIG)
    assert 5 <= len(gone) <= 7  # of 10 that see the same, at least three must remain
    before = observers_without(window, [])
    after = observers_without(window, gone)
    assert np.mean(after[before >= 4] >= 3) > 0.9
    assert window.newest not in gone
    assert 0 not in gone  # fixed


def test_keyframes_that_see_things_of_their_own_stay():
    assert len(redundant_keyframes(world(row(3, 0.02)).window, CONFIG)) == 0
    wide = world(circle(8, 40.0, radius=3.0), count=800).window
    assert len(redundant_keyframes(wide, CONFIG)) == 0


def test_counting_anew_keeps_those_that_stand_in_for_each_other():
    # five see the same; once one is gone the other four need each other
    window = with_levels(world(row(5, 0.01), fixed=1).window, [0] * 5)
    everywhere = np.bincount(window.obs_landmark) == 5
    window = keep_observations(window, everywhere[window.obs_landmark])
    assert len(redundant_keyframes(window, CONFIG)) == 2
    assert len(redundant_keyframes(window, replace(CONFIG, observers=4))) == 1
    assert len(redundant_keyframes(window, replace(CONFIG, observers=5))) == 0


def test_only_sightings_as_near_stand_in():
    window = world(row(6, 0.01), fixed=0).window
    # the third one is nearest to everything: nobody sees it as finely
    finest = with_levels(window, [1, 1, 0, 1, 1, 1])
    gone = redundant_keyframes(finest, CONFIG)
    assert len(gone) > 0
    assert 2 not in gone
    # three others stand in for what is seen coarsely, only two for each of these
    coarsest = with_levels(world(row(4, 0.01), fixed=0).window, [0, 3, 0, 0])
    assert redundant_keyframes(coarsest, CONFIG).tolist() == [1]


def test_protected_ones_stay_and_so_many_go_at_a_time():
    window = with_levels(world(row(10, 0.02)).window, [0] * 10)
    assert len(redundant_keyframes(window, replace(CONFIG, keyframes=2))) == 2
    protected = np.ones(10, bool)
    protected[[3, 4]] = False
    assert set(redundant_keyframes(window, CONFIG, protected).tolist()) == {3, 4}
    assert len(redundant_keyframes(window, CONFIG, np.ones(10, bool))) == 0


def test_with_depth_only_near_landmarks_count():
    window = with_levels(world(row(6, 0.01), sigma_depth=0.002, fixed=0).window, [0] * 6)
    # far landmarks are seen by one keyframe each
    depth = [f.depth for f in map(window.features, range(6))]
    far = np.array(
        [depth[k][i] > 7.0 for k, i in zip(window.obs_keyframe, window.obs_keypoint, strict=True)]
    )
    lonely = keep_observations(window, ~far | (window.obs_landmark % 6 == window.obs_keyframe))
    assert len(redundant_keyframes(lonely, CONFIG)) == 0
    assert len(redundant_keyframes(lonely, CONFIG, near=6.9)) > 0
    # nothing near says nothing, so all stay
    assert len(redundant_keyframes(window, CONFIG, near=1.0)) == 0


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_rows_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    window = world(row(9, 0.05), seed=seed).window
    order = rng.permutation(len(window.obs_keyframe))
    landmark = rng.permutation(len(window.points_world))
    shuffled = replace(
        window,
        obs_keyframe=window.obs_keyframe[order],
        obs_landmark=landmark[window.obs_landmark[order]],
        obs_keypoint=window.obs_keypoint[order],
    )
    expected = redundant_keyframes(window, CONFIG)
    np.testing.assert_array_equal(redundant_keyframes(shuffled, CONFIG), expected)


def test_landmarks_on_probation():
    # columns: age, observers, found, expected, ranged, goes
    table = np.array(
        [
            (0, 2, 1, 1, 0, 0),  # too young to be judged by its observers
            (1, 2, 1, 9, 0, 1),  # but not by the frames that missed it
            (2, 2, 9, 9, 0, 1),  # a single camera wants three observers
            (2, 3, 9, 9, 0, 0),
            (2, 2, 9, 9, 1, 0),  # with depth two will do
            (3, 1, 9, 9, 1, 1),
            (3, 9, 2, 8, 0, 0),  # a quarter is enough
            (3, 9, 1, 8, 0, 1),
            (2, 3, 0, 0, 0, 0),  # never expected says nothing
            (4, 1, 0, 9, 0, 0),  # probation is over
        ]
    )
    age, observers, found, expected, ranged, goes = table.T
    poor = poor_landmarks(age, observers, found, expected, ranged.astype(bool), CONFIG)
    np.testing.assert_array_equal(poor, np.flatnonzero(goes))


def test_limits():
    with pytest.raises(ConfigError, match="redundant"):
        CullConfig(redundant=1.5)
    with pytest.raises(ConfigError, match="observers"):
        CullConfig(observers=0)
