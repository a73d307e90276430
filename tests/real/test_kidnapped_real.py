"""Kidnapped in real recordings: found again at once, where the undisturbed run was."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.evaluation.match import rotation_angle
from odomap.files.vocabulary import Vocabulary
from odomap.maps.estimate import Status
from odomap.sources.open import open as open_source
from odomap.system.slam import Slam

UNSEEN_S = 2.0
PLACED = (Status.TRACKING, Status.RECOVERED)


class Played:
    """A recording played from end to end: its path, and SLAM that goes on."""

    def __init__(self, folder):
        self.source = open_source(folder)
        self.slam = Slam(self.source.rig, vocabulary=Vocabulary.load())
        for frame in self.source:
            self.slam.track(frame)
        self.path = self.slam.finish().trajectory
        self.step_ns = int(np.median(np.diff(self.source.stamps_ns)))
        self.count, self.now_ns = len(self.source), frame.stamp_ns

    def track(self, frame):
        self.count, self.now_ns = self.count + 1, self.now_ns + self.step_ns
        return self.slam.track(replace(frame, id=self.count, stamp_ns=self.now_ns))

    def check_found(self, part):
        """Go on from a part of the recording for a second, and check where that is."""
        first = round(part * len(self.source))
        shown = [self.source.frame(k) for k in range(first, first + 10**9 // self.step_ns)]
        estimates = [self.track(frame) for frame in shown]
        # A second is what is allowed; that it is found at once is what it does.
        assert estimates[0].status is Status.RECOVERED
        assert all(e.status in PLACED for e in estimates)
        rows = np.searchsorted(self.path.stamps_ns, [frame.stamp_ns for frame in shown])
        truth = self.path.Ts_world_body[rows]
        Ts = np.array([e.T_world_body.matrix for e in estimates])
        metres = np.linalg.norm(Ts[:, :3, 3] - truth[:, :3, 3], axis=1)
        degrees = np.degrees(rotation_angle(np.swapaxes(truth[:, :3, :3], 1, 2) @ Ts[:, :3, :3]))
        assert metres[0] < 0.03
        assert degrees[0] < 1.0
        assert np.median(metres) < 0.03
        assert np.median(degrees) < 1.0


@pytest.mark.parametrize("name", ["rgbd_desk", "euroc_mh01"])
def test_a_jump_and_a_covered_lens(name, data_folder):
    played = Played(data_folder / name)
    played.check_found(0.5)
    dark = played.source.frame(0)
    black = tuple(np.zeros_like(image) for image in dark.images)
    depth = None if dark.depth is None else np.zeros_like(dark.depth)
    dark = replace(dark, images=black, depth=depth)
    for _ in range(round(UNSEEN_S * 1e9 / played.step_ns)):
        assert played.track(dark).status is Status.LOST
    played.check_found(0.1)
