"""Loops of real sweeps: KITTI there and back, and what is found in a map of half of it."""

from pathlib import Path

import numpy as np
import pytest

import odomap
from cloudworlds import Drive
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.lidar.deskew import deskew
from odomap.lidar.sweeps import points_of
from odomap.lidar.voxels import into_cells, mean_points
from odomap.system.cloudclosing import CloudCloser
from odomap.system.cloudconfig import CloudClosingConfig, CloudRecognitionConfig
from odomap.system.cloudrecognition import CloudFinder, FoundCloud

VOXEL = 0.4


class Recorded:
    """Clouds of a recording, by the frames that are gone through in turn."""

    def __init__(self, data_folder: Path) -> None:
        source = odomap.open(data_folder / "kitti_velodyne")
        assert source.truth is not None
        self.Ts, mount = source.truth.Ts_world_body, source.rig.lidars[0]
        self.clouds, self.order = [], list(range(len(self.Ts)))
        for k, frame in enumerate(source):
            first, last = max(k - 1, 0), min(k + 1, len(self.Ts) - 1)
            motion = se3_log(se3_inverse(self.Ts[first]) @ self.Ts[last])
            seen = points_of(frame.cloud, mount, 80.0)
            points = deskew(seen.points, seen.times, motion / (0.1 * (last - first)))
            cells = into_cells(points, VOXEL)
            means = np.empty((len(cells), 3))
            mean_points(cells.keys, cells.sums, VOXEL, means)
            rows = np.column_stack([means, np.zeros(len(means))])
            self.clouds.append(rows.astype(np.float32))

    def cloud(self, T_world_lidar, seed):
        return self.clouds[self.order[seed]]

    def drive(self, order, drift=1.0, seed=0):
        self.order = order
        return Drive(self, self.Ts[order], drift=drift, seed=seed)


@pytest.fixture(scope="module")
def recorded(data_folder: Path) -> Recorded:
    return Recorded(data_folder)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_there_and_back_is_closed(recorded, seed):
    """Even frames forwards, odd ones backwards; the truth is GPS, good to some centimetres."""
    order = [*range(0, 20, 2), *range(19, 0, -2)]
    drifted = recorded.drive(order, 10.0, seed).go()
    drive = recorded.drive(order, 10.0, seed)
    drive.go(CloudCloser(drive.map, np.eye(4), CloudClosingConfig(apart=1.0)))
    assert len(drive.accepted) >= 3
    for loop in drive.accepted:
        there, here = recorded.Ts[order[loop.matched_id]], recorded.Ts[order[loop.keyframe_id]]
        off = se3_log(se3_inverse(se3_inverse(there) @ here) @ loop.T_matched_keyframe)
        assert np.linalg.norm(off[:3]) < 0.2
        assert np.linalg.norm(off[3:]) < 0.01
    assert drive.errors[-3:].max() < max(0.15, 0.5 * drifted.errors[-3:].max())


def test_odd_sweeps_are_found_in_a_map_of_even_ones(recorded):
    drive = recorded.drive(list(range(0, 20, 2))).go()
    finder = CloudFinder(drive.map, np.eye(4), CloudRecognitionConfig(), CloudClosingConfig())
    for k in range(1, 20, 2):
        found = finder.find(recorded.clouds[k])
        assert isinstance(found, FoundCloud), found
        true = se3_inverse(recorded.Ts[2 * found.keyframe_id]) @ recorded.Ts[k]
        off = se3_log(se3_inverse(true) @ found.T_keyframe_body)
        assert np.linalg.norm(off[:3]) < 0.2
        assert np.linalg.norm(off[3:]) < 0.01
