"""A hand over the lens, and an object that moves: right in every camera, and in depth."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import CameraMount, DepthMount, Rig
from odomap.sources.disturb import cover, moving_object
from odomap.sources.euroc import EurocSource

FOCAL, BASELINE = 120.0, 0.1


class Grey:
    """Frames of a grey nothing, from a pair whose right camera may be turned, with depth 3 m."""

    name, truth = "grey", None

    def __init__(self, camera: Camera | None = None, turn: float = 0.0, frames: int = 11) -> None:
        camera = camera or Camera(intrinsics=(FOCAL, FOCAL, 79.5, 59.5), resolution=(160, 120))
        mount = SE3.exp(np.array([BASELINE, 0, 0, 0, turn, 0]))
        pair = (CameraMount("left", camera), CameraMount("right", camera, mount))
        self.rig = Rig(cameras=pair, depth=DepthMount("left"))
        self.stamps_ns = 50_000_000 * np.arange(frames)
        self.truth = Trajectory(self.stamps_ns, np.tile(np.eye(4), (frames, 1, 1)))
        self.skipped = []
        self.shape = (camera.height, camera.width)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def frame(self, index: int) -> Frame:
        grey = np.full(self.shape, 128, np.uint8)
        depth = np.full(self.shape, 3, np.float32)
        return Frame(index, int(self.stamps_ns[index]), (grey, grey), depth)

    def __iter__(self):
        return map(self.frame, range(len(self)))


def shown(frame: Frame, camera: int = 0) -> NDArray[np.bool_]:
    """Return where a frame of grey nothing has something before it."""
    image = frame.images[camera]
    assert image is not None
    return cv2.morphologyEx((image != 128).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7))) > 0


@pytest.mark.parametrize("share", [1 / 3, 0.1])
def test_an_object_fills_its_share_of_the_view(share: float) -> None:
    frames = list(moving_object(Grey(), range(11), share=share))
    filled = [shown(frame).mean() for frame in frames]
    assert filled[5] == pytest.approx(share, rel=0.12)
    assert max(filled) < 1.12 * share
    # It comes in on one side and leaves on the other.
    centre = [np.argwhere(shown(frame))[:, 1].mean() for frame in frames]
    assert np.all(np.diff(centre) > 0)
    assert centre[0] < 30
    assert centre[-1] > 130


@pytest.mark.parametrize("distance", [0.8, 2.0])
def test_a_pair_sees_it_shifted_by_its_disparity(distance: float) -> None:
    source = Grey()
    for frame in moving_object(source, range(11), distance=distance, crossing=0.3):
        left, right = (image[20:100].astype(np.float32) for image in frame.images)
        patch = left[20:60, 60:100]
        score = cv2.matchTemplate(right, patch, cv2.TM_CCOEFF_NORMED)
        _, best, _, (x, _) = cv2.minMaxLoc(score)
        assert best > 0.9
        assert 60 - x == pytest.approx(FOCAL * BASELINE / distance, abs=1.0)
        where = shown(frame)
        near = frame.depth < 2.9
        assert np.mean(where != near) < 0.02
        np.testing.assert_allclose(frame.depth[near], distance, rtol=1e-6)
        assert np.all(frame.depth[~near] == 3)


def test_a_turned_right_camera_sees_it_where_its_lens_puts_it() -> None:
    """What both see of one point of the board goes back to one point in space."""
    lens = Camera(
        "pinhole", (FOCAL, FOCAL, 79.5, 59.5), (-0.2, 0.05, 1e-3, -1e-3), resolution=(160, 120)
    )
    source = Grey(lens, turn=0.05)
    frame = moving_object(source, range(3), distance=1.5, crossing=0.0).frame(1)
    left, right = frame.images
    corners = cv2.goodFeaturesToTrack(left, 60, 0.1, 8, mask=shown(frame).astype(np.uint8))
    there, found, _ = cv2.calcOpticalFlowPyrLK(left, right, corners, None, winSize=(11, 11))
    T_left_right = source.rig.cameras[1].T_body_camera
    rays = lens.unproject(corners[:, 0].astype(float))
    points = 1.5 * rays / rays[:, 2:]
    expected = lens.project(T_left_right.inverse() @ points)
    off = np.linalg.norm(there[:, 0] - expected, axis=1)[found[:, 0] > 0]
    assert len(off) > 25
    assert np.median(off) < 0.25


def test_an_object_that_goes_along_stays_where_it_is() -> None:
    first, *others = moving_object(Grey(), range(5), crossing=0.0)
    for frame in others[:4]:
        np.testing.assert_array_equal(shown(frame), shown(first))
    assert not shown(others[5]).any()


def test_a_hand_comes_covers_and_goes() -> None:
    frames = list(cover(Grey(), range(1, 10), share=0.9))
    hidden = np.array([np.mean(frame.images[0] < 80) for frame in frames])
    assert hidden[0] == hidden[10] == 0
    assert np.all(np.diff(hidden[:6]) >= 0)
    assert np.all(np.diff(hidden[5:]) <= 0)
    assert hidden[5] == pytest.approx(0.9, abs=0.05)
    middle = frames[5].images[0]
    skin = middle[middle < 80].astype(float)
    # Dark, with a faint texture: not one value, and no corners.
    assert 20 < skin.mean() < 50
    assert 1 < skin.std() < 12
    assert np.mean(frames[5].depth == 0) > 0.85
    assert np.all(frames[10].depth == 3)


def test_a_hand_over_one_of_two_lenses() -> None:
    frame = cover(Grey(), [3], cameras=[1]).frame(3)
    assert np.all(frame.images[0] == 128)
    assert np.all(frame.depth == 3)
    assert np.mean(frame.images[1] < 80) > 0.8


@pytest.mark.parametrize("wrap", [cover, moving_object])
def test_the_same_whenever_it_is_read(wrap: Callable[..., Grey]) -> None:
    source = wrap(Grey(), range(2, 9), seed=4)
    other = wrap(Grey(), range(2, 9), seed=5)
    for index, frame in enumerate(source):
        again = source.frame(index)
        for a, b in zip(frame.arrays(), again.arrays(), strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.array_equal(source.frame(5).images[0], other.frame(5).images[0])


def test_what_cannot_be_is_refused(euroc: Callable[..., Path]) -> None:
    source = EurocSource(euroc())
    with pytest.raises(InputError, match=r"cover: share 1\.5"):
        cover(source, [1], share=1.5)
    for wrong in ({"share": 0.0}, {"distance": -1.0}, {"distance": np.nan}, {"crossing": 2.0}):
        with pytest.raises(InputError, match=f"moving_object: {next(iter(wrong))}"):
            moving_object(source, [1], **wrong)
    source.rig = Rig()
    with pytest.raises(InputError, match="needs a rig with a camera"):
        moving_object(source, [1])
