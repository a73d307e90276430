"""The eye: an ideal image, whatever the camera."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.frame import Frame
from odomap.system.eye import Eye
from odomap.vision.rectifier import Rectifier

PINHOLE = Camera(intrinsics=(250.0, 251.0, 160.0, 118.0), resolution=(320, 240))
BENT = replace(PINHOLE, distortion=np.array([-0.28, 0.07, 2e-4, -1e-4]))
MOUNT = SE3.exp([0.1, -0.05, 0.2, 0.3, -1.2, 0.4])


def image(seed=0, shape=(240, 320)):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def test_a_single_camera_is_the_body_unless_mounted():
    eye = Eye.of_camera(PINHOLE)
    np.testing.assert_array_equal(eye.T_body_camera, np.eye(4))
    assert (eye.index, eye.name, eye.raw) == (0, "camera", (320, 240))
    eye = Eye.of_camera(PINHOLE, 2, MOUNT)
    np.testing.assert_array_equal(eye.T_body_camera, MOUNT.matrix)
    assert eye.index == 2


def test_a_pinhole_sees_what_came():
    eye = Eye.of_camera(PINHOLE)
    raw = image()
    np.testing.assert_array_equal(eye.image(Frame(0, 0, (raw,))), raw)
    at = np.array([[10.5, 20.25], [300.0, 200.0]])
    np.testing.assert_allclose(eye.to_raw(at), at, atol=1e-9)
    assert eye.mask.all()


def test_a_bent_lens_is_undone():
    eye = Eye.of_camera(BENT)
    assert not len(eye.camera.distortion) or not np.any(eye.camera.distortion)
    seen = eye.image(Frame(0, 0, (image(),)))
    assert seen.shape == eye.mask.shape == eye.camera.resolution[::-1]
    # A ray has the same place by either way.
    at = np.array([[60.0, 50.0], [160.0, 118.0], [250.0, 190.0]])
    np.testing.assert_allclose(eye.to_raw(at), BENT.project(eye.camera.unproject(at)), atol=1e-6)


def test_a_pair_is_seen_by_its_left_camera(room):
    rectifier = Rectifier(room.rig)
    eye = Eye.of_pair(room.rig, rectifier)
    left, _ = room.rig.stereo_pair()
    assert room.rig.cameras[eye.index] == left
    assert eye.name == "left"
    frame = room.frame(0)
    np.testing.assert_array_equal(
        eye.image(frame), rectifier.rectify(frame.images[eye.index], "left")
    )
    np.testing.assert_array_equal(eye.T_body_camera, rectifier.T_body_camera)


@pytest.mark.parametrize("images", [(), (None,), (None, None)])
def test_a_missing_image_is_none(images):
    assert Eye.of_camera(PINHOLE).image(Frame(0, 0, images)) is None


def test_the_index_names_the_image():
    first, second = image(1), image(2)
    eye = Eye.of_camera(PINHOLE, 1)
    np.testing.assert_array_equal(eye.image(Frame(0, 0, (first, second))), second)
    assert eye.image(Frame(0, 0, (first,))) is None


@pytest.mark.parametrize("shape", [(480, 640), (320, 240), (240, 319)])
def test_an_image_of_another_size(shape):
    height, width = shape
    wanted = f"frame 7: the image is {width}x{height}, the calibration is for 320x240"
    with pytest.raises(CalibrationError, match=wanted) as e:
        Eye.of_camera(BENT).image(Frame(7, 0, (image(shape=shape),)))
    assert "calibration of this resolution" in str(e.value)
