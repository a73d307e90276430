"""Frames delivered twice, and a right camera that dies: the rest stays what it was."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.sources.disturb import blank, drop, duplicate, kill_right
from odomap.sources.euroc import EurocSource
from odomap.sources.tum import TumSource


@pytest.fixture
def source(euroc: Callable[..., Path]) -> EurocSource:
    return EurocSource(euroc(frames=7))


def test_a_copy_comes_halfway_to_the_next_frame(source: EurocSource) -> None:
    twice = duplicate(source, [1, 2, 6])
    stamps = source.stamps_ns
    frames = list(twice)
    assert [f.id for f in frames] == [0, 1, 1, 2, 2, 3, 4, 5, 6, 6] == twice.ids.tolist()
    assert frames[2].stamp_ns == (stamps[1] + stamps[2]) // 2
    assert frames[4].stamp_ns == (stamps[2] + stamps[3]) // 2
    assert frames[9].stamp_ns == stamps[6] + (stamps[6] - stamps[5]) // 2
    for k in (2, 4, 9):
        for copy, image in zip(frames[k].images, frames[k - 1].images, strict=True):
            np.testing.assert_array_equal(copy, image)


def test_inertial_samples_come_once_and_in_time(source: EurocSource) -> None:
    whole = np.concatenate([f.imu.stamps_ns for f in source])
    for same_stamp in (False, True):
        frames = list(duplicate(source, [1, 2, 6], same_stamp=same_stamp))
        np.testing.assert_array_equal(np.concatenate([f.imu.stamps_ns for f in frames]), whole)
        for before, frame in pairwise(frames):
            assert np.all(frame.imu.stamps_ns > before.stamp_ns)
            assert np.all(frame.imu.stamps_ns <= frame.stamp_ns)


def test_the_same_stamp_twice(source: EurocSource) -> None:
    twice = duplicate(source, [0, 3], same_stamp=True)
    stamps = [f.stamp_ns for f in twice]
    assert stamps == twice.stamps_ns.tolist()
    assert np.flatnonzero(np.diff(stamps) == 0).tolist() == [0, 4]
    assert [twice.frame(k).stamp_ns for k in range(9)] == stamps


def test_copies_nest(source: EurocSource) -> None:
    frames = list(drop(blank(duplicate(source, [2]), [3]), [1]))
    assert [f.id for f in frames] == [0, 2, 2, 3, 4, 5, 6]
    assert not frames[3].images[0].any()
    assert len(list(duplicate(drop(source, [2]), [2, 3]))) == 7


@pytest.mark.parametrize("how", ["missing", "black", "frozen"])
def test_the_right_camera_dies(source: EurocSource, how: str) -> None:
    last = source.frame(2).images[1]
    for before, after in zip(source, kill_right(source, 3, how), strict=True):
        np.testing.assert_array_equal(after.images[0], before.images[0])
        assert after.stamp_ns == before.stamp_ns
        right = after.images[1]
        if before.id < 3:
            np.testing.assert_array_equal(right, before.images[1])
        elif how == "missing":
            assert right is None
        else:
            np.testing.assert_array_equal(right, np.zeros_like(last) if how == "black" else last)


def test_a_right_camera_dead_from_the_start(source: EurocSource) -> None:
    assert all(f.images[1] is None for f in kill_right(source, 0, "frozen"))
    assert kill_right(source, 0, "frozen").frame(4).images[1] is None


def test_there_must_be_a_right_camera(source: EurocSource, tum: Callable[..., Path]) -> None:
    with pytest.raises(InputError, match="needs a rig with two cameras"):
        kill_right(TumSource(tum()), 3)
    with pytest.raises(InputError, match="none of missing, black, frozen"):
        kill_right(source, 3, "burnt")  # type: ignore[arg-type]
