"""Pictures through lenses that bend are those of the pinhole, bent."""

import cv2
import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.simulation.raycast import raycast
from odomap.simulation.render import OFFSETS, Picture, _seen_from, render
from odomap.simulation.world import LENSES, World
from odomap.vision.rectifier import Rectifier
from odomap.vision.stereo import StereoConfig, match_sparse
from odomap.vision.undistorter import Undistorter

SIZE = (240, 150)
LENS = {
    name: Camera(model, [140 * f, 140 * f, 122.8, 72.4], distortion, SIZE)
    for name, (model, f, distortion) in LENSES.items()
}
each_lens = pytest.mark.parametrize("name", LENS)


@pytest.fixture(scope="module")
def room(noisy_room: World) -> World:
    """A room in which two things move; the noise is in its sensors alone."""
    return noisy_room


@pytest.fixture(scope="module")
def place(room: World) -> tuple[np.ndarray, np.ndarray]:
    """Poses at the middle and the end of an exposure, and their times."""
    mount = room.rig.cameras[0].T_body_camera.matrix
    times = (room.truth.stamps_ns[[1, 2]] - room.truth.stamps_ns[0]) * 1e-9
    return room.truth.Ts_world_body[[1, 2]] @ mount, times


def pixels(camera: Camera) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(float)


def test_a_straight_lens_gives_the_picture_of_the_pinhole(room, place) -> None:
    camera = Camera("pinhole", [140, 142, 122.8, 72.4], [], SIZE)
    Ts, times = place
    wanted = render(room.scene, camera, Ts, times)
    frames = [room.scene.frames_at(float(t)) for t in times]
    views = tuple(_seen_from(f, T) for f, T in zip(frames, Ts, strict=True))
    got = Picture(*raycast(room.scene, camera, Ts[0], views, frames[0], OFFSETS))
    # A pixel centre that falls on an edge to rounding may see either side.
    same = np.abs(got.depth - wanted.depth) <= 1e-5 * wanted.depth
    assert same.mean() > 0.9999
    np.testing.assert_allclose(got.flow[same], wanted.flow[same], rtol=0, atol=1e-3)
    off = np.abs(got.radiance - wanted.radiance)
    assert np.median(off) < 1e-3
    assert off.mean() < 2e-3
    # Things thinner than a pixel may be missed, edges may not.
    assert np.percentile(off, 99.5) < 0.02


@each_lens
def test_depth_and_flow_are_those_of_the_points_seen(room, place, name) -> None:
    camera, (Ts, times) = LENS[name], place
    still = np.full(2, times[0])  # nothing moves but the camera
    picture = render(room.scene, camera, Ts, still)
    rays = camera.unproject(pixels(camera))
    depth, flow = picture.depth.ravel(), picture.flow.reshape(-1, 2)
    hit = (depth > 0.1) & (rays[:, 2] > 0.05)
    assert hit.mean() > 0.7
    points = (rays / rays[:, 2:])[hit] * depth[hit, None]
    world = points @ Ts[0, :3, :3].T + Ts[0, :3, 3]
    moved = camera.project((world - Ts[1, :3, 3]) @ Ts[1, :3, :3])
    seen = np.isfinite(moved).all(axis=1)
    assert seen.mean() > 0.9
    wanted = 2 * (moved - pixels(camera)[hit])
    np.testing.assert_allclose(flow[hit][seen], wanted[seen], rtol=1e-3, atol=2e-3)


@each_lens
def test_undone_the_bend_is_gone(room, place, name) -> None:
    """The picture through the lens, undistorted, is the picture of the ideal pinhole."""
    camera, (Ts, times) = LENS[name], place
    fine = Camera(camera.model, camera.intrinsics * 2, camera.distortion, (480, 300))
    undistorter = Undistorter(fine)
    bent = render(room.scene, fine, Ts, times)
    got = undistorter.undistort(np.clip(bent.radiance * 255, 0, 255).astype(np.uint8))
    ideal = render(room.scene, undistorter.camera, Ts, times)
    wanted = np.clip(ideal.radiance * 255, 0, 255)
    # Towards its rim a pinhole is finer than the fisheye it is made from.
    seen = undistorter.mask.copy()
    assert seen.mean() > 0.7
    rays = undistorter.camera.unproject(pixels(undistorter.camera))
    seen &= (rays[:, 2] > np.cos(np.deg2rad(30))).reshape(seen.shape)
    smooth = cv2.GaussianBlur(wanted.astype(np.float64), (0, 0), 1.0)
    off = cv2.GaussianBlur(got.astype(np.float64), (0, 0), 1.0) - smooth
    slopes = np.stack(np.gradient(smooth)[::-1], axis=-1)
    # In each quarter, the shift that explains best what is left: none, so nothing is bent either.
    for rows in (slice(0, 150), slice(150, None)):
        for columns in (slice(0, 240), slice(240, None)):
            part = seen[rows, columns]
            assert part.mean() > 0.2
            across = slopes[rows, columns][part]
            shift = np.linalg.lstsq(across, -off[rows, columns][part], rcond=None)[0]
            assert np.abs(shift).max() < 0.05, shift


def test_points_beside_the_camera_are_in_the_picture() -> None:
    world = World.make(seed=3, frames=1, noise=0.0, sensors=("mono", "depth"), resolution=SIZE,
                       lens="kannala_brandt")  # fmt: skip
    camera = world.rig.cameras[0].camera
    assert camera.model == "kannala_brandt"
    frame = world.frame(0)
    rays = camera.unproject(pixels(camera)).reshape(*SIZE[::-1], 3)
    assert rays[75, 0, 2] < 0  # more than 90° to the side
    assert frame.images[0][75, 0] > 5
    assert frame.depth is not None
    assert frame.depth[75, 0] == 0  # there is no depth along the axis to tell
    assert (frame.depth[rays[..., 2] > 0.1] > 0).all()  # a room has walls all around


def test_a_fisheye_pair_measures_depth() -> None:
    world = World.make(seed=3, frames=1, noise=0.0, resolution=(480, 300), lens="kannala_brandt")
    rectifier = Rectifier(world.rig)
    frame = world.frame(0)
    left = rectifier.rectify(frame.images[0], "left")
    right = rectifier.rectify(frame.images[1], "right")
    corners = cv2.goodFeaturesToTrack(left, 300, 0.01, 8, mask=rectifier.mask.astype(np.uint8))
    points = corners[:, 0].astype(float)
    disparity = match_sparse(left, right, points, StereoConfig(max_disparity_px=64))
    good = np.isfinite(disparity)
    assert good.mean() > 0.5
    depth = rectifier.camera.fx * rectifier.baseline / disparity[good]
    Ts = np.stack([world.truth.Ts_world_body[0] @ rectifier.T_body_camera] * 2)
    exact = render(world.scene, rectifier.camera, Ts, np.zeros(2)).depth
    at = np.round(points[good]).astype(int)
    relative = np.abs(depth / exact[at[:, 1], at[:, 0]] - 1)
    assert np.median(relative) < 0.02


def test_every_frame_is_the_same_whatever_was_asked_before() -> None:
    kind = {"seed": 2, "frames": 3, "resolution": (96, 64), "lens": "radtan"}
    world = World.make(**kind)
    later = world.frame(2).images[1].tobytes()
    world.frame(0)
    assert world.frame(2).images[1].tobytes() == later
    assert World.make(**kind | {"lens": "pinhole"}).frame(2).images[1].tobytes() != later
