"""Calibrations of other programs: what they write is read as what they mean."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.errors import CalibrationError, InputError
from odomap.files.calibrations import read_calibration
from odomap.files.rig import read_rig, write_rig
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, ImuMount, Rig
from odomap.sources.calibration import load_rig

SIZE = (640, 480)
RADTAN = Camera("pinhole", [460.5, 459.25, 322.0, 238.5], [-0.28, 0.07, 2e-4, 1e-5], SIZE)
FISHEYE = Camera("kannala_brandt", [190.5, 190.25, 322.0, 238.5], [3e-3, 7e-4, -2e-3, 2e-4], SIZE)
SPHERES = Camera("double_sphere", [157.5, 157.25, 322.0, 238.5], [-0.2, 0.59], SIZE)
PLAIN = Camera("pinhole", [460.5, 459.25, 322.0, 238.5], [], SIZE)
LENSES = (RADTAN, FISHEYE, SPHERES, PLAIN)


def kalibr_camera(camera: Camera) -> dict:
    intrinsics, distortion = camera.intrinsics.tolist(), camera.distortion.tolist()
    fields = {"rostopic": "/cam/image_raw", "cam_overlaps": [1], "resolution": list(SIZE)}
    if camera.model == "double_sphere":
        fields |= {"camera_model": "ds", "intrinsics": distortion + intrinsics}
        return fields | {"distortion_model": "none", "distortion_coeffs": []}
    lens = "equidistant" if camera.model == "kannala_brandt" else "radtan"
    fields |= {"camera_model": "pinhole", "intrinsics": intrinsics}
    return fields | {
        "distortion_model": lens if len(distortion) else "none",
        "distortion_coeffs": distortion,
    }


def kalibr(rig: Rig, with_imu: bool) -> dict:
    """Say a rig as Kalibr does: each camera from the one before, and all from the IMU."""
    content = {}
    for number, mount in enumerate(rig.cameras):
        fields = kalibr_camera(mount.camera)
        if number:
            T = mount.T_body_camera.inverse() @ rig.cameras[number - 1].T_body_camera
            fields["T_cn_cnm1"] = T.matrix.tolist()
        if with_imu:
            fields["T_cam_imu"] = mount.T_body_camera.inverse().matrix.tolist()
            fields["timeshift_cam_imu"] = mount.time_offset_s
        content[f"cam{number}"] = fields
    return content


def written(folder: Path, content: dict | str, name: str = "camchain.yaml") -> Path:
    file = folder / name
    file.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return file


motion = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6)


@settings(derandomize=True, deadline=None, max_examples=25, database=None)
@given(
    mounts=st.lists(
        st.tuples(st.sampled_from(LENSES), motion, st.floats(-0.1, 0.1)), min_size=1, max_size=12
    ),
    with_imu=st.booleans(),
)
def test_a_camchain_comes_back_as_the_rig_it_says(tmp_path_factory, mounts, with_imu):
    folder = tmp_path_factory.mktemp("kalibr")
    poses = [SE3.exp(np.array(xi)) for _, xi, _ in mounts]
    if not with_imu:
        poses = [poses[0].inverse() @ T for T in poses]
    rig = Rig(
        tuple(
            CameraMount(f"cam{k}", camera, T, 0.0, shift if with_imu else 0.0)
            for k, ((camera, _, shift), T) in enumerate(zip(mounts, poses))
        ),
        imu=ImuMount() if with_imu else None,
    )
    found = read_calibration(written(folder, kalibr(rig, with_imu)))
    assert found.body_sensor == ("imu" if with_imu else "cam0")
    assert [m.name for m in found.cameras] == [m.name for m in rig.cameras]
    for ours, theirs in zip(found.cameras, rig.cameras, strict=True):
        assert ours.camera == theirs.camera
        assert ours.time_offset_s == theirs.time_offset_s
        np.testing.assert_allclose(
            ours.T_body_camera.matrix, theirs.T_body_camera.matrix, atol=1e-12
        )
    # And as a rig.yaml it is the same rig.
    write_rig(folder / "rig.yaml", found)
    again = read_rig(folder)
    assert [m.camera for m in again.cameras] == [m.camera for m in found.cameras]


def test_the_direction_of_kalibrs_transforms(tmp_path):
    # The IMU is 20 cm above the camera (y down): a point at the IMU's origin is at y = -0.2.
    up = np.eye(4)
    up[1, 3] = -0.2
    # The right camera is 11 cm to the right: what is at the left one's origin is at x = -0.11.
    right = np.eye(4)
    right[0, 3] = -0.11
    content = {
        "cam0": kalibr_camera(RADTAN) | {"T_cam_imu": up.tolist(), "timeshift_cam_imu": 0.01},
        "cam1": kalibr_camera(RADTAN) | {"T_cn_cnm1": right.tolist()},
    }
    rig = read_calibration(written(tmp_path, content))
    np.testing.assert_allclose(rig.cameras[0].T_body_camera @ np.zeros((1, 3)), [[0, 0.2, 0]])
    np.testing.assert_allclose(rig.cameras[1].T_body_camera @ np.zeros((1, 3)), [[0.11, 0.2, 0]])
    left, right_mount = rig.stereo_pair()
    assert (left.name, right_mount.name) == ("cam0", "cam1")
    assert rig.cameras[0].time_offset_s == 0.01  # t_imu = t_cam + shift


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera_model": "omni"}, "'omni' is not supported: known are pinhole with radtan, equi"),
        ({"camera_model": "eucm"}, r"cam0: field 'camera_model' 'eucm' .*ds \(double sphere\)"),
        ({"distortion_model": "fov"}, "'fov' is not supported"),
        ({"camera_model": "ds"}, "'ds' is not supported|must have 6 numbers"),
        ({"intrinsics": [1.0, 2.0]}, "cam0: field 'intrinsics' must have 4 numbers, not 2"),
        ({"distortion_coeffs": [0.1]}, "must have 4 numbers, not 1"),
        ({"resolution": [320, 240]}, "cam0: camera 'cam0': principal point .* another resolution"),
        ({"resolution": None}, "'resolution' is empty"),
        ({"T_cam_imu": [[1, 2], [3, 4]]}, "four rows of four numbers"),
    ],
)
def test_camchains_that_cannot_be(tmp_path, change, words):
    file = written(tmp_path, {"cam0": kalibr_camera(RADTAN) | change})
    with pytest.raises(CalibrationError, match=words) as info:
        read_calibration(file)
    assert str(info.value).startswith(str(file))


def test_camchains_with_a_gap(tmp_path):
    two = {"cam0": kalibr_camera(RADTAN), "cam1": kalibr_camera(RADTAN)}
    with pytest.raises(CalibrationError, match="cam1: field 'T_cn_cnm1' is missing"):
        read_calibration(written(tmp_path, two))
    two["cam1"]["T_cam_imu"] = np.eye(4).tolist()
    with pytest.raises(CalibrationError, match="cam0: field 'T_cam_imu' is missing, though"):
        read_calibration(written(tmp_path, two))


def opencv_file(path: Path, **fields) -> Path:
    """Let OpenCV itself write it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in fields.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("names", [("camera_matrix", "distortion_coefficients"), ("K", "D")])
@pytest.mark.parametrize("camera", [RADTAN, FISHEYE])
def test_one_camera_from_opencv(tmp_path, camera, names):
    file = opencv_file(
        tmp_path / "out_camera_data.yml",
        calibration_time="now",
        image_width=640,
        image_height=480,
        fisheye_model=int(camera.model == "kannala_brandt"),
        **{names[0]: camera.K, names[1]: camera.distortion[:, None]},
    )
    assert "!!opencv-matrix" in file.read_text()
    (mount,) = read_calibration(file).cameras
    assert mount.camera == camera
    assert mount.T_body_camera.matrix.tolist() == np.eye(4).tolist()


def stereo(tmp_path, T_left_right: SE3, split: bool, **more) -> Path:
    T = T_left_right.inverse()
    zeros = np.zeros((1, 6))
    inside = {
        "M1": RADTAN.K,
        "D1": np.concatenate([RADTAN.distortion[None], zeros, np.zeros((1, 4))], axis=1),
        "M2": PLAIN.K,
        "D2": np.zeros((1, 5)),
    }
    outside = {"R": T.R, "T": T.t[:, None], "Q": np.eye(4)}
    if split:
        opencv_file(tmp_path / "extrinsics.yml", **outside)
        return opencv_file(tmp_path / "intrinsics.yml", **inside, **more)
    return opencv_file(tmp_path / "stereo.yml", **inside, **outside, **more)


@pytest.mark.parametrize("split", [True, False])
def test_a_pair_from_opencv(tmp_path, split):
    T_left_right = SE3.exp([0.12, 0.003, -0.002, 0.01, -0.02, 0.03])
    file = stereo(tmp_path, T_left_right, split, image_width=640, image_height=480)
    left, right = read_calibration(file).stereo_pair()
    # 14 numbers, of which the last ten are zero.
    assert left.camera.distortion.tolist() == [*RADTAN.distortion.tolist(), 0, 0, 0, 0]
    assert right.camera.distortion.tolist() == [0] * 5
    np.testing.assert_allclose(right.camera.K, PLAIN.K)
    # A point in front of the left camera, as OpenCV maps it: x_right = R x_left + T.
    x_left = np.array([[0.3, -0.2, 2.0]])
    R, T = T_left_right.inverse().R, T_left_right.inverse().t
    x_right = right.T_body_camera.inverse() @ (left.T_body_camera @ x_left)
    np.testing.assert_allclose(x_right[0], R @ x_left[0] + T, atol=1e-12)
    assert (right.T_body_camera @ np.zeros((1, 3)))[0, 0] == pytest.approx(T_left_right.t[0])


def test_a_pair_without_the_size_of_its_images(tmp_path):
    file = stereo(tmp_path, SE3.exp([0.12, 0, 0, 0, 0, 0]), True)
    with pytest.raises(
        CalibrationError, match=r"'image_width' is missing: add 'image_width: \.\.\.'"
    ):
        read_calibration(file)
    file.write_text(file.read_text() + "image_width: 640\nimage_height: 480\n")
    assert len(read_calibration(file).cameras) == 2
    (tmp_path / "extrinsics.yml").unlink()
    with pytest.raises(CalibrationError, match=r"'R' and 'T' .* no extrinsics\.yml beside it"):
        read_calibration(file)


ROS = """
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [460.5, 0., 322.0, 0., 459.25, 238.5, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.07, 2.0e-4, 1e-5, 0.]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [440., 0., 320., 0., 0., 440., 240., 0., 0., 0., 1., 0.]
"""


def test_camera_info_of_ros(tmp_path):
    (mount,) = read_calibration(written(tmp_path, ROS, "left.yaml")).cameras
    assert mount.name == "narrow_stereo"
    np.testing.assert_allclose(mount.camera.intrinsics, RADTAN.intrinsics)
    np.testing.assert_allclose(mount.camera.distortion, [*RADTAN.distortion, 0])
    wide = ROS.replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4")
    wide = wide.replace("1e-5, 0.]", "1e-5]")
    (mount,) = read_calibration(written(tmp_path, wide, "left.yaml")).cameras
    assert mount.camera.model == "kannala_brandt"
    eight = ROS.replace("plumb_bob", "rational_polynomial").replace("cols: 5", "cols: 8")
    eight = eight.replace("1e-5, 0.]", "1e-5, 0.1, 0.2, 0.3, 0.4]")
    (mount,) = read_calibration(written(tmp_path, eight, "left.yaml")).cameras
    assert mount.camera.distortion.tolist()[4:] == [0.1, 0.2, 0.3, 0.4]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("plumb_bob", "double_sphere", "'double_sphere' is not supported: known are plumb_bob"),
        ("plumb_bob", "equidistant", "distortion: 5 numbers, a kannala_brandt camera has 4"),
        ("rows: 3\n  cols: 3\n  data: [460.5, 0.", "rows: 3\n  cols: 2\n  data: [460.5, 0.",
         "'camera_matrix' has 9 numbers for 3 x 2"),
        ("460.5, 0., 322.0", "460.5, 33., 322.0", "has a skew of 33"),
        ("460.5, 0., 322.0, 0., 459.25, 238.5", "460.5, 0., 0., 0., 459.25, 0.",
         r"principal point \(0, 0\) px is far .* give cx, cy in pixels"),
        ("0., 0., 1.]\ndist", "0., 0., 2.]\ndist", "'camera_matrix' must be .fx, 0, cx"),
        ("image_height: 480", "", "field 'image_height' is missing"),
        ("distortion_coefficients", "bend", "'distortion_coefficients' is missing: for a lens w"),
        ("-0.28", "x", "must hold numbers, not 'x'"),
    ],
)  # fmt: skip
def test_camera_infos_that_cannot_be(tmp_path, old, new, words):
    assert old in ROS
    file = written(tmp_path, ROS.replace(old, new, 1), "left.yaml")
    with pytest.raises(CalibrationError, match=words) as info:
        read_calibration(file)
    assert str(info.value).startswith(str(file))


def test_a_thin_prism_is_refused(tmp_path):
    twelve = ROS.replace("cols: 5", "cols: 12").replace("0.]\nrect", "0,0,0,0,1e-3,0,0,0]\nrect")
    with pytest.raises(CalibrationError, match="thin prism"):
        read_calibration(written(tmp_path, twelve))


def test_a_rig_is_read_as_before(tmp_path):
    rig = Rig((CameraMount("left", FISHEYE), CameraMount("other", SPHERES)))
    write_rig(tmp_path / "rig.yaml", rig)
    for path in (tmp_path, tmp_path / "rig.yaml", str(tmp_path / "rig.yaml")):
        assert [m.camera for m in read_calibration(path).cameras] == [FISHEYE, SPHERES]
    with pytest.raises(CalibrationError, match="field 'odomap_rig' is missing"):
        read_calibration(written(tmp_path, "cameras: []"))


@pytest.mark.parametrize("text", ["focal: 500", "cam0: 3", "{}", "cam_0: {camera_model: pinhole}"])
def test_what_is_none_of_them(tmp_path, text):
    known = r"rig.yaml \(odomap_rig: 1\), Kalibr's camchain.yaml .* OpenCV's or ROS'"
    with pytest.raises(CalibrationError, match=known):
        read_calibration(written(tmp_path, text))


def test_what_is_given_with_rig_may_be_any_of_them(tmp_path):
    camchain = written(tmp_path, {"cam0": kalibr_camera(FISHEYE)})
    assert load_rig(str(camchain)).cameras[0].camera == FISHEYE
    assert load_rig(written(tmp_path, ROS, "left.yaml")).cameras[0].name == "narrow_stereo"


def test_xml_is_answered_with_the_mend(tmp_path):
    file = opencv_file(tmp_path / "camera.xml", camera_matrix=RADTAN.K)
    with pytest.raises(CalibrationError, match="XML is not read: write it as YAML"):
        read_calibration(file)


@pytest.mark.parametrize(
    "text",
    [
        "cam0: !!python/object/apply:os.system ['touch ran']",
        "%YAML:1.0\n---\nM1: !!python/object/new:os.system ['touch ran']",
        "camera_matrix: !!opencv-matrix [1, 2]",
    ],
)
def test_nothing_in_a_file_runs(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CalibrationError, match="not valid YAML"):
        read_calibration(written(tmp_path, text))
    assert not (tmp_path / "ran").exists()


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        read_calibration(tmp_path / "none.yaml")
