"""Simulated runs of a 3D LiDAR, and what they claim held against the truth."""

from dataclasses import replace

import numpy as np

from odomap.geometry.lie import se3_inverse, se3_log
from odomap.maps.estimate import Status
from odomap.sources.simulated import SimulatedSource
from odomap.system.config import preset
from odomap.system.slam import Slam

PLACED = (Status.TRACKING, Status.RECOVERED)
LEAST = np.array([0.06] * 3 + [0.015] * 3)
"""How far off a pose may be in any case, metres and radians."""
WORLD = "sim:{}?sensors=lidar3d&beams={}&columns=900&frames={}&seed={}"


class Kept(SimulatedSource):
    """A simulated source that makes each of its sweeps once."""

    def __init__(self, *world, more=""):
        super().__init__(WORLD.format(*world) + more)
        self.made = {}

    def frame(self, index):
        if index not in self.made:
            self.made[index] = super().frame(index)
        return self.made[index]

    def __iter__(self):
        return (self.frame(k) for k in range(len(self)))


def errors(estimates, true, first=None):
    """Return by how much (N, 6) estimates are off true poses, seen from the first, in the body."""
    first = se3_inverse(true[0] if first is None else first)
    pairs = zip(estimates, true, strict=True)
    return np.array([se3_log(se3_inverse(first @ T) @ e.T_world_body.matrix) for e, T in pairs])


def sigmas(estimates):
    return np.sqrt([np.diag(e.covariance) for e in estimates])


def judge(estimates, true, least=LEAST, first=None):
    """Check what is claimed, (N,) estimates against (N, 4, 4) poses."""
    off = errors(estimates, true, first)
    for e, x, sigma in zip(estimates, off, sigmas(estimates), strict=True):
        assert np.isfinite(e.covariance).all()
        assert np.linalg.eigvalsh(e.covariance).min() >= -1e-9 * np.trace(e.covariance)
        assert e.status in PLACED or e.reason
        if e.status in PLACED:
            assert (np.abs(x) < least + 4.0 * sigma).all(), (e.frame_id, x, sigma)
    return off


def played(frames, rig, **more):
    """Return estimates, the system and its result."""
    system = Slam(rig, preset("lidar"), **more)
    estimates = [system.track(frame) for frame in frames]
    return estimates, system, system.finish()


def tracked(frames, rig, front_end, closing=True):
    """Return estimates and the system."""
    config = preset("lidar")
    config = replace(
        config,
        cloud_tracking=replace(config.cloud_tracking, front_end=front_end),
        cloud_closing=replace(config.cloud_closing, enabled=closing),
    )
    system = Slam(rig, config)
    return [system.track(frame) for frame in frames], system
