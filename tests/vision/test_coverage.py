"""How large a part of an image points are spread over."""

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.vision.coverage import coverage

CAMERA = Camera(intrinsics=(300.0, 300.0, 320.0, 240.0), resolution=(640, 480))


def test_an_even_spread_covers_about_all():
    x, y = np.meshgrid(np.arange(640.0), np.arange(480.0))
    assert coverage(np.stack([x.ravel(), y.ravel()], axis=1), CAMERA) == pytest.approx(
        1.05, abs=0.01
    )


def test_it_scales_with_the_area_and_turns_with_the_points():
    points = np.random.default_rng(0).uniform(0, 100, (50, 2))
    whole = coverage(points, CAMERA)
    assert coverage(0.5 * points, CAMERA) == pytest.approx(0.25 * whole)
    assert coverage(points[:, ::-1] + 7.0, CAMERA) == pytest.approx(whole)


def test_points_on_a_line_cover_nothing():
    line = np.outer(np.arange(9.0), [3.0, 4.0])
    assert coverage(line, CAMERA) == pytest.approx(0.0, abs=1e-6)
    assert coverage(line[:2], CAMERA) == coverage(line[:0], CAMERA) == 0.0
