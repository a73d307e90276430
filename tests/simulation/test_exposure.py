"""Exposure: noise, blur, vignetting and tone as the sensor model says."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.simulation.exposure import ImageNoise, expose, measure_depth
from odomap.simulation.render import Picture

PINHOLE = np.array([60.0, 60.0, 79.5, 49.5])


def flat(value: float, flow: tuple[float, float] = (0.0, 0.0)) -> Picture:
    light = np.full((100, 160), value, np.float32)
    return Picture(light, light, np.tile(np.array(flow, np.float32), (100, 160, 1)))


@pytest.mark.parametrize("value", [0.1, 0.5, 0.8])
def test_variance_is_shot_plus_read(value: float) -> None:
    noise = replace(ImageNoise.none(), shot=0.03, read=0.02)
    image = expose(flat(value), noise, PINHOLE, (1, 2, 0), 1.0)
    wanted = 255 * np.sqrt(0.03**2 * value + 0.02**2)
    assert image.mean() == pytest.approx(255 * value, abs=0.3)
    assert image.std() == pytest.approx(np.hypot(wanted, np.sqrt(1 / 12)), rel=0.03)


def test_gain_tone_and_fall_off() -> None:
    bright = expose(flat(0.3), ImageNoise.none(), PINHOLE, (0, 0, 0), 2.0)
    np.testing.assert_array_equal(bright, 153)
    toned = expose(flat(0.3), replace(ImageNoise.none(), gamma=1.5), PINHOLE, (0, 0, 0), 1.0)
    np.testing.assert_array_equal(toned, round(255 * 0.3 ** (1 / 1.5)))
    dark = replace(ImageNoise.none(), vignetting=1.0)
    corner = expose(flat(0.8), dark, PINHOLE, (0, 0, 0), 1.0)
    cos2 = 1 / (1 + (79.5**2 + 49.5**2) / 60**2)
    assert corner[0, 0] == pytest.approx(255 * 0.8 * cos2**2, abs=0.6)
    assert corner[49, 79] == 204
    assert expose(flat(2.0), ImageNoise.none(), PINHOLE, (0, 0, 0), 1.0).max() == 255


@pytest.mark.parametrize("length", [0.8, 1.7, 3.0, 7.5])
def test_blur_is_centred_and_as_wide_as_the_motion(length: float) -> None:
    picture = flat(0.0, (length, 0.0))
    picture.radiance[:, 80:] = 0.8
    noise = replace(ImageNoise.none(), shutter_s=0.01)
    row = expose(picture, noise, PINHOLE, (0, 0, 0), 1.0)[50].astype(float)
    spread = np.diff(row) / np.diff(row).sum()
    place = np.arange(159) + 0.5
    centre = (spread * place).sum()
    assert centre == pytest.approx(79.5, abs=0.02)
    second = (spread * (place - centre) ** 2).sum()
    # The box of the motion, and the tent of interpolating between pixels.
    assert length**2 / 12 - 0.02 <= second <= length**2 / 12 + 1 / 4


def test_noise_is_that_of_frame_and_camera() -> None:
    noise = replace(ImageNoise(), vignetting=0.0)
    first = expose(flat(0.5), noise, PINHOLE, (1, 2, 0), 1.0)
    np.testing.assert_array_equal(first, expose(flat(0.5), noise, PINHOLE, (1, 2, 0), 1.0))
    for key in ((1, 2, 1), (1, 3, 0), (2, 2, 0)):
        other = expose(flat(0.5), noise, PINHOLE, key, 1.0)
        assert abs(np.corrcoef((first - 127.0).ravel(), (other - 127.0).ravel())[0, 1]) < 0.05


def test_gain_drifts_slowly_and_apart() -> None:
    noise = ImageNoise()
    times = np.arange(0, 60, 0.05)
    left, right = (np.array([noise.gain(3, t, camera) for t in times]) for camera in (0, 1))
    assert 0.03 < np.std(left) < 0.16
    assert np.abs(np.diff(left)).max() < 0.03
    assert 0.005 < np.std(right / left) < 0.05
    assert ImageNoise.none().gain(3, 1.0, 1) == 1.0


def test_depth_has_holes_at_jumps_and_beyond_reach() -> None:
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 15:] = 4.0
    depth[:5] = 9.0
    measured = measure_depth(depth, 1.0, (0, 0))
    assert not measured[:5].any()
    assert not measured[8:, 14].any()
    assert measured[8:, :13].all()
    np.testing.assert_array_equal(measure_depth(depth, 0.0, (0, 0)), depth)
