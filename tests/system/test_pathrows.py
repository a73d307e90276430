"""What is kept of every frame: few numbers, all of them as they were."""

import tracemalloc

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp
from odomap.system.pathrows import BLOCK, PathRows

MANY = 2 * BLOCK + 7


def frame(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6))
    return 10**18 + seed, seed // 3, se3_exp(rng.normal(size=6)), A @ A.T


@pytest.fixture(scope="module")
def rows():
    rows = PathRows()
    for seed in range(MANY):
        rows.append(*frame(seed))
    return rows


def is_same(found, expected):
    return all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("place", [0, BLOCK - 1, BLOCK, MANY - 1, -1, -MANY])
def test_a_frame_comes_back_to_the_last_bit(rows, place):
    expected = frame(place % MANY)
    assert is_same(rows[place], expected)
    assert rows.stamp_ns(place) == expected[0]


def test_all_frames_come_back_in_order(rows):
    stamps, ids, Ts, covariances = (
        np.array(column) for column in zip(*map(frame, range(MANY)), strict=True)
    )
    found = rows.stamps_ns, rows.keyframe_ids, *rows.matrices()
    assert is_same(found, (stamps, ids, Ts, covariances))
    some = np.arange(MANY) % 5 == 2
    assert is_same(rows.matrices(some), (Ts[some], covariances[some]))


def test_one_is_written_anew_and_the_others_stay():
    rows = PathRows()
    for seed in range(BLOCK + 3):
        rows.append(*frame(seed))
    rows.replace(BLOCK, *frame(999))
    assert is_same(rows[BLOCK], frame(999))
    assert is_same(rows[BLOCK - 1], frame(BLOCK - 1))
    assert is_same(rows[BLOCK + 1], frame(BLOCK + 1))


def test_there_are_no_others():
    rows = PathRows()
    assert len(rows) == 0
    assert rows.matrices()[0].shape == (0, 4, 4)
    assert rows.matrices()[1].shape == (0, 6, 6)
    rows.append(*frame(0))
    for place in (1, -2):
        with pytest.raises(IndexError, match=f"frame {place} of 1"):
            rows[place]


def test_a_frame_takes_280_bytes():
    """What was an object with two matrices took 900."""
    one, count = frame(0), 40 * BLOCK
    tracemalloc.start()
    try:
        rows = PathRows()
        for _ in range(count):
            rows.append(*one)
        held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert held / count < 285
