"""Frames and the inertial samples they carry."""

import itertools

import numpy as np
import pytest

from odomap.sensors.frame import Frame, ImuSamples


def samples(count: int) -> ImuSamples:
    rng = np.random.default_rng(0)
    return ImuSamples(
        np.arange(count, dtype=np.int64) * 10,
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)),
    )


def test_between_excludes_the_first_and_includes_the_last() -> None:
    imu = samples(10)
    assert imu.between(20, 50).stamps_ns.tolist() == [30, 40, 50]
    assert imu.between(None, 15).stamps_ns.tolist() == [0, 10]
    assert len(imu.between(50, 20)) == 0


def test_pieces_put_together_are_the_stream() -> None:
    imu = samples(20)
    cuts = [None, 35, 40, 40, 141, 1000]
    parts = [imu.between(a, b) for a, b in itertools.pairwise(cuts)]
    joined = ImuSamples.joined(parts)
    assert np.array_equal(joined.stamps_ns, imu.stamps_ns)
    assert np.array_equal(joined.gyro, imu.gyro)
    assert np.array_equal(joined.accel, imu.accel)
    assert len(ImuSamples.joined([])) == 0


def test_samples_are_checked() -> None:
    with pytest.raises(ValueError, match="increase"):
        ImuSamples(np.array([0, 0]), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="shape"):
        ImuSamples(np.array([0, 1]), np.zeros((2, 3)), np.zeros((3, 3)))


def test_frame_lists_its_arrays() -> None:
    image = np.zeros((2, 3), np.uint8)
    frame = Frame(0, 1_500_000_000, (image, None), imu=samples(2))
    assert frame.stamp == 1.5
    assert sum(array.nbytes for array in frame.arrays()) == 6 + 2 * (8 + 24 + 24)
