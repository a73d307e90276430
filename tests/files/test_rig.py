"""rig.yaml: what is written is read back, and every mistake is named."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from odomap.errors import CalibrationError, InputError
from odomap.files.rig import read_rig, write_rig
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, DepthMount, ImuMount, LidarMount, Rig

MINIMAL = """
odomap_rig: 1
cameras:
  - {name: left, intrinsics: [500, 500, 320, 240], resolution: [640, 480]}
"""


def full_rig() -> Rig:
    lens = Camera(
        "pinhole",
        np.array([500.0, 501.0, 320.0, 240.0]),
        np.array([-0.28, 0.07, 2e-4, 1e-5]),
        (640, 480),
    )
    T = SE3.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
    return Rig(
        (
            CameraMount("left", lens, T, 20.0, 0.001),
            CameraMount("right", lens, T @ SE3.from_parts(np.eye(3), np.array([0.11, 0, 0]))),
        ),
        DepthMount("left", 1000.0, (0, 65535)),
        ImuMount(100.0, 1e-4, 1e-5, 1e-3, 1e-4),
        (LidarMount("top", T, (0.5, 80.0), 10.0, "clockwise", (-1.5, 1.5, 181)),),
        body="imu",
    )


def written(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "rig.yaml"
    file.write_text(text)
    return file


def test_there_and_back(tmp_path: Path) -> None:
    rig = full_rig()
    write_rig(tmp_path / "rig.yaml", rig)
    again = read_rig(tmp_path)
    assert (again.depth, again.body, again.sensors) == (rig.depth, rig.body, rig.sensors)
    for ours, theirs in zip(rig.cameras, again.cameras, strict=True):
        assert ours.camera == theirs.camera
        assert (ours.name, ours.rate_hz, ours.time_offset_s) == (
            theirs.name,
            theirs.rate_hz,
            theirs.time_offset_s,
        )
        np.testing.assert_allclose(
            theirs.T_body_camera.matrix, ours.T_body_camera.matrix, atol=1e-15
        )
    top, was = again.lidars[0], rig.lidars[0]
    assert (top.range_m, top.rate_hz, top.sweep, top.angles) == (
        was.range_m,
        was.rate_hz,
        was.sweep,
        was.angles,
    )
    assert again.imu is not None
    assert again.imu.gyro_noise == 1e-4
    write_rig(tmp_path / "again.yaml", rig)
    assert (tmp_path / "again.yaml").read_bytes() == (tmp_path / "rig.yaml").read_bytes()


def test_minimal_rig_has_defaults(tmp_path: Path) -> None:
    rig = read_rig(written(tmp_path, MINIMAL))
    (left,) = rig.cameras
    assert left.camera.model == "pinhole"
    assert len(left.camera.distortion) == 0
    assert left.T_body_camera == SE3.identity()
    assert rig.body_sensor == "left"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("intrinsics", "intrinsic", "unknown field 'intrinsic' .did you mean 'intrinsics'"),
        (", resolution: [640, 480]", "", "cameras.0.: field 'resolution' is missing"),
        ("[640, 480]", "[640]", "field 'resolution' must have 2 numbers, not 1"),
        ("[640, 480]", "[640, 480.5]", "whole pixels"),
        ("[640, 480]", "640x480", "must be a list of numbers, not '640x480'"),
        ("[500, 500, 320, 240]", "[500, abc, 320, 240]", "must hold numbers, not 'abc'"),
        ("[500, 500, 320, 240]", "[500, .nan, 320, 240]", "finite numbers"),
        ("[500, 500, 320, 240]", "[500, true, 320, 240]", "must hold numbers, not 'True'"),
        ("[500, 500, 320, 240]", "[500, 500, 320]", "must have 4 numbers, not 3"),
        ("[500, 500, 320, 240]", "[5000, 5000, 3200, 2400]", "another resolution"),
        ("name: left", "name: 7", "field 'name' must be a text"),
        ("name: left", "name: left, model: pinhol", "did you mean 'pinhole'"),
        ("name: left", "name: left, rate_hz:", "field 'rate_hz' is empty"),
        ("name: left", "name: left, distortion: [1, 2]", "distortion: 2 numbers"),
        ("odomap_rig: 1", "odomap_rig: 2", "odomap_rig 2 is unknown"),
        ("odomap_rig: 1", "odomap_rigg: 1", "'odomap_rig' is missing .found 'odomap_rigg'"),
        ("cameras:", "camera:", "unknown field 'camera' .did you mean 'cameras'"),
        ("odomap_rig: 1", "odomap_rig: 1\nbody: lefd", "did you mean 'left'"),
        ("odomap_rig: 1", "odomap_rig: 1\ndepth: {camera: rgb}", "no camera 'rgb'"),
        ("odomap_rig: 1", "odomap_rig: 1\nimu: {gyro_noise: 1e-4, rate: 2}", "'rate_hz'"),
        ("odomap_rig: 1", "odomap_rig: 1\nimu: {gyro_noise: -1}", "gyro_noise -1.0"),
        ("odomap_rig: 1", "odomap_rig: 1\nimu: 5", "'imu' must be a mapping"),
        ("  - {", "  {", "must be a list of mappings"),
        ("{name: left", "{name: left, T_body_camera: [1, 2]", "16 numbers, row by row"),
        (
            "{name: left",
            "{name: left, T_body_camera: [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]",
            "no rotation",
        ),
        (
            "{name: left",
            "{name: left, T_body_camera: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,2]]",
            "row 0, 0, 0, 1",
        ),
        ("{name", "{{name", "rig.yaml:5: not valid YAML"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in MINIMAL
    file = written(tmp_path, MINIMAL.replace(old, new))
    with pytest.raises(CalibrationError, match=message) as caught:
        read_rig(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


def test_a_rotation_with_four_digits_is_accepted(tmp_path: Path) -> None:
    R = np.round(SE3.exp(np.array([0, 0, 0, 0.3, -0.2, 0.5])).R, 4)
    rows = np.eye(4)
    rows[:3, :3] = R
    text = MINIMAL.replace("name: left", f"name: left, T_body_camera: {rows.tolist()}")
    T = read_rig(written(tmp_path, text)).cameras[0].T_body_camera
    np.testing.assert_allclose(T.R @ T.R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(T.R, R, atol=1e-4)


def test_numbers_in_yaml_without_a_point(tmp_path: Path) -> None:
    # YAML 1.1 takes 1e-4 for a text.
    assert yaml.safe_load("1e-4") == "1e-4"
    text = MINIMAL + "imu: {gyro_noise: 1e-4}\n"
    imu = read_rig(written(tmp_path, text)).imu
    assert imu is not None
    assert imu.gyro_noise == 1e-4


@pytest.mark.parametrize(
    "text",
    ["", "- 1\n", "just text\n", "odomap_rig: 1\n", "a: !!python/object:os.system x\n", "\x00"],
)
def test_what_is_no_rig(tmp_path: Path, text: str) -> None:
    with pytest.raises(CalibrationError, match=r"rig\.yaml"):
        read_rig(written(tmp_path, text))


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"rig\.yaml: No such file"):
        read_rig(tmp_path)
