"""How a camera turned, from rendered images that differ by a turn."""

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.lie import so3_exp, so3_log
from odomap.vision.turning import Thumbnail, turn_between

CAMERA = Camera(intrinsics=(150.0, 152.5, 99.0, 63.0), resolution=(200, 125))


class Sky:
    """Brightness in every direction: waves of 4 to 40 degrees on the sphere."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        axes = rng.normal(size=(40, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        self._k = 2 * np.pi / np.radians(rng.uniform(4, 40, 40))[:, None] * axes
        self._phase = rng.uniform(0, 2 * np.pi, 40)

    def image(self, R_world_camera, gain=1.0, offset=0.0):
        """Return what a pinhole sees when turned, (H, W) uint8."""
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
        rays = CAMERA.unproject(pixels) @ R_world_camera.T
        brightness = 120 + 11 * np.sin(rays @ self._k.T + self._phase).sum(axis=1)
        shape = CAMERA.height, CAMERA.width
        return np.clip(gain * brightness + offset, 0, 255).reshape(shape).astype(np.uint8)


@pytest.fixture(scope="module")
def sky():
    return Sky(1)


def thumb(image):
    return Thumbnail.of(image, CAMERA)


def off_deg(R, expected):
    return np.degrees(np.linalg.norm(so3_log(R @ expected.T)))


@pytest.mark.parametrize("degrees", [0.3, 2.0, 5.0, 8.0])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, -0.7, 0.4)])
def test_turns_are_found(sky, degrees, axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    R_before_now = so3_exp(np.radians(degrees) * axis)
    before, now = sky.image(np.eye(3)), sky.image(R_before_now)
    found = turn_between(thumb(before), thumb(now))
    assert found is not None
    assert off_deg(found, R_before_now) < 0.15
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    # And back: it is R_before_now, not its inverse.
    back = turn_between(thumb(now), thumb(before))
    assert off_deg(back, R_before_now.T) < 0.15


def test_the_sign_is_that_of_a_camera_that_looks_right(sky):
    """Turned right (about y, which points down), what was at the centre moves left."""
    right = so3_exp(np.array([0.0, np.radians(4.0), 0.0]))
    found = turn_between(thumb(sky.image(np.eye(3))), thumb(sky.image(right)))
    axis_now = found @ [0.0, 0.0, 1.0]  # the optical axis now, in axes of before
    assert axis_now[0] > 0.05
    ahead_before = found.T @ [0.0, 0.0, 1.0]
    assert CAMERA.project(ahead_before[None])[0, 0] < CAMERA.cx - 7


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 25.0), (1.0, -30.0), (0.9, 5.0)])
def test_brightness_may_change(sky, gain, offset):
    R = so3_exp(np.radians([1.5, -3.0, 1.0]))
    now = sky.image(R, gain, offset)
    found = turn_between(thumb(sky.image(np.eye(3))), thumb(now))
    assert off_deg(found, R) < 0.3


def test_a_halving_is_as_good_as_the_image(sky):
    import cv2

    R = so3_exp(np.radians([2.0, 3.0, -1.0]))
    half = [cv2.pyrDown(sky.image(turn)) for turn in (np.eye(3), R)]
    found = turn_between(*(thumb(image) for image in half))
    assert off_deg(found, R) < 0.2
    np.testing.assert_array_equal(thumb(half[0]).image, thumb(sky.image(np.eye(3))).image)


def test_intrinsics_are_those_of_the_thumbnail(sky):
    small = thumb(sky.image(np.eye(3)))
    assert small.image.shape == (63, 100)
    assert small.image.dtype == np.float32
    np.testing.assert_allclose(small.intrinsics, [75.0, 76.25, 49.5, 31.5])


def test_nothing_is_said_of_images_without_texture(sky):
    flat = np.full((125, 200), 90, np.uint8)
    assert turn_between(thumb(flat), thumb(flat)) is None
    assert turn_between(thumb(flat), thumb(sky.image(np.eye(3)))) is None


def test_a_turn_beyond_the_overlap_is_not_made_up(sky):
    far = turn_between(
        thumb(sky.image(np.eye(3))), thumb(sky.image(so3_exp(np.radians([0.0, 90.0, 0.0]))))
    )
    assert far is None or np.linalg.norm(so3_log(far)) <= 0.5


@pytest.mark.parametrize("seed", range(4))
def test_unrelated_images_give_no_more_than_a_guess(sky, seed):
    """Some turn may fit them a little better than none: it is small, and a rotation."""
    found = turn_between(thumb(sky.image(np.eye(3))), thumb(Sky(50 + seed).image(np.eye(3))))
    assert found is None or (
        np.linalg.norm(so3_log(found)) <= 0.5 and np.allclose(found @ found.T, np.eye(3))
    )


def test_the_same_image_has_not_turned(sky):
    image = sky.image(np.eye(3))
    found = turn_between(thumb(image), thumb(image))
    assert found is None or np.degrees(np.linalg.norm(so3_log(found))) < 1e-3


def test_the_same_images_give_the_same_bytes(sky):
    R = so3_exp(np.radians([2.0, 3.0, -1.0]))
    pair = [thumb(sky.image(turn)) for turn in (np.eye(3), R)]
    np.testing.assert_array_equal(turn_between(*pair), turn_between(*pair))
