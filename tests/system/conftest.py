"""A small rendered recording, made once, and what is done to it."""

import cv2
import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import CameraMount, Rig
from odomap.simulation.world import START_NS, World


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
    return recorded(world)


@pytest.fixture(scope="session")
def depth_room():
    """Return four seconds of a hand-held camera with depth in a room: 48 frames of 400x250."""
    world = World.make(
        kind="room",
        seed=3,
        frames=48,
        rate_hz=12.0,
        resolution=(400, 250),
        sensors=("mono", "depth"),
    )
    return recorded(world)


def recorded(world):
    """Render a world once; what is shared is not written to."""
    frames = [world.frame(i) for i in range(len(world))]
    for frame in frames:
        for array in frame.arrays():
            array.flags.writeable = False
    return Recording(world.rig, world.truth, frames)


class Wall:
    """A painted wall two metres ahead, seen by a camera that moves before it: one plane only."""

    camera = Camera(intrinsics=(250.0, 250.0, 199.5, 124.5), resolution=(400, 250))

    def __init__(self, seed=0, distance=2.0, per_metre=150.0):
        rng = np.random.default_rng(seed)
        paint = np.full((1800, 1800), 110, np.uint8)
        for _ in range(6000):
            x, y = rng.integers(0, 1800, 2)
            w, h = rng.integers(6, 60, 2)
            paint[y : y + h, x : x + w] = rng.integers(0, 256)
        self.paint = cv2.GaussianBlur(paint, (0, 0), 1.5)
        self.distance, self.per_metre, self.seed = distance, per_metre, seed

    def image(self, T_world_camera, rng):
        """Return what a camera sees of the plane z = distance."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        rays = self.camera.unproject(np.stack([u.ravel(), v.ravel()], 1).astype(float))
        rays = rays @ T_world_camera[:3, :3].T
        origin = T_world_camera[:3, 3]
        at = origin + rays * ((self.distance - origin[2]) / rays[:, 2])[:, None]
        shape = v.shape
        x, y = (at[:, :2].T * self.per_metre + 900).astype(np.float32)
        seen = cv2.remap(self.paint, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR)
        return (seen + rng.normal(0, 1.5, shape)).round().clip(0, 255).astype(np.uint8)

    def recording(self, Ts_world_camera, rate_hz=12.0):
        """Return frames at (N, 4, 4) poses."""
        stamps = START_NS + np.round(1e9 / rate_hz * np.arange(len(Ts_world_camera))).astype(int)
        rng = np.random.default_rng(self.seed)
        frames = [
            Frame(k, int(stamp), (self.image(T, rng),))
            for k, (stamp, T) in enumerate(zip(stamps, Ts_world_camera))
        ]
        rig = Rig(cameras=(CameraMount("cam", self.camera),))
        return Recording(rig, Trajectory(stamps, Ts_world_camera), frames)


@pytest.fixture(scope="session")
def wall():
    """Return a wall to move before."""
    return Wall()
