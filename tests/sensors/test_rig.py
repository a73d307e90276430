"""Rigs refuse what cannot be true, and say what to mend."""

import numpy as np
import pytest

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, DepthMount, ImuMount, LidarMount, Rig


def camera(width: int = 640, height: int = 480, scale: float = 1.0) -> Camera:
    intrinsics = np.array([500.0, 500.0, 320.0, 240.0]) * scale
    return Camera("pinhole", intrinsics, np.zeros(0), (width, height))


def mount(name: str, *t: float, lens: Camera | None = None) -> CameraMount:
    return CameraMount(name, lens or camera(), SE3.from_parts(np.eye(3), np.array(t or (0, 0, 0))))


def test_stereo_pair_is_left_and_right() -> None:
    left, right = Rig((mount("a"), mount("b", 0.1, 0, 0))).stereo_pair()
    assert (left.name, right.name) == ("a", "b")


def test_stereo_pair_of_a_turned_rig() -> None:
    # The pair stands on its side in the body: what counts is x in the left camera's frame.
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    left = CameraMount("a", camera(), SE3.from_parts(R, np.zeros(3)))
    right = CameraMount("b", camera(), SE3.from_parts(R, np.array([0, 0.1, 0])))
    assert Rig((left, right)).stereo_pair()[1].name == "b"


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ((110.0, 0, 0), "baseline of 110 m is implausible: is it in millimetres"),
        ((0.001, 0, 0), "baseline of 0.001 m is implausible"),
        ((-0.11, 0, 0), "the pair is swapped; list the left camera first"),
        ((0.01, 0.1, 0), "only cameras side by side"),
        ((0.01, 0, 0.3), "only cameras side by side"),
    ],
)
def test_implausible_pairs(second: tuple[float, ...], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        Rig((mount("a"), mount("b", *second))).stereo_pair()


def test_pair_of_different_resolutions() -> None:
    other = mount("b", 0.1, 0, 0, lens=camera(320, 240, 0.5))
    with pytest.raises(CalibrationError, match="640x480 and 320x240 differ"):
        Rig((mount("a"), other)).stereo_pair()


def test_pair_of_one() -> None:
    with pytest.raises(CalibrationError, match="two cameras, this rig has 1"):
        Rig((mount("a"),)).stereo_pair()


@pytest.mark.parametrize(
    ("size", "scale", "message"),
    [
        ((1280, 960), 1.0, "calibrated for another resolution.* by 2"),
        ((320, 240), 1.0, "calibrated for another resolution.* by 0.5"),
        ((640, 480), 0.01, "fx = 5 px cannot be"),
        ((640, 480), 100.0, "fx = 50000 px cannot be"),
    ],
)
def test_intrinsics_must_suit_the_image(size: tuple[int, int], scale: float, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        CameraMount("left", camera(*size, scale))


def test_cropped_images_are_fine() -> None:
    # A KITTI-like crop from the top moves cy alone.
    lens = Camera("pinhole", np.array([700.0, 700.0, 620.0, 90.0]), np.zeros(0), (1240, 370))
    assert CameraMount("left", lens).camera == lens


def test_fisheyes_have_shorter_focal_lengths() -> None:
    # A circle of 220° in a wide image, as the double sphere counts it.
    circle = Camera("double_sphere", [170.0, 170.0, 960.0, 540.0], [-0.35, 0.6], (1920, 1080))
    assert CameraMount("left", circle).camera == circle
    with pytest.raises(CalibrationError, match="fx = 170 px cannot be"):
        CameraMount("left", Camera("pinhole", circle.intrinsics, [], (1920, 1080)))
    with pytest.raises(CalibrationError, match="fx = 1 px cannot be"):
        CameraMount("left", Camera("kannala_brandt", [1, 1, 320, 240], [0, 0, 0, 0], (640, 480)))


def test_names() -> None:
    with pytest.raises(CalibrationError, match="two sensors are named 'a'"):
        Rig((mount("a"), mount("a")))
    rig = Rig((mount("left"), mount("right")))
    assert rig.camera("right").name == "right"
    with pytest.raises(CalibrationError, match=r"no camera 'lefd'.*did you mean 'left'"):
        rig.camera("lefd")
    with pytest.raises(CalibrationError, match="no camera 'rgb'"):
        Rig((mount("left"),), depth=DepthMount("rgb"))


def test_body_is_the_sensor_at_the_origin() -> None:
    assert Rig((mount("a"), mount("b", 0.1, 0, 0))).body_sensor == "a"
    assert Rig((mount("a", 0.2, 0, 0),), imu=ImuMount()).body_sensor == "imu"
    assert Rig((mount("a", 0.2, 0, 0),)).body_sensor == ""
    assert Rig((mount("a"), mount("b")), body="b").body_sensor == "b"
    assert Rig(lidars=(LidarMount("top"),)).body_sensor == "top"
    with pytest.raises(CalibrationError, match=r"no sensor 'imo'.*did you mean 'imu'"):
        Rig((mount("a"),), imu=ImuMount(), body="imo")
    with pytest.raises(CalibrationError, match="must be the identity"):
        Rig((mount("a", 0.2, 0, 0),), body="a")


def test_without_imu_the_body_stays() -> None:
    rig = Rig((mount("a", 0.2, 0, 0),), imu=ImuMount(), body="imu").without_imu()
    assert rig.imu is None
    assert rig.body_sensor == ""


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ImuMount(gyro_noise=0.0), "gyro_noise 0.0 must be positive"),
        (lambda: ImuMount(rate_hz=float("nan")), "rate_hz nan"),
        (lambda: DepthMount("a", factor=-1.0), "factor -1.0 must be positive"),
        (lambda: LidarMount("top", sweep="clockwize"), "did you mean 'clockwise'"),
        (lambda: LidarMount("top", range_m=(10.0, 1.0)), "nearest, farthest"),
        (lambda: CameraMount("a", camera(), rate_hz=-1.0), "rate_hz -1.0"),
        (lambda: CameraMount("a", camera(), time_offset_s=float("inf")), "time_offset_s"),
    ],
)
def test_values_out_of_range(make: object, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        make()  # type: ignore[operator]
