"""Odometry on real recordings, to the accuracy it must reach."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.evaluation.metrics import ate
from odomap.files.trajectories import read_tum
from odomap.maps.estimate import Status
from odomap.sources.open import open as open_source
from odomap.system.config import preset, preset_for
from odomap.system.odometry import MonocularVO, RgbdVO, StereoVO, make_odometry


def run(source, vo):
    return [vo.track(frame) for frame in source], vo.finish()


@pytest.mark.parametrize(
    ("name", "frames", "limit_m"), [("euroc_mh01", 110, 0.0055), ("kitti_stereo", 51, 0.11)]
)
def test_stereo_odometry(data_folder, name, frames, limit_m):
    source = open_source(data_folder / name)
    estimates, result = run(source, StereoVO(source.rig))
    assert [e.status for e in estimates] == [Status.TRACKING] * frames
    assert len(result.trajectory) == len(result.trajectory_live) == frames
    assert not source.skipped
    found = ate(result.trajectory, source.truth)
    assert found.rmse <= limit_m
    assert found.matched == frames
    # What is emitted at once may be a little worse, not another path.
    assert ate(result.trajectory_live, source.truth).rmse <= 2 * limit_m
    covariances = result.trajectory.covariances[1:]
    assert np.isfinite(covariances).all()
    assert (np.linalg.eigvalsh(covariances) > 0).all()
    # Uncertainty is about as large as the error: neither blind trust nor blanket doubt.
    sigma = np.sqrt(np.trace(covariances[-1][:3, :3]))
    assert 0.1 * found.rmse < sigma < 30 * found.rmse


def starts_soon(estimates, by_frame):
    """Check that a single camera waits with reasons, starts, and is never lost again."""
    tracking = [e.status is Status.TRACKING for e in estimates]
    first = tracking.index(True)
    assert first <= by_frame
    assert all(tracking[first:])
    for e in estimates[:first]:
        assert e.status is Status.INITIALIZING
        assert e.keyframe_id == -1
        assert e.reason


def scale_holds(result, truth, tolerance):
    """Check that the scale of the second half is that of the first."""
    ours = result.trajectory
    half = len(ours) // 2
    first, second = (
        ate(
            replace(
                ours,
                stamps_ns=ours.stamps_ns[s],
                Ts_world_body=ours.Ts_world_body[s],
                covariances=None,
            ),
            truth,
            "sim3",
        ).scale
        for s in (slice(0, half), slice(half, None))
    )
    assert second == pytest.approx(first, rel=tolerance)


def angles_deg(Rs, others):
    """Return the (N,) angles between rotations."""
    trace = np.einsum("nij,nij->n", Rs, others)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def test_one_camera_of_a_drone(data_folder):
    source = open_source(data_folder / "euroc_mh01")
    truth = read_tum(data_folder / "euroc_mh01" / "groundtruth_cam0.txt")
    mount = source.rig.cameras[0]
    estimates, result = run(source, MonocularVO(mount.camera))
    starts_soon(estimates, 10)
    assert not result.is_metric
    assert len(result.trajectory) >= 102
    assert ate(result.trajectory, truth, "sim3").rmse <= 0.010


def test_one_camera_of_a_car(data_folder):
    source = open_source(data_folder / "kitti_mono")
    assert preset_for(source.rig) == "mono"
    estimates, result = run(source, make_odometry(source.rig, preset("mono-flow")))
    starts_soon(estimates, 10)
    assert len(result.trajectory) >= 91
    assert ate(result.trajectory, source.truth, "sim3").rmse <= 0.20
    scale_holds(result, source.truth, 0.05)


def test_a_hand_held_depth_camera(data_folder):
    source = open_source(data_folder / "rgbd_desk")
    assert preset_for(source.rig) == "rgbd"
    estimates, result = run(source, RgbdVO(source.rig))
    # A window that moves the last pose by a leap says so.
    corrected = [e for e in estimates if e.status is Status.RECOVERED]
    assert all("the map was corrected" in e.reason for e in corrected)
    assert len(corrected) <= 3
    assert {e.status for e in estimates} <= {Status.TRACKING, Status.RECOVERED}
    assert len(result.trajectory) == len(estimates) == 160
    assert result.is_metric
    found = ate(result.trajectory, source.truth)
    assert found.rmse <= 0.035
    # The camera hardly leaves its place: what the path tells is how it turned.
    turned = source.truth.interpolate(result.trajectory.stamps_ns).Ts_world_body
    ours = result.trajectory.Ts_world_body
    off = angles_deg(
        np.swapaxes(turned[:-30, :3, :3], 1, 2) @ turned[30:, :3, :3],
        np.swapaxes(ours[:-30, :3, :3], 1, 2) @ ours[30:, :3, :3],
    )
    assert np.median(off) < 2.6
    covariances = result.trajectory.covariances[1:]
    assert np.isfinite(covariances).all()
    assert (np.linalg.eigvalsh(covariances) > 0).all()
