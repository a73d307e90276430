"""Sweeps as they came."""

import numpy as np
import pytest

from odomap.sensors.frame import Frame
from odomap.sensors.sweep import Sweep


def test_columns_have_a_row_for_each_point() -> None:
    with pytest.raises(ValueError, match="times of shape"):
        Sweep(np.zeros((3, 3)), np.zeros(2))
    with pytest.raises(ValueError, match="shape"):
        Sweep(np.zeros((3, 4)))


def test_some_rows_keep_all_that_is_known_of_them() -> None:
    sweep = Sweep(np.arange(12.0).reshape(4, 3), np.arange(4.0), None, np.arange(4, dtype=np.int16))
    some = sweep.only(np.array([True, False, False, True]))
    assert some.times is not None
    assert some.beams is not None
    assert some.intensities is None
    assert some.times.tolist() == some.beams.tolist() == [0.0, 3.0]
    assert some.points[1].tolist() == [9.0, 10.0, 11.0]
    assert repr(some) == "Sweep(2 points, with times, beams)"


def test_a_frame_counts_the_arrays_of_its_sweep() -> None:
    sweep = Sweep(np.zeros((5, 3)), intensities=np.zeros(5, np.float32))
    assert sum(array.nbytes for array in Frame(0, 0, cloud=sweep).arrays()) == 5 * (24 + 4)
