"""Real recordings open, and say what their authors say about them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from odomap.errors import InputError
from odomap.files.rig import read_rig
from odomap.files.trajectories import read_trajectory, read_tum, write_tum
from odomap.sensors.rig import DepthMount
from odomap.sources.describe import describe
from odomap.sources.disturb import there_and_back
from odomap.sources.folder import FolderSource
from odomap.sources.images import decode, find_mosaic
from odomap.sources.open import open as open_source
from odomap.sources.tum import TumSource


def test_euroc(data_folder: Path) -> None:
    source = open_source(data_folder / "euroc_mh01")
    facts = describe(source)
    assert (facts["frames"], facts["rate_hz"], facts["gaps"]) == (110, 20.0, [])
    assert facts["stereo_baseline_m"] == pytest.approx(0.11008, abs=1e-5)
    assert (facts["imu_rate_hz"], facts["body"], facts["notes"]) == (200.0, "imu", [])
    assert facts["truth"]["frames_covered"] == 110
    frames = list(source)
    assert len(frames) == 110
    assert source.skipped == []
    assert frames[0].stamp_ns == 1403636584763555584
    assert all(
        image is not None and image.shape == (480, 752) and image.dtype == np.uint8
        for frame in frames
        for image in frame.images
    )
    samples = [len(frame.imu or ()) for frame in frames]
    # Two seconds before the first frame, then 200 Hz at 20 frames a second.
    assert samples[0] == pytest.approx(400, abs=2)
    assert set(samples[1:]) <= {9, 10, 11}


def test_euroc_truths_agree(data_folder: Path) -> None:
    source = open_source(data_folder / "euroc_mh01")
    beside = read_tum(data_folder / "euroc_mh01" / "groundtruth.txt")
    assert source.truth is not None
    ours, theirs = source.truth.associate(beside, max_dt_s=0.001)
    assert len(theirs) == len(beside)
    gap = source.truth.positions[ours] - beside.positions[theirs]
    assert np.abs(gap).max() < 1e-6
    # The truth is the body's: the camera's own follows from the mount.
    camera = read_tum(data_folder / "euroc_mh01" / "groundtruth_cam0.txt")
    mount = source.rig.camera("cam0").T_body_camera.matrix
    moved = source.truth.Ts_world_body @ mount
    ours, theirs = source.truth.associate(camera, max_dt_s=0.001)
    assert np.abs(moved[ours, :3, 3] - camera.positions[theirs]).max() < 1e-5


def test_kitti_stereo(data_folder: Path) -> None:
    source = open_source(data_folder / "kitti_stereo")
    facts = describe(source)
    assert (facts["frames"], facts["rate_hz"], facts["notes"]) == (51, 10.0, [])
    assert facts["stereo_baseline_m"] == pytest.approx(0.53715, abs=1e-5)
    assert facts["cameras"][0]["resolution"] == [1226, 370]
    assert facts["truth"]["path_m"] == pytest.approx(59.9, abs=0.1)
    assert [frame.id for frame in source] == list(range(51))
    beside = read_tum(data_folder / "kitti_stereo" / "groundtruth.txt")
    assert source.truth is not None
    np.testing.assert_allclose(source.truth.Ts_world_body, beside.Ts_world_body, atol=2e-6)


def test_kitti_mono(data_folder: Path) -> None:
    source = open_source(data_folder / "kitti_mono")
    assert len(source) == 100
    assert len(source.rig.cameras) == 1
    assert source.notes == ["image_1 is missing or empty: the recording is monocular"]
    assert [len(frame.images) for frame in source] == [1] * 100


def test_tum(data_folder: Path) -> None:
    source = open_source(data_folder / "rgbd_desk")
    assert isinstance(source, TumSource)
    facts = describe(source)
    assert (facts["frames"], facts["notes"], facts["skipped"]) == (160, [], [])
    assert facts["truth"]["frames_covered"] == 160
    assert facts["truth"]["path_m"] == pytest.approx(0.44, abs=0.01)
    assert source.depth is not None
    assert np.abs(source.depth.paired).max() < 20_000_000
    frame = source.frame(80)
    assert frame.stamp_ns == source.stamps_ns[80]
    assert frame.depth is not None
    assert frame.depth.dtype == np.float32
    assert frame.depth.shape == frame.images[0].shape == (480, 640)
    seen = frame.depth[frame.depth > 0]
    assert 0.6 < np.percentile(seen, 1) < np.percentile(seen, 99) < 5
    assert 0.15 < np.mean(frame.depth == 0) < 0.4
    colour = source.colour(80)
    assert colour.shape == (480, 640, 3)
    # Luma is 0.299 R + 0.587 G + 0.114 B.
    grey = colour @ np.array([0.299, 0.587, 0.114])
    assert np.abs(grey - frame.images[0]).max() <= 1


def test_tum_with_the_factor_of_another_camera(data_folder: Path) -> None:
    rig = read_rig(data_folder / "rgbd_desk")
    wrong = replace(rig, depth=DepthMount("rgb", 1000.0))
    (note,) = TumSource(data_folder / "rgbd_desk", wrong).notes
    assert "with factor 1000: is it 5000" in note


def test_the_same_images_as_a_folder_and_as_a_video(data_folder: Path, tmp_path: Path) -> None:
    desk = TumSource(data_folder / "rgbd_desk")
    rig = data_folder / "rgbd_desk" / "rig.yaml"
    folder = open_source(data_folder / "rgbd_desk" / "rgb", rig)
    assert isinstance(folder, FolderSource)
    # The names of its images are times.
    assert folder.stamps_ns.tolist() == desk.stamps_ns.tolist()
    np.testing.assert_array_equal(folder.frame(9).images[0], desk.frame(9).images[0])
    file = tmp_path / "desk.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 30, (640, 480))
    for index in range(40):
        writer.write(cv2.cvtColor(desk.colour(index), cv2.COLOR_RGB2BGR))
    writer.release()
    video = open_source(file, rig)
    frames = list(video)
    assert len(frames) == 40
    for frame in frames[::8]:
        gap = frame.images[0].astype(float) - desk.frame(frame.id).images[0]
        assert np.abs(gap).mean() < 4
    assert np.abs(video.colour(30).astype(float) - desk.colour(30)).mean() < 8


def test_no_real_image_is_taken_for_a_mosaic(data_folder: Path) -> None:
    paths = [
        *sorted((data_folder / "euroc_mh01/mav0/cam0/data").iterdir())[::10],
        *sorted((data_folder / "kitti_stereo/image_0").iterdir())[::10],
        *sorted((data_folder / "kitti_mono/image_0").iterdir())[::10],
    ]
    assert len(paths) >= 25
    assert [path.name for path in paths if find_mosaic(decode(path))] == []


def test_real_mosaics_are_found(data_folder: Path) -> None:
    paths = sorted((data_folder / "rgbd_desk/rgb").iterdir())[::20]
    assert len(paths) >= 8
    for path in paths:
        colour = decode(path)
        for shift, diagonal in ((0, "anti"), (1, "main")):
            # RGGB, of a white-balanced picture: the hardest case.
            raw = colour[:, :, 1].copy()
            raw[::2, shift::2] = colour[::2, shift::2, 2]
            raw[1::2, 1 - shift :: 2] = colour[1::2, 1 - shift :: 2, 0]
            assert find_mosaic(raw) == diagonal


def test_there_and_back(data_folder: Path) -> None:
    wrapped = there_and_back(open_source(data_folder / "euroc_mh01"))
    assert wrapped.truth is not None
    assert len(wrapped.truth) == len(wrapped) == 110
    ends = wrapped.truth.positions[[0, -1]]
    assert np.linalg.norm(ends[0] - ends[1]) < 0.05


def test_rig_yaml(data_folder: Path) -> None:
    rig = read_rig(data_folder / "rgbd_desk")
    assert rig.body_sensor == "rgb"
    assert rig.depth is not None
    assert rig.depth.factor == 5000.0
    assert rig.cameras[0].camera.resolution == (640, 480)


@pytest.mark.parametrize("name", ["eval_fr2_desk_groundtruth.txt.gz", "eval_fr2_desk_ORB.txt.gz"])
def test_stamps_survive_to_the_nanosecond(data_folder: Path, tmp_path: Path, name: str) -> None:
    trajectory = read_tum(data_folder / "truth" / name)
    write_tum(tmp_path / "again.tum", trajectory)
    again = read_tum(tmp_path / "again.tum")
    assert np.array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(again.Ts_world_body, trajectory.Ts_world_body, atol=5e-9)
    # Written to the microsecond at most; one row of the desk's truth repeats a stamp, and moves on.
    assert np.count_nonzero(trajectory.stamps_ns % 100_000 % 1000) <= 1


def test_kitti_rows(data_folder: Path) -> None:
    truth = read_trajectory(data_folder / "truth" / "eval_KITTI_00_gt.txt.gz")
    assert len(truth) == 4541
    assert truth.path_length == pytest.approx(3724, abs=1)


@pytest.mark.parametrize("name", ["laser2d", "graphs", "truth"])
def test_other_recordings_are_explained(data_folder: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"not recognised .* supported are EuRoC"):
        open_source(data_folder / name)
