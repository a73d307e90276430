"""Depth of sensors behind a lens, and of stereo pairs; rigs that have none."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.maps.depthviews import SensorViews, StereoViews, depth_views
from odomap.sensors.frame import Frame
from odomap.sensors.rig import CameraMount, DepthMount, Rig
from odomap.simulation.world import World

LENS = Camera("pinhole", (120.0, 120.0, 79.5, 59.5), (-0.25, 0.06, 0.001, -0.001), (160, 120))
PLANE = np.array([0.1, -0.2, -0.9])


def a_rig(camera, T_body_camera=None):
    mount = CameraMount("rgb", camera, T_body_camera or SE3.identity())
    return Rig((mount,), DepthMount("rgb"))


def plane_depth(camera):
    """Depth along the axis of the plane PLANE·P = -2, through the lens."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height))
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], 1))
    return (-2.0 / (rays / rays[:, 2:] @ PLANE)).reshape(u.shape).astype(np.float32)


def a_frame(depth, image=None):
    image = np.full(depth.shape[:2], 90, np.uint8) if image is None else image
    return Frame(3, 0, (image,), depth=depth)


def test_depth_behind_a_lens_lies_on_the_plane():
    views = SensorViews(a_rig(LENS))
    assert not np.any(views.camera.distortion)
    view = views.view(a_frame(plane_depth(LENS)))
    ideal = plane_depth(views.camera)
    known = view.depth > 0
    assert known.mean() > 0.9
    # A whole pixel is read, up to half a one away.
    np.testing.assert_allclose(view.depth[known], ideal[known], rtol=5e-3)


def test_depth_is_never_mixed_of_two_surfaces():
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, 70:] = 3.0
    view = SensorViews(a_rig(LENS)).view(a_frame(depth))
    assert set(np.unique(view.depth)) <= {0.0, 1.0, 3.0}


def test_a_pinhole_passes_through():
    camera = Camera(intrinsics=(120.0, 120.0, 79.5, 59.5), resolution=(160, 120))
    T = SE3.exp([0.1, 0.2, 0.3, 0.1, 0.0, -0.2])
    views = SensorViews(a_rig(camera, T))
    depth, colour = plane_depth(camera), np.zeros((120, 160, 3), np.uint8)
    view = views.view(a_frame(depth), colour)
    np.testing.assert_array_equal(view.depth, depth)
    assert view.colour is colour
    assert views.T_body_camera == T


def test_a_frame_without_depth_has_no_view():
    assert SensorViews(a_rig(LENS)).view(Frame(0, 0, (np.zeros((120, 160), np.uint8),))) is None


def test_other_sizes_are_refused():
    views = SensorViews(a_rig(LENS))
    with pytest.raises(InputError, match="frame 3: depth is 80x60, camera 'rgb' is calibrated for"):
        views.view(a_frame(plane_depth(LENS)[::2, ::2]))
    with pytest.raises(InputError, match="frame 3: image is 160x100"):
        views.view(a_frame(plane_depth(LENS), np.zeros((100, 160), np.uint8)))


def test_a_stereo_pair_has_depth():
    world = World.make(kind="room", seed=1, frames=1, sensors=("stereo", "depth"))
    frame = world.frame(0)
    views = StereoViews(world.rig)
    view = views.view(frame)
    both = (view.depth > 0) & (view.depth < 3.0) & (frame.depth > 0)
    assert both.sum() > 10_000
    error = np.abs(view.depth[both] - frame.depth[both])
    sigma = views.noise * view.depth[both] ** 2
    # The noise that is claimed is about that which is there.
    assert 0.2 < np.median(error / sigma) < 1.5
    assert np.mean(error > 0.1 * frame.depth[both]) < 0.05
    assert view.colour.shape == (400, 640)


def test_a_stereo_pair_with_a_missing_image_has_no_view():
    world = World.make(kind="room", seed=1, frames=1, resolution=(64, 48))
    frame = world.frame(0)
    views = StereoViews(world.rig)
    assert views.view(Frame(0, 0, (frame.images[0], None))) is None


def test_the_sensor_comes_before_the_pair_and_one_camera_has_no_depth():
    both = World.make(kind="room", frames=1, resolution=(64, 48), sensors=("stereo", "depth")).rig
    assert isinstance(depth_views(both), SensorViews)
    pair = World.make(kind="room", frames=1, resolution=(64, 48)).rig
    assert isinstance(depth_views(pair), StereoViews)
    alone = World.make(kind="room", frames=1, resolution=(64, 48), sensors=("mono",)).rig
    with pytest.raises(InputError, match=r"there is no depth: .* this rig has one camera"):
        depth_views(alone)
