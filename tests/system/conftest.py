"""A small rendered recording, made once, and what is done to it."""

import numpy as np
import pytest

from odomap.simulation.world import World


class Recording:
    """Frames kept in memory: a source that can be read in any order."""

    def __init__(self, rig, truth, frames):
        self.name, self.rig, self.truth = "recording", rig, truth
        self.skipped, self._frames = [], frames
        self.stamps_ns = np.array([frame.stamp_ns for frame in frames])

    def __len__(self):
        return len(self._frames)

    def __iter__(self):
        return iter(self._frames)

    def frame(self, index):
        return self._frames[index]

    def part(self, first, last):
        return Recording(self.rig, self.truth, self._frames[first:last])


@pytest.fixture(scope="session")
def room():
    """Return four seconds of a hand-held stereo pair in a room: 48 frames of 400x250."""
    world = World.make(
        kind="room", seed=3, frames=48, rate_hz=12.0, resolution=(400, 250), sensors=("stereo",)
    )
    frames = [world.frame(i) for i in range(48)]
    for frame in frames:
        for array in frame.arrays():
            array.flags.writeable = False
    return Recording(world.rig, world.truth, frames)
