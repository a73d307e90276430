"""The vocabulary that comes along tells real places apart, there and back."""

import numpy as np
import pytest

from odomap.files.vocabulary import Vocabulary
from odomap.sources.open import open as open_source
from odomap.vision.matching import MatchConfig, match_all
from odomap.vision.orb import OrbConfig, extract
from odomap.vision.places import Places
from odomap.vision.wordmatching import match_words

NEAR = {
    "euroc_mh01": (1.0, 20.0),
    "kitti_stereo": (5.0, 20.0),
    "kitti_mono": (5.0, 20.0),
    "rgbd_desk": (1.0, 20.0),
}
"""Metres and degrees within which a place is the same."""


@pytest.fixture(scope="module")
def vocabulary():
    return Vocabulary.load()


@pytest.fixture(scope="module")
def ways(data_folder):
    """Return of each recording descriptors and poses of frames there, and of others on the way."""
    found = {}
    for name in NEAR:
        source = open_source(data_folder / name)
        truth = source.truth

        def look(index, source=source, truth=truth):
            frame = source.frame(index)
            nearest = np.abs(truth.stamps_ns - frame.stamp_ns).argmin()
            return extract(frame.images[0], OrbConfig()).descriptors, truth.Ts_world_body[nearest]

        step = max(len(source) // 12, 2)
        there = [look(index) for index in range(0, len(source) - step, step)]
        back = [look(index) for index in range(step // 2, len(source) - step, 2 * step)]
        found[name] = there, back
    return found


def apart(T_a, T_b):
    """Return metres and degrees between two poses."""
    T = np.linalg.inv(T_a) @ T_b
    turn = np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))
    return np.linalg.norm(T[:3, 3]), np.degrees(turn)


def test_frames_on_the_way_back_find_those_there(vocabulary, ways):
    places, where = Places(vocabulary.num_words), []
    for name, (there, _) in ways.items():
        for descriptors, T in there:
            places.add(len(where), vocabulary.transform(descriptors))
            where.append((name, T))
    scores, right = [], []
    for name, (_, back) in ways.items():
        for descriptors, T in back:
            found = places.query(vocabulary.transform(descriptors), 1)
            other, T_other = where[found.keyframe_ids[0]]
            metres, degrees = apart(T, T_other)
            scores.append(found.scores[0])
            right.append(other == name and metres < NEAR[name][0] and degrees < NEAR[name][1])
    scores, right = np.array(scores), np.array(right)
    worst = scores[~right].max(initial=0.0)
    assert len(right) > 20
    assert (right & (scores > worst)).mean() >= 0.8


def test_words_find_most_of_what_all_pairs_match(vocabulary, ways):
    for there, _ in ways.values():
        (first, _), (second, _) = there[3], there[4]
        nodes = [vocabulary.transform(d).nodes for d in (first, second)]
        config = MatchConfig(ratio=0.75, max_hamming=50)
        every = match_all(first, second, config)
        by_words = match_words(first, nodes[0], second, nodes[1], config)
        same = (by_words == every) & (every >= 0)
        assert same.sum() >= 0.5 * (every >= 0).sum() > 0
