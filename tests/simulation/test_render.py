"""Pictures agree with geometry: depth, reprojection, disparity, flow."""

import cv2
import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.simulation.light import Lights
from odomap.simulation.render import Picture, render
from odomap.simulation.scene import Scene, SceneBuilder
from odomap.simulation.world import World

CAMERA = Camera("pinhole", np.array([120.0, 125.0, 79.0, 48.0]), np.zeros(0), (160, 100))
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def wall(distance: float = 3.0, tilt: float = 0.0) -> Scene:
    """One large wall that faces -x, turned about z."""
    lights = Lights(1.0, 1.0, np.zeros((0, 3)), np.zeros(0))
    builder = SceneBuilder(np.random.default_rng(0), lights, (0.25, 0.25))
    number = builder.paint("poster", 512, 512)
    c, s = np.cos(tilt), np.sin(tilt)
    right = np.array([s, -c, 0.0])
    corner = np.array([distance, 0, 0]) - 2 * right + np.array([0, 0, 1.5])
    builder.rectangle(corner, right, np.array([0, 0, -1.0]), (4.0, 3.0), number)
    return builder.build()


def look(scene: Scene, T_world_camera: np.ndarray, camera: Camera = CAMERA) -> Picture:
    return render(scene, camera, np.stack([T_world_camera] * 2), np.zeros(2))


def pixels(camera: Camera) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(float)


def rays(camera: Camera) -> np.ndarray:
    bearings = camera.unproject(pixels(camera))
    return bearings / bearings[:, 2:]


@pytest.mark.parametrize("tilt", [0.0, 0.4, -1.1])
def test_depth_is_that_of_the_plane(tilt: float) -> None:
    T = AHEAD.copy()
    T[:3, 3] = [0.3, 0.9, -0.5]
    picture = look(wall(tilt=tilt), T)
    normal = np.array([np.cos(tilt), np.sin(tilt), 0.0])
    directions = rays(CAMERA) @ T[:3, :3].T
    wanted = normal @ (np.array([3.0, 0, 0]) - T[:3, 3]) / (directions @ normal)
    hit = picture.depth.ravel() > 0
    assert 0.2 < hit.mean() < 1.0
    np.testing.assert_allclose(picture.depth.ravel()[hit], wanted[hit], rtol=1e-6)
    points = T[:3, 3] + directions * wanted[:, None]
    along = (points - [3.0, 0, 0]) @ np.array([np.sin(tilt), -np.cos(tilt), 0.0])
    inside = (np.abs(along) < 2) & (np.abs(points[:, 2]) < 1.5) & (wanted > 0)
    np.testing.assert_array_equal(hit, inside)


def test_behind_is_sky_and_edges_are_mixed_by_area() -> None:
    scene = wall(tilt=0.0)
    back = AHEAD.copy()
    back[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ AHEAD[:3, :3]
    away = look(scene, back)
    assert not away.depth.any()
    np.testing.assert_allclose(away.radiance, 0.25)
    lights = Lights(1.0, 1.0, np.zeros((0, 3)), np.zeros(0))
    builder = SceneBuilder(np.random.default_rng(0), lights, (0.0, 0.0))
    number = builder.paint("plaster", 64, 64)
    # The right edge falls on column 79 + 120 * 0.33 / 3 = 92.2.
    corner, right = np.array([3.0, 2.0, 2.0]), np.array([0, -1.0, 0])
    builder.rectangle(corner, right, np.array([0, 0, -1.0]), (2.33, 4.0), number, 20.0)
    row = look(builder.build(), AHEAD).radiance[50]
    share = row[92] / row[90]
    assert share == pytest.approx(0.7, abs=0.15)
    assert row[93] == 0.0


def test_flow_is_the_motion_of_the_pixels() -> None:
    scene = wall(tilt=0.3)
    end = AHEAD.copy()
    end[:3, 3] = [0.01, 0.004, -0.003]
    picture = render(scene, CAMERA, np.stack([AHEAD, end]), np.zeros(2))
    points = rays(CAMERA) * picture.depth.reshape(-1, 1) @ AHEAD[:3, :3].T
    hit = picture.depth.ravel() > 0
    moved = CAMERA.project((points - end[:3, 3]) @ end[:3, :3])
    wanted = 2 * (moved - pixels(CAMERA))
    np.testing.assert_allclose(picture.flow.reshape(-1, 2)[hit], wanted[hit], atol=1e-4)


def views(world: World, first: int, second: int) -> list[tuple[Picture, np.ndarray]]:
    """Pictures of the left camera at two frames, with its poses."""
    mount = world.rig.cameras[0]
    out = []
    for index in (first, second):
        T = world.truth.Ts_world_body[index] @ mount.T_body_camera.matrix
        out.append((look(world.scene, T, mount.camera), T))
    return out


def test_a_point_looks_the_same_from_elsewhere(ideal_room: World) -> None:
    camera = ideal_room.rig.cameras[0].camera
    (here, T_here), (there, T_there) = views(ideal_room, 0, 5)
    points = rays(camera) * here.depth.reshape(-1, 1) @ T_here[:3, :3].T + T_here[:3, 3]
    seen = (points - T_there[:3, 3]) @ T_there[:3, :3]
    place = camera.project(seen).astype(np.float32)
    inside = camera.is_inside(place, 2)
    maps = [np.ascontiguousarray(place[:, k].reshape(here.depth.shape)) for k in (0, 1)]
    depth = cv2.remap(there.depth, *maps, cv2.INTER_LINEAR).ravel()
    visible = inside & (np.abs(depth - seen[:, 2]) < 0.01 * seen[:, 2])
    assert visible.mean() > 0.6
    radiance = cv2.remap(there.radiance, *maps, cv2.INTER_CUBIC).ravel()
    error = (radiance - here.radiance.ravel())[visible]
    assert abs(np.mean(error)) < 5e-4
    assert np.median(np.abs(error)) < 0.006
    assert np.percentile(np.abs(error), 95) < 0.05


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_disparity_has_no_bias(noise: float) -> None:
    errors = np.concatenate([disparity_errors(seed, noise) for seed in (4, 6)])
    assert len(errors) > 150
    assert abs(np.mean(errors)) < 0.02
    assert abs(np.median(errors)) < 0.01
    assert np.median(np.abs(errors)) < 0.08


def disparity_errors(seed: int, noise: float) -> np.ndarray:
    """Photometric disparity minus the true one at corners away from depth edges, pixels."""
    world = World.make(
        kind="room", seed=seed, frames=40, noise=noise, calibration_px=0, sensors=("stereo",)
    )
    left, right = world.rig.stereo_pair()
    baseline = (left.T_body_camera.inverse() @ right.T_body_camera).t[0]
    errors = []
    for index in (0, 39):
        images = world.frame(index).images
        T = world.truth.Ts_world_body[index] @ left.T_body_camera.matrix
        depth = look(world.scene, T, left.camera).depth
        corners = cv2.goodFeaturesToTrack(images[0], 300, 0.005, 8)[:, 0]
        for x, y in corners.astype(int):
            patch = depth[y - 6 : y + 7, x - 6 : x + 7]
            if 60 < x < 620 and 20 < y < 380 and np.ptp(1 / patch) * 44 < 0.4:
                truth = left.camera.fx * baseline / depth[y, x]
                errors.append(refine(images, x, y, truth) - truth)
    out = np.array(errors)
    return out[np.abs(out) < 0.7]


def refine(images: tuple[np.ndarray, ...], x: int, y: int, disparity: float) -> float:
    """Align a 11x11 patch along the row by Gauss-Newton, gain and offset free."""
    left, right = (image.astype(np.float32) for image in images)
    patch = cv2.getRectSubPix(left, (11, 11), (float(x), float(y)))
    slope = cv2.getRectSubPix(left, (13, 11), (float(x), float(y)))
    slope = (slope[:, 2:] - slope[:, :-2]) / 2
    A = np.column_stack([slope.ravel(), patch.ravel(), np.ones(121)])
    for _ in range(8):
        other = cv2.getRectSubPix(right, (11, 11), (float(x - disparity), float(y)))
        step = np.linalg.lstsq(A, other.ravel() - patch.ravel(), rcond=None)[0][0]
        disparity += float(np.clip(step, -0.5, 0.5))
    return disparity
