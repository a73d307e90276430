"""A map as COLMAP text, read back by a reader that follows COLMAP's description of the format."""

import numpy as np
import pytest

from mapworlds import rich_map
from odomap.cli import main
from odomap.errors import InputError, OutputError
from odomap.files.colmap import write_colmap
from odomap.files.mapfile import save_map
from odomap.files.rig import write_rig
from odomap.geometry.camera import Camera
from odomap.geometry.lie import rotation_from_quaternion, se3_exp, se3_inverse
from odomap.geometry.pose import SE3
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.rig import CameraMount, Rig
from odomap.vision.features import Features

CAMERA = Camera(intrinsics=(410.5, 408.25, 319.5, 241.0), resolution=(640, 480))
T_BODY_CAMERA = se3_exp(np.array([0.1, -0.05, 0.2, 0.3, -1.2, 0.7]))


def rows(path):
    lines = path.read_text().splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def read(folder):
    """Return cameras, images (with points2D) and points by id."""
    cameras = {int(c[0]): (c[1], int(c[2]), int(c[3]), *map(float, c[4:]))
               for c in rows(folder / "cameras.txt")}  # fmt: skip
    lines, images = rows(folder / "images.txt"), {}
    for head, at in zip(lines[::2], lines[1::2], strict=True):
        T = np.eye(4)
        T[:3, :3] = rotation_from_quaternion(np.array(head[1:5], float))
        T[:3, 3] = np.array(head[5:8], float)
        table = np.array(at, float).reshape(-1, 3)
        images[int(head[0])] = (T, int(head[8]), head[9], table[:, :2], table[:, 2].astype(int))
    points = {
        int(p[0]): (np.array(p[1:4], float), float(p[7]), np.array(p[8:], int).reshape(-1, 2))
        for p in rows(folder / "points3D.txt")
    }
    return cameras, images, points


def simulated(scale=1.0, noise_px=0.0):
    """A map of six keyframes around a cloud, whose features are projections of its landmarks."""
    rng = np.random.default_rng(4)
    points = rng.normal(size=(40, 3))
    m, ids = Map(), None
    for n in range(6):
        T_world_camera = np.eye(4)
        T_world_camera[:3, 3] = [0.3 * n - 1, 0.1 * n, -6.0]
        mount = T_BODY_CAMERA.copy()
        mount[:3, 3] *= scale
        T_world_body = T_world_camera @ se3_inverse(mount)
        pixels = CAMERA.project(points - T_world_camera[:3, 3])
        pixels = np.concatenate([pixels + noise_px, rng.uniform(0, 400, (5, 2))])
        features = Features(
            pixels.astype(np.float32),
            np.zeros((45, 32), np.uint8),
            CAMERA.unproject(pixels),
            np.full(45, np.nan),
            np.zeros(45, np.uint8),
        )
        k = Keyframe(m.new_keyframe_id(), 10**9 + n, features=features)
        m.add_keyframe(k, T_world_body, scale=scale)
        if ids is None:
            p = (points - T_world_body[:3, 3]) @ T_world_body[:3, :3] / scale
            ids = m.add_landmarks(k.id, p)
        m.add_observations(k.id, ids[n:], np.arange(n, 40))
    return m


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_map_read_back_sees_its_points_where_it_says(tmp_path, scale):
    m = simulated(scale)
    model = write_colmap(tmp_path, m, CAMERA, T_BODY_CAMERA)
    assert len(model.keyframes) == 6
    assert len(model.obs_image) == sum(range(35, 41))
    cameras, images, points = read(tmp_path)
    assert cameras == {1: ("PINHOLE", 640, 480, 410.5, 408.25, 320.0, 241.5)}
    assert sorted(images) == [1, 2, 3, 4, 5, 6]
    _, _, _, fx, fy, cx, cy = cameras[1]
    for T_camera_world, camera_id, name, pixels, seen in images.values():
        assert camera_id == 1
        assert name.endswith(".png")
        assert len(pixels) == 45
        known = seen >= 0
        p = np.array([points[i][0] for i in seen[known]]) @ T_camera_world[:3, :3].T
        p += T_camera_world[:3, 3]
        expected = p[:, :2] / p[:, 2:] * [fx, fy] + [cx, cy]
        np.testing.assert_allclose(pixels[known], expected, atol=1e-4)


def test_tracks_and_features_say_the_same(tmp_path):
    write_colmap(tmp_path, simulated(), CAMERA, T_BODY_CAMERA)
    _, images, points = read(tmp_path)
    of_images = {(i, n, p) for i, v in images.items() for n, p in enumerate(v[4]) if p >= 0}
    of_points = {(i, n, p) for p, v in points.items() for i, n in v[2].tolist()}
    assert of_images == of_points
    assert len(points) == 40


def test_errors_are_the_mean_distances_in_pixels(tmp_path):
    write_colmap(tmp_path, simulated(noise_px=np.array([3.0, 4.0])), CAMERA, T_BODY_CAMERA)
    errors = [error for _, error, _ in read(tmp_path)[2].values()]
    np.testing.assert_allclose(errors, 5.0, atol=1e-3)


def test_maps_of_all_kinds_are_written_and_twice_the_same(tmp_path):
    """Stubs, fused and removed landmarks, keyframes without features, landmarks behind cameras."""
    m = rich_map()
    m.add_keyframe(Keyframe(m.new_keyframe_id(), m.keyframe(4).stamp_ns), np.eye(4))
    write_colmap(tmp_path, m, CAMERA, T_BODY_CAMERA)
    first = [(tmp_path / f"{n}.txt").read_bytes() for n in ("cameras", "images", "points3D")]
    _, images, points = read(tmp_path)
    assert sorted(images) == [k + 1 for k in m.keyframe_ids]
    assert len({v[2] for v in images.values()}) == len(images)
    assert {p - 1 for p in points} <= set(m.landmark_ids.tolist())
    at = {(i, n): p for i, v in images.items() for n, p in enumerate(v[4]) if p >= 0}
    assert {(i, n): p for p, v in points.items() for i, n in v[2].tolist()} == at
    write_colmap(tmp_path, m, CAMERA, T_BODY_CAMERA)
    assert first == [
        (tmp_path / f"{n}.txt").read_bytes() for n in ("cameras", "images", "points3D")
    ]


def test_of_two_landmarks_at_one_feature_the_older_has_it(tmp_path):
    m = simulated()
    new = m.add_landmarks(0, np.array([[0.0, 0.0, 3.0]]))
    m.add_observations(2, new, [7])
    model = write_colmap(tmp_path, m, CAMERA, T_BODY_CAMERA)
    assert new[0] not in model.point_ids
    assert read(tmp_path)[1][3][4][7] == m.landmark_ids[7] + 1


def test_what_cannot_be_written_is_said(tmp_path):
    with pytest.raises(InputError, match="empty"):
        write_colmap(tmp_path, Map(), CAMERA, T_BODY_CAMERA)
    lens = Camera(
        intrinsics=CAMERA.intrinsics, resolution=(640, 480), distortion=(0.1, 0.0, 0.0, 0.0)
    )
    with pytest.raises(InputError, match="ideal pinhole"):
        write_colmap(tmp_path, simulated(), lens, T_BODY_CAMERA)
    with pytest.raises(OutputError, match="nowhere"):
        write_colmap(tmp_path / "nowhere", simulated(), CAMERA, T_BODY_CAMERA)


def a_rig():
    return Rig(cameras=(CameraMount("cam", CAMERA, SE3(T_BODY_CAMERA)),), body="")


def test_the_command_line_takes_the_camera_from_the_map(tmp_path, capsys):
    """A single camera is the body, so the images are at the keyframes; --rig replaces the rig."""
    m = simulated()
    save_map(tmp_path / "map.odomap", m, a_rig(), settings={"sensors": "mono"})
    assert main(["export", str(tmp_path), "--colmap", str(tmp_path / "new" / "model")]) == 0
    assert "6 images, 40 points, seen 225 times" in capsys.readouterr().out
    cameras, images, _ = read(tmp_path / "new" / "model")
    assert cameras[1][1:] == (640, 480, 410.5, 408.25, 320.0, 241.5)
    np.testing.assert_allclose(images[3][0], se3_inverse(m.T_world_body(2)), atol=1e-12)


def test_maps_that_do_not_say_their_cameras_are_given_them(tmp_path, capsys):
    save_map(tmp_path / "map.odomap", simulated())
    words = ["export", str(tmp_path / "map.odomap"), "--colmap", str(tmp_path / "model")]
    assert main(words) == 2
    assert "does not say which cameras it was made with" in capsys.readouterr().err
    write_rig(tmp_path / "rig.yaml", a_rig())
    assert main([*words, "--rig", str(tmp_path / "rig.yaml")]) == 0
    assert len(read(tmp_path / "model")[1]) == 6
