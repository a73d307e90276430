"""The picture of the live view: tracks where they are, in colours that say what they are."""

import numpy as np
import pytest

from odomap.maps.estimate import Tracks
from odomap.views.livepicture import INLIER, OUTLIER, picture, shrunk


def tracks(now, before, inlier):
    return Tracks(np.array(now, np.float32), np.array(before, np.float32), np.array(inlier))


def has(image, u, v, colour):
    return np.array_equal(image[v, u], colour)


def test_inliers_and_outliers_are_told_apart():
    grey = np.full((80, 120), 100, np.uint8)
    drawn = picture(grey, tracks([(30, 20), (90, 60)], [(20, 20), (80, 60)], [True, False]))
    assert drawn.shape == (80, 120, 3)
    assert has(drawn, 30, 20, INLIER)
    assert has(drawn, 94, 64, OUTLIER)  # a cross reaches farther than a dot
    assert not has(drawn, 34, 24, INLIER)
    assert np.abs(drawn[20, 25].astype(int) - INLIER).max() < 20  # the trail
    assert np.array_equal(grey, np.full((80, 120), 100))  # what was given is not drawn on


def test_a_large_image_is_shrunk_with_its_tracks():
    drawn = picture(np.zeros((320, 1280), np.uint8), tracks([(800, 200)], [(780, 200)], [True]))
    assert drawn.shape == (160, 640, 3)
    assert has(drawn, 400, 100, INLIER)


def test_colour_images_stay_coloured():
    red = np.zeros((20, 30, 3), np.uint8)
    red[..., 0] = 200
    assert np.array_equal(picture(red, None), red)


@pytest.mark.parametrize("previous", [(np.nan, 3.0), (3000.0, 3.0)])
def test_a_trail_from_nowhere_is_left_out(previous):
    drawn = picture(np.zeros((50, 60), np.uint8), tracks([(40, 25)], [previous], [True]))
    coloured = drawn.any(axis=2)
    assert coloured.sum() == 9  # the dot alone
    assert has(drawn, 40, 25, INLIER)


def test_points_at_the_edge_and_beyond_do_no_harm():
    places = [(0, 0), (59, 49), (-20, 10), (200, 200), (np.nan, np.nan)]
    drawn = picture(np.zeros((50, 60), np.uint8), tracks(places, places, [False] * 5))
    assert has(drawn, 0, 0, OUTLIER)
    assert has(drawn, 59, 49, OUTLIER)


def test_no_tracks_is_the_bare_image():
    grey = np.full((10, 20), 7, np.uint8)
    none = tracks(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.bool_))
    assert np.array_equal(picture(grey, none), picture(grey, None))
    assert np.array_equal(shrunk(grey, 100), grey)
