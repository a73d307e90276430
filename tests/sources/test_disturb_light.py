"""Disturbed light changes bytes as an exposure does, and nothing else."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.sources.disturb import exposure_jumps, overexpose
from odomap.sources.euroc import EurocSource
from odomap.sources.tum import TumSource


@pytest.fixture
def source(euroc: Callable[..., Path]) -> EurocSource:
    return EurocSource(euroc(frames=7))


def test_over_exposed_images_are_mostly_white(source: EurocSource) -> None:
    for before, after in zip(source, overexpose(source, [1, 4]), strict=True):
        for old, new in zip(before.images, after.images, strict=True):
            if before.id not in (1, 4):
                np.testing.assert_array_equal(new, old)
                continue
            np.testing.assert_array_equal(new, np.minimum(8 * old.astype(int), 255))
            assert new.dtype == np.uint8
            assert np.mean(new == 255) > 0.9


def test_depth_is_not_exposed(tum: Callable[..., Path]) -> None:
    source = TumSource(tum())
    np.testing.assert_array_equal(overexpose(source, [2]).frame(2).depth, source.frame(2).depth)


@pytest.mark.parametrize("cameras", [None, (1,)])
def test_exposure_steps(source: EurocSource, cameras: tuple[int, ...] | None) -> None:
    stepped = exposure_jumps(source, 2, (1.0, 1.5, 0.5), cameras=cameras)
    for before, after in zip(source, stepped, strict=True):
        factor = (1.0, 1.0, 1.5, 1.5, 0.5, 0.5, 1.0)[before.id]
        for k, (old, new) in enumerate(zip(before.images, after.images, strict=True)):
            gain = factor if cameras is None or k in cameras else 1.0
            np.testing.assert_array_equal(new, np.minimum(np.rint(gain * old), 255))


def test_what_is_no_exposure_is_refused(source: EurocSource) -> None:
    for gain in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="overexpose: gain"):
            overexpose(source, [1], gain)
    with pytest.raises(InputError, match="factor 0 must be a positive"):
        exposure_jumps(source, 5, (1.0, 0))
    with pytest.raises(InputError, match="give one or more"):
        exposure_jumps(source, 5, ())
    with pytest.raises(InputError, match="every 0"):
        exposure_jumps(source, 0)
