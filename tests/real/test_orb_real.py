"""ORB on real images beside OpenCV's: the same bits, and as many places found again."""

import cv2
import numpy as np
import pytest

import reference
from odomap.vision.matching import MatchConfig, match_all
from odomap.vision.orb import OrbConfig, describe_at, extract

PAIRS = {
    "euroc_mh01/mav0/cam0/data": (40, 43),
    "kitti_mono/image_0": (40, 41),
    "rgbd_desk/rgb": (40, 43),
}


@pytest.fixture(params=PAIRS)
def pair(request, data_folder):
    files = sorted((data_folder / request.param).iterdir())
    return [cv2.imread(str(files[k]), cv2.IMREAD_GRAYSCALE) for k in PAIRS[request.param]]


def opencv(image):
    found, descriptors = cv2.ORB.create(1000).detectAndCompute(image, None)
    return np.array([k.pt for k in found], np.float32), descriptors, found


def found_again(first, second, shape):
    """Return distinct places (5 px) and cells of the image that fit one epipolar geometry."""
    match = match_all(first[1], second[1], MatchConfig())
    hit = match >= 0
    a, b = first[0][hit].astype(float), second[0][match[hit]].astype(float)
    cv2.setRNGSeed(0)
    _, inlier = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, 1.5, 0.9999)
    places = a[inlier.ravel() > 0]
    cells = (places / [shape[1], shape[0]] * [12, 8]).astype(int)
    return len(np.unique(np.round(places / 5), axis=0)), len(np.unique(cells, axis=0))


def test_as_many_places_are_found_again_as_with_opencv(pair):
    ours = [extract(image, OrbConfig()) for image in pair]
    places, cells = found_again(*((f.keypoints, f.descriptors) for f in ours), pair[0].shape)
    their_places, their_cells = found_again(*map(opencv, pair), pair[0].shape)
    assert places > 0.8 * their_places
    assert cells > 1.2 * their_cells


def test_real_descriptors_are_those_of_opencv(pair):
    image = pair[0]
    keypoints, theirs, found = opencv(image)
    levels = np.array([k.octave for k in found], np.uint8)
    scale = 1.2 ** levels[:, None].astype(float)
    size = np.array(image.shape[::-1])
    there = (np.round(keypoints / scale) + 0.5) * (size / np.round(size / scale)) - 0.5
    ours, kept = describe_at(image, there.astype(np.float32), levels)
    assert len(kept) > 0.98 * len(found)
    bits = np.diag(reference.distances(ours, theirs[kept]))
    assert bits.mean() < 3
    assert bits[levels[kept] == 0].mean() < 0.6
