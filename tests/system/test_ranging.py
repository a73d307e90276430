"""Rangers: inverse depth from one frame, how sure it is, and what is said when it cannot be."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError, InputError
from odomap.sensors.frame import Frame
from odomap.system.association import FlowAssociation
from odomap.system.config import preset
from odomap.system.eye import Eye
from odomap.system.ranging import UNIT_BASELINE, DepthRanger, StereoRanger
from odomap.vision.depth import DepthConfig
from odomap.vision.rectifier import Rectifier
from odomap.vision.stereo import StereoConfig


def looked_at(eye, frame, count=200):
    """Return the frame's view and corners in it."""
    config = preset("stereo-flow")
    association = FlowAssociation(config.features, config.flow, eye.mask)
    view = association.view(frame.id, frame.stamp_ns, eye.image(frame))
    return view, association.extend(view, np.empty((0, 2)), count)[0]


@pytest.fixture(scope="module")
def pair(room):
    rectifier = Rectifier(room.rig)
    eye = Eye.of_pair(room.rig, rectifier)
    ranger = StereoRanger.of(room.rig, rectifier, StereoConfig(), 0.15)
    view, points = looked_at(eye, room.frame(0))
    return eye, ranger, view, points


@pytest.fixture(scope="module")
def sensor(depth_room):
    eye = Eye.of_camera(depth_room.rig.cameras[0].camera)
    view, points = looked_at(eye, depth_room.frame(0))
    return eye, DepthRanger(eye, DepthConfig()), view, points


NOTHING = np.empty(0)


# ---- both ----


def test_inverse_depth_is_the_disparity_of_a_pair_one_metre_apart():
    assert UNIT_BASELINE == 1.0


def test_both_measure_the_same_room(room, depth_room, pair, sensor):
    """The two worlds are one: what the pair measures is what the sensor knows."""
    eye, ranger, view, points = pair
    found = ranger.measure(room.frame(0), view, points, NOTHING)
    rays = eye.camera.unproject(points)
    R = eye.T_body_camera[:3, :3]
    left = room.rig.stereo_pair()[0]
    # In the axes of the left camera as it came, which is the depth camera of the other world.
    in_left = rays / rays[:, 2:] @ (left.T_body_camera.R.T @ R).T
    at = depth_room.rig.cameras[0].camera.project(in_left)
    known = DepthRanger(sensor[0], DepthConfig()).measure(depth_room.frame(0), view, at, NOTHING)
    known = known * in_left[:, 2]  # of the axis of the left camera, to that of the rectified one
    both = np.isfinite(found) & np.isfinite(known)
    assert both.sum() > 60
    off = (found - known)[both] / ranger.sigma
    assert np.abs(np.median(off)) < 1.0
    assert np.median(np.abs(off)) < 2.5


# ---- a pair ----


def test_a_pair_errs_by_a_pixel_over_focal_length_and_baseline(room, pair):
    eye, ranger, _, _ = pair
    fb = eye.camera.fx * Rectifier(room.rig).baseline
    assert ranger.sigma == pytest.approx(StereoConfig().noise_px / fb)
    assert ranger.calibration == pytest.approx(0.15 / fb)
    finer = replace(ranger, config=replace(ranger.config, noise_px=0.1))
    assert finer.sigma == pytest.approx(0.1 / fb)


def test_a_pair_measures_positive_inverse_depth_or_none(room, pair):
    _, ranger, view, points = pair
    found = ranger.measure(room.frame(0), view, points, NOTHING)
    assert found.shape == (len(points),)
    known = np.isfinite(found)
    assert known.mean() > 0.5
    assert (1.0 / found[known] > 0.3).all()
    assert np.median(1.0 / found[known]) < 8.0


def test_what_is_expected_narrows_the_search(room, pair):
    _, ranger, view, points = pair
    found = ranger.measure(room.frame(0), view, points, NOTHING)
    known = np.flatnonzero(np.isfinite(found))
    order = np.concatenate([known, np.setdiff1d(np.arange(len(points)), known)])
    again = ranger.measure(room.frame(0), view, points[order], found[known])
    assert np.isfinite(again[: len(known)]).mean() > 0.95
    near = again[: len(known)] - found[known]
    assert np.nanmax(np.abs(near)) < 0.2 * ranger.sigma
    # Expected somewhere else, nothing is found there by chance.
    wrong = ranger.measure(room.frame(0), view, points[known], found[known] + 1.0)
    assert np.isfinite(wrong).mean() < 0.2


def test_dense_matching_measures_the_same(room, pair):
    _, ranger, view, points = pair
    dense = replace(ranger, config=replace(ranger.config, method="sgbm"))
    a = ranger.measure(room.frame(0), view, points, NOTHING)
    b = dense.measure(room.frame(0), view, points, NOTHING)
    both = np.isfinite(a) & np.isfinite(b)
    assert both.sum() > 60
    assert np.median(np.abs(a - b)[both]) < 2 * ranger.sigma


def test_a_missing_right_image(room, pair):
    _, ranger, _, _ = pair
    left = room.frame(0).images[0]
    assert ranger.missing(room.frame(0)) == ""
    for images in ((left,), (left, None)):
        assert ranger.missing(Frame(0, 0, images)) == "the right image is missing"


def test_a_swapped_pair_is_told(room, pair):
    eye, ranger, view, points = pair
    ranger.check(room.frame(0), view, points)
    swapped = replace(room.frame(0), images=room.frame(0).images[::-1])
    view, points = looked_at(eye, swapped)
    with pytest.raises(CalibrationError, match="left and right are swapped"):
        ranger.check(swapped, view, points)


# ---- a sensor ----


def test_a_sensor_errs_as_its_section_says(sensor):
    eye, ranger, _, _ = sensor
    assert ranger.sigma == DepthConfig().noise
    assert ranger.calibration == DepthConfig().calibration
    rough = DepthRanger(eye, DepthConfig(noise=0.01, calibration=0.005))
    assert (rough.sigma, rough.calibration) == (0.01, 0.005)


def test_a_sensor_is_read_where_the_raw_image_has_the_point(depth_room, sensor):
    _, _, view, _ = sensor
    bent = replace(
        depth_room.rig.cameras[0].camera, distortion=np.array([-0.28, 0.07, 2e-4, -1e-4])
    )
    eye = Eye.of_camera(bent)
    # A depth image whose value says where it was read.
    ramp = np.tile(1.0 + np.arange(400, dtype=np.float32) / 400, (250, 1))
    frame = replace(depth_room.frame(0), depth=ramp)
    at = np.array([[40.0, 30.0], [200.0, 120.0], [360.0, 200.0]])
    found = 1.0 / DepthRanger(eye, DepthConfig()).measure(frame, view, at, NOTHING)
    raw = bent.project(eye.camera.unproject(at))
    assert np.abs(raw - at).max() > 3
    np.testing.assert_allclose(found, 1.0 + raw[:, 0] / 400, atol=1e-4)


def test_a_missing_depth_image(depth_room, sensor):
    _, ranger, _, _ = sensor
    assert ranger.missing(depth_room.frame(0)) == ""
    assert ranger.missing(replace(depth_room.frame(0), depth=None)) == "the depth image is missing"


@pytest.mark.parametrize("shape", [(125, 200), (400, 250), (250, 401)])
def test_depth_of_another_size(depth_room, sensor, shape):
    _, ranger, view, points = sensor
    frame = replace(depth_room.frame(0), id=3, depth=np.ones(shape, np.float32))
    wanted = f"frame 3: the depth image is {shape[1]}x{shape[0]}, the camera's 400x250"
    with pytest.raises(InputError, match=wanted):
        ranger.measure(frame, view, points, NOTHING)


@pytest.mark.parametrize(("factor", "is_told"), [(1.0, False), (5.0, True), (1000.0, True)])
def test_depth_that_cannot_be(depth_room, sensor, factor, is_told):
    """Files of 5000 per metre read with 5000, 1000 and 5."""
    _, ranger, view, points = sensor
    frame = depth_room.frame(0)
    frame = replace(frame, depth=np.float32(factor) * frame.depth)
    if not is_told:
        ranger.check(frame, view, points)
        return
    with pytest.raises(CalibrationError, match=r"% of the values lie outside 0\.2 to 8 m") as e:
        ranger.check(frame, view, points)
    assert "is the depth factor right? Else set depth.nearest and depth.farthest" in str(e.value)


def test_millimetres_taken_for_more_than_they_are(depth_room, sensor):
    """Files of 1000 per metre read with 50000."""
    _, ranger, view, points = sensor
    frame = replace(depth_room.frame(0), depth=depth_room.frame(0).depth / np.float32(50))
    with pytest.raises(CalibrationError, match="100 % of the values"):
        ranger.check(frame, view, points)


def test_an_image_of_holes_is_no_wrong_factor(depth_room, sensor):
    """Hardly any depth says nothing of its factor: starting waits instead."""
    _, ranger, view, points = sensor
    ranger.check(replace(depth_room.frame(0), depth=np.zeros((250, 400), np.float32)), view, points)
    few = np.zeros((250, 400), np.float32)
    few[:10] = 50.0
    ranger.check(replace(depth_room.frame(0), depth=few), view, points)
