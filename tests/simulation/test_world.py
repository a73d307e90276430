"""Worlds: decided by their spec, in any order, with the rig they say."""

import cv2
import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.sensors.frame import Frame
from odomap.simulation.world import START_NS, World, WorldSpec


def content(frame: Frame) -> list[bytes]:
    parts = [array.tobytes() for array in frame.arrays()]
    if frame.imu is not None:
        parts += [
            frame.imu.stamps_ns.tobytes(),
            frame.imu.gyro.tobytes(),
            frame.imu.accel.tobytes(),
        ]
    return parts


def test_bytes_do_not_depend_on_the_order_of_access(noisy_room: World) -> None:
    forwards = [content(noisy_room.frame(i)) for i in range(6)]
    again = World(noisy_room.spec)
    for index in (5, 0, 3, 3, 1, 4, 2):
        assert content(again.frame(index)) == forwards[index]
    assert len({b"".join(parts) for parts in forwards}) == 6


def test_seeds_make_other_worlds(noisy_room: World) -> None:
    other = World.make(
        kind="room", seed=6, frames=1, resolution=(160, 100), sensors=("stereo", "imu")
    )
    assert content(other.frame(0))[0] != content(noisy_room.frame(0))[0]
    assert not np.allclose(other.truth.positions[0], noisy_room.truth.positions[0])


def test_the_body_is_the_imu_and_the_truth_is_its_path(ideal_room: World) -> None:
    rig = ideal_room.rig
    assert rig.body_sensor == "imu"
    assert rig.imu is not None
    left, right = rig.stereo_pair()
    assert np.linalg.norm(left.T_body_camera.t) > 0.05
    assert not np.allclose(np.abs(left.T_body_camera.R), np.round(np.abs(left.T_body_camera.R)))
    offset = (left.T_body_camera.inverse() @ right.T_body_camera).matrix
    wanted = np.eye(4)
    wanted[0, 3] = 0.11
    np.testing.assert_allclose(offset, wanted, atol=1e-12)
    seconds = (ideal_room.truth.stamps_ns - START_NS) * 1e-9
    exact = ideal_room.path.at(seconds).Ts_world_body
    np.testing.assert_allclose(ideal_room.truth.Ts_world_body, exact, atol=1e-9)
    forward = exact[:, :3, :3] @ left.T_body_camera.R[:, 2]
    velocity = ideal_room.path.at(seconds).v_world_body
    assert np.mean((forward * velocity).sum(1) / np.linalg.norm(velocity, axis=1)) > 0.6


def test_without_imu_the_camera_is_the_body(street: World) -> None:
    assert street.rig.body_sensor == "left"
    np.testing.assert_array_equal(street.rig.cameras[0].T_body_camera.matrix, np.eye(4))
    assert street.rig.imu is None
    assert street.frame(0).imu is None
    with_imu = World.make(
        kind="street", seed=2, frames=2, resolution=(64, 48), sensors=("mono", "imu")
    )
    mount = with_imu.rig.cameras[0].T_body_camera.matrix
    np.testing.assert_allclose(
        with_imu.truth.Ts_world_body[0] @ mount, street.truth.Ts_world_body[0], atol=1e-9
    )


def test_imu_samples_join_without_gap_or_overlap(ideal_room: World) -> None:
    frames = [ideal_room.frame(i).imu for i in (0, 1, 2)]
    stamps = np.concatenate([f.stamps_ns for f in frames if f is not None])
    np.testing.assert_array_equal(np.diff(stamps), 5_000_000)
    assert stamps[9] == START_NS
    assert stamps[-1] == ideal_room.truth.stamps_ns[2]


def test_depth_is_honest(noisy_room: World) -> None:
    exact = World.make(
        kind="room", seed=5, frames=6, resolution=(160, 100), moving_objects=2, noise=0.0,
        sensors=("stereo", "depth"),
    )  # fmt: skip
    measured, true = noisy_room.frame(2).depth, exact.frame(2).depth
    assert measured is not None
    assert true is not None
    assert true.min() > 0
    known = measured > 0
    assert 0.7 < known.mean() < 1.0
    error = (measured - true)[known] / (0.001 * true[known] ** 2)
    assert np.std(error) == pytest.approx(1.0, abs=0.03)
    assert abs(np.mean(error)) < 0.05


def test_images_are_noisy_as_a_sensor_is(noisy_room: World) -> None:
    exact = World.make(
        kind="room", seed=5, frames=6, resolution=(160, 100), moving_objects=2, noise=0.0
    )
    noisy, ideal = (w.frame(1).images[0].astype(float) for w in (noisy_room, exact))
    assert np.corrcoef(noisy.ravel(), ideal.ravel())[0, 1] > 0.8
    grain = noisy[1:-1, 1:-1] - (noisy[:-2, 1:-1] + noisy[2:, 1:-1]) / 2
    smooth = ideal[1:-1, 1:-1] - (ideal[:-2, 1:-1] + ideal[2:, 1:-1]) / 2
    calm = np.abs(smooth) < 1.0
    assert 1.5 < np.std(grain[calm]) < 6.0


def test_moving_objects_move_and_leave_the_rest_alone(noisy_room: World) -> None:
    early, late = noisy_room.scene.frames_at(0.0), noisy_room.scene.frames_at(3.0)
    moving = noisy_room.scene.rectangles.mover >= 0
    assert moving.sum() == 10
    assert np.linalg.norm(late[moving, :3] - early[moving, :3], axis=1).min() > 0.1
    np.testing.assert_array_equal(early[~moving], late[~moving])
    rows, velocities = noisy_room.scene.moving(1.0)
    np.testing.assert_array_equal(rows, np.flatnonzero(moving))
    assert 0.05 < np.linalg.norm(velocities, axis=1).min() < 2.0


def test_calibration_is_wrong_by_no_more_than_it_says() -> None:
    spec = {"kind": "room", "seed": 5, "frames": 6, "resolution": (160, 100), "moving_objects": 2}
    off, right = (World.make(**spec, calibration_px=px) for px in (0.5, 0.0))
    assert off.rig == right.rig
    shifts = []
    for a, b in zip(off.frame(0).images, right.frame(0).images, strict=True):
        assert a is not None
        assert b is not None
        inner = b[20:80, 30:130].astype(float)
        shift, _ = cv2.phaseCorrelate(inner, a[20:80, 30:130].astype(float))
        shifts.append(np.hypot(*shift))
    assert 0.05 < max(shifts) < 1.5


def test_the_street_is_a_loop_of_half_a_kilometre(street: World) -> None:
    round_s = 1.0 / street.path.rounds_per_s
    positions = street.path.at(np.linspace(0, round_s, 2000)).Ts_world_body[:, :3, 3]
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() > 480
    assert np.linalg.norm(positions[-1] - positions[0]) < 20
    turned = street.path.at(np.array([0.0, round_s / 2])).Ts_world_body[:, :3, 0]
    assert turned[0] @ turned[1] < 0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"kind": "rom"},
            "kind: 'rom' is none of room, building, corridor, street (did you mean 'room'?)",
        ),
        ({"sensors": ("sterio",)}, "did you mean 'stereo'?"),
        ({"sensors": ()}, "at least one"),
        ({"sensors": ("depth",)}, "add 'mono' or 'stereo'"),
        ({"sensors": ("lidar2d", "lidar3d")}, "choose one"),
        ({"frames": 0}, "frames: 0 must be 1 or more"),
        ({"noise": float("nan")}, "noise: nan"),
        ({"rate_hz": -1.0}, "rate_hz: -1.0"),
        ({"resolution": (8, 8)}, "32 to 4096"),
        ({"seeed": 1}, "did you mean 'seed'?"),
    ],
)
def test_impossible_worlds_say_why(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        World.make(**fields)
    assert message in str(error.value)


def test_frames_outside_the_recording_do_not_exist(noisy_room: World) -> None:
    for index in (-1, 6):
        with pytest.raises(IndexError):
            noisy_room.frame(index)
    assert WorldSpec(kind="street").completed().rate_hz == 10.0
