"""Beams from the order of rows, and times from azimuths."""

import numpy as np
import pytest

from odomap.lidar.rings import azimuths, bands_of, rings_of
from odomap.lidar.turning import turn_times
from sweepworlds import elevations, road


@pytest.mark.parametrize("beams", [16, 32, 64, 128])
@pytest.mark.parametrize("seed", [0, 7])
def test_rings_are_counted_and_numbered(beams: int, seed: int) -> None:
    sweeps = [road(beams, seed=seed + k) for k in range(3)]
    rings = rings_of([points for points, _ in sweeps])
    assert rings is not None
    assert len(rings) == beams
    for points, truth in sweeps:
        found = rings.beams(points, azimuths(points))
        assert found.dtype == np.int16
        assert (found == truth).mean() > 0.999
    np.testing.assert_allclose(np.degrees(rings.elevations[::-1] - elevations(beams)), 0, atol=0.05)


def test_lowest_first_and_the_other_turn() -> None:
    points, truth = road(32)
    for order in (np.s_[::-1], np.argsort(truth, kind="stable")):
        turned, numbers = points[order], truth[order]
        rings = rings_of([turned])
        assert rings is not None
        assert len(rings) == 32
        assert (rings.beams(turned, azimuths(turned)) == numbers).mean() > 0.999


def test_rings_that_are_missing_shift_no_others() -> None:
    """Of the highest beams only sky is seen for a while."""
    whole = [road(64, seed=k)[0] for k in range(3)]
    rings = rings_of(whole)
    assert rings is not None
    points, truth = road(64, seed=9)
    for gone in ([63, 62, 61], [30], [0]):
        kept = ~np.isin(truth, gone)
        found = rings.beams(points[kept], azimuths(points[kept]))
        assert (found == truth[kept]).mean() > 0.999


def test_rows_that_did_not_return_are_of_some_ring() -> None:
    points, truth = road(32)
    points[::7] = np.nan
    points[3::11] = 0.0
    rings = rings_of([points])
    assert rings is not None
    valid = np.isfinite(points[:, 0]) & (points[:, 0] != 0)
    found = rings.beams(points, azimuths(points))
    assert (found[valid] == truth[valid]).mean() > 0.999
    assert found.min() >= 0
    assert found.max() == 31


def test_no_rings_where_there_are_none() -> None:
    rng = np.random.default_rng(3)
    points, _ = road(64)
    assert rings_of([rng.permutation(points)]) is None
    assert rings_of([rng.normal(size=(5000, 3))]) is None
    assert rings_of([np.full((100, 3), np.nan)]) is None
    assert rings_of([np.zeros((0, 3))]) is None
    assert rings_of([]) is None


@pytest.mark.parametrize("beams", [16, 32])
def test_bands_in_any_order(beams: int) -> None:
    rng = np.random.default_rng(beams)
    points, truth = road(beams)
    order = rng.permutation(len(points))
    bands = bands_of([points[order]])
    assert bands is not None
    assert len(bands) == beams
    found = bands.beams(points[order], azimuths(points[order]))
    np.testing.assert_array_equal(found, truth[order])
    assert bands_of([points], beams=beams + 1) is None


def test_no_bands_where_there_are_none() -> None:
    rng = np.random.default_rng(1)
    assert bands_of([rng.normal(size=(5000, 3))]) is None
    assert bands_of([rng.normal(size=(5, 3))]) is None
    assert bands_of([np.zeros((900, 3))]) is None


def test_times_of_a_turn() -> None:
    degrees = np.array([179.9, 90.0, 0.0, -90.0, -179.9])
    times = turn_times(np.radians(degrees), 0.1, True, np.pi, 0.0)
    np.testing.assert_allclose(times, -degrees / 3600, atol=1e-12)
    back = turn_times(np.radians(degrees), 0.1, False, np.pi, 0.0)
    np.testing.assert_allclose(back, -times, atol=1e-12)
    begun = turn_times(np.radians([30.0, 29.0, -150.0]), 0.36, True, np.radians(30), np.radians(30))
    np.testing.assert_allclose(begun, [0.0, 0.001, 0.18], atol=1e-12)
    assert np.isfinite(turn_times(np.array([np.nan]), 0.1, True, np.pi, 0.0)).all()
