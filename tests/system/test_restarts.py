"""What a start, a loss and a standstill must not spoil."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError, ConfigError
from odomap.geometry.pose import SE3
from odomap.logbook import Logbook
from odomap.maps.estimate import Estimate, Status
from odomap.run import run
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.simulation.world import START_NS
from odomap.system.config import preset
from odomap.system.odometry import MonocularVO, RgbdVO


def in_order(frames):
    """Return frames renumbered, twelve a second."""
    stamps = START_NS + np.round(1e9 / 12 * np.arange(len(frames))).astype(int)
    return [replace(f, id=k, stamp_ns=int(t)) for k, (f, t) in enumerate(zip(frames, stamps))]


def mirrored(frame, factor=1.0):
    """Return a scene that nothing of the first is found in."""
    flip = [np.ascontiguousarray(a[:, ::-1]) for a in (frame.images[0], frame.depth)]
    return replace(frame, images=(flip[0],), depth=flip[1] * np.float32(factor))


def standing(frame, count):
    """Return a frame again and again, with the noise of new images."""
    rng = np.random.default_rng(0)
    image = frame.images[0].astype(float)
    noisy = (image + rng.normal(0, 2, image.shape) for _ in range(count))
    return [replace(frame, images=(i.round().clip(0, 255).astype(np.uint8),)) for i in noisy]


class OneEye:
    """The left camera of a recording, frames in a given order."""

    name, skipped, truth, notes = "one eye", (), None, ()

    def __init__(self, recording, frames):
        self.rig = Rig(cameras=recording.rig.cameras[:1])
        self._frames = in_order([replace(f, images=f.images[:1]) for f in frames])
        self.stamps_ns = np.array([f.stamp_ns for f in self._frames])

    def __len__(self):
        return len(self._frames)

    def __iter__(self):
        return iter(self._frames)

    def frame(self, index):
        return self._frames[index]


def test_depth_that_was_right_is_not_doubted_after_a_loss(depth_room):
    near = list(depth_room)[:6]
    vo = RgbdVO(depth_room.rig)
    estimates = [vo.track(f) for f in in_order(near + [mirrored(f, 10.0) for f in near * 2])]
    assert [e.status for e in estimates[6:]] == [Status.LOST] * 12
    assert "depth is unknown" in estimates[-1].reason
    assert len(vo.finish().trajectory) == 6


def test_corners_without_depth_are_told_from_darkness(depth_room):
    frame = depth_room.frame(0)
    blind = RgbdVO(depth_room.rig).track(replace(frame, depth=np.zeros_like(frame.depth)))
    assert "0 points with depth" in blind.reason
    assert "their depth is unknown" in blind.reason
    dark = RgbdVO(depth_room.rig).track(replace(frame, images=(np.zeros_like(frame.images[0]),)))
    assert "too dark" in dark.reason


def test_depth_of_another_size_is_a_matter_of_calibration(depth_room):
    frame = depth_room.frame(0)
    with pytest.raises(CalibrationError, match="depth image is 200x125, the camera's 400x250"):
        RgbdVO(depth_room.rig).track(replace(frame, depth=frame.depth[::2, ::2]))


def test_one_camera_must_follow_candidates(depth_room):
    config = preset("stereo-flow")
    with pytest.raises(ConfigError, match=r"candidates\.follow"):
        MonocularVO(depth_room.rig.cameras[0].camera, config)


def test_a_restart_forgets_the_window_before(depth_room):
    frames = list(depth_room)[:10]
    other = [mirrored(f) for f in frames]
    vo = RgbdVO(depth_room.rig)
    estimates = [vo.track(f) for f in in_order((frames + other) * 2)]
    assert [e.status for e in estimates].count(Status.INITIALIZING) == 3
    before = estimates[30].keyframe_id
    seen = [k for k in vo.map.keyframe_ids.tolist() if len(vo.map.observations_of(k)[0])]
    assert min(seen) > before
    assert min(vo.worker.stages.mapper._drifts) > before


def test_a_camera_that_stands_keeps_its_scale(room):
    config = preset("mono-flow")
    # Many keyframes at one place, as a longer standstill would leave.
    config = replace(config, tracking=replace(config.tracking, keyframe_interval=4))
    frames = list(room)[:40]
    camera = room.rig.cameras[0].camera
    scales, sigmas = [], []
    for count in (0, 60):
        vo = MonocularVO(camera, config)
        source = OneEye(room, frames[:24] + standing(frames[23], count) + frames[24:])
        estimates = [vo.track(f) for f in source]
        assert Status.LOST not in [e.status for e in estimates]
        trajectory = vo.finish().trajectory
        steps = np.linalg.norm(np.diff(trajectory.Ts_world_body[:, :3, 3], axis=0), axis=1)
        scales.append(steps[-15:].sum() / steps[3:20].sum())
        sigmas.append(np.sqrt(np.trace(trajectory.covariances[-1][:3, :3])))
    assert scales[1] == pytest.approx(scales[0], rel=0.05)
    # The way is the same, and so is the doubt: standing still adds none.
    assert 0.3 * sigmas[0] < sigmas[1] < 3.0 * sigmas[0]


def test_frames_placed_late_are_tracked_not_lost(room):
    still = [room.frame(0)] * 30
    result = run(OneEye(room, still + list(room)[:12]))
    m = result.metrics
    assert m["failure"] == ""
    assert m["tracked"] == len(result.trajectory) > m["statuses"]["tracking"]
    assert m["lost"] == 0


def test_frames_placed_after_a_loss_are_counted_once(depth_room):
    frames = list(depth_room)
    result = run(OneEye(depth_room, frames[:16] + [mirrored(f) for f in frames]))
    m = result.metrics
    late = len(result.trajectory) - len(result.trajectory_live)
    assert m["statuses"]["initializing"] > 1  # it started anew
    assert m["lost"] < m["statuses"]["lost"]
    waiting = sum(e.status == Status.INITIALIZING and e.keyframe_id < 0 for e in result.estimates)
    assert m["tracked"] + m["lost"] >= m["frames"] - waiting
    assert m["tracked"] + m["lost"] <= m["frames"]
    assert late > 0


@pytest.mark.parametrize(
    ("statuses", "placed", "why"),
    [
        ([Status.INITIALIZING] * 4, 0, "tracking never started, 0 of 4 frames have a pose: still"),
        ([Status.INITIALIZING] * 8, 3, "tracking started late, 3 of 8 frames have a pose: still"),
        ([Status.LOST] * 4, 1, "tracking was lost, 1 of 4 frames have a pose: still"),
        ([Status.TRACKING], 1, "one frame is no path"),
        ([Status.INITIALIZING] * 4, 4, ""),
    ],
)
def test_a_failure_says_what_happened(statuses, placed, why):
    book, at = Logbook(len(statuses)), SE3.identity()
    for k, status in enumerate(statuses):
        book.add(Frame(k, k), Estimate(k, k, status, "still", -1, at, at, np.eye(6)), 0.01)
    assert book.failure(placed) == why


def test_a_source_is_let_go_when_tracking_fails(depth_room):
    source = OneEye(depth_room, list(depth_room)[:4])
    wrong, let_go = source._frames[2], []
    source._frames[2] = replace(wrong, images=(wrong.images[0][::2, ::2].copy(),))

    class Camera(OneEye):
        def __init__(self):
            self.__dict__ |= source.__dict__

        def __iter__(self):
            try:
                yield from source
            finally:
                let_go.append(True)

    camera = Camera()
    with pytest.raises(CalibrationError, match="frame 2: the image is 200x125") as raised:
        run(camera)
    assert raised.value.__traceback__ is not None  # which keeps what was on the way alive
    assert let_go == [True]
