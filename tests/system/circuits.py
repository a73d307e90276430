"""Circuits without images: keyframes see described points, and know those seen lately again.

A camera goes round between two walls of points. A point seen in the last few keyframes is known by
its landmark; one seen long ago is a new landmark, as where odometry came back. Steps are noisy, or
longer and longer, so that the path drifts; what a keyframe sees is right relative to it.
"""

from dataclasses import dataclass

import numpy as np

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.vision.features import Features

CAMERA = Camera(intrinsics=(250.0, 250.0, 199.5, 149.5), resolution=(400, 300))
PIXELS = 0.3
"""Standard deviation of a keypoint on the finest level, pixels."""
LEVELS, SCALE = 8, 1.2
MEMORY = 8
"""Keyframes for which a point is known by its landmark."""
STEP = np.array([3e-3, 3e-3, 3e-3, 5e-4, 5e-4, 5e-4])
"""Standard deviations of a step of odometry."""


@dataclass(frozen=True)
class Walls:
    """Points around a circuit: places (P, 3), descriptors (P, 32), distance of level 0 (P,)."""

    points: np.ndarray
    descriptors: np.ndarray
    finest: np.ndarray

    @staticmethod
    def make(seed=0, count=6000, radius=8.0):
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0, 2 * np.pi, count)
        away = radius + rng.choice([-3.0, 3.0], count) + rng.uniform(-0.5, 0.5, count)
        points = np.stack([away * np.cos(angle), away * np.sin(angle), rng.uniform(-2, 2, count)])
        looks = rng.integers(0, 256, (count, 32), np.uint8)
        return Walls(points.T.copy(), looks, rng.uniform(6, 12, count))


def around(keyframes, laps=1.15, radius=8.0, start=0.0):
    """Return true poses T_world_camera (K, 4, 4): round and round, looking ahead."""
    angle = start + 2 * np.pi * laps * np.arange(keyframes) / keyframes
    Ts = np.tile(np.eye(4), (keyframes, 1, 1))
    Ts[:, :3, 3] = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    ahead = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    Ts[:, :3, 2], Ts[:, :3, 1] = ahead, [0, 0, -1]
    Ts[:, :3, 0] = np.cross(Ts[:, :3, 1], ahead)
    return Ts


class Circuit:
    """A map that grows keyframe by keyframe; `count` says how many there were.

    Args:
        true: (K, 4, 4) poses.
        walls: what is seen.
        seed: of all noise.
        scale: the units of the last keyframe are by this larger than those of the first.
        noise: factor on the noise of steps.
    """

    def __init__(self, true, walls, seed=0, scale=0.0, noise=1.0):
        self.map, self.true, self.walls = Map(), true, walls
        self.count = 0
        self.rng = np.random.default_rng(seed)
        self.units = 1.0 + scale * np.arange(len(true)) / len(true)
        self.step_sigma = noise * STEP
        self.known: dict[int, tuple[int, int]] = {}  # of a point its landmark, and when it was seen
        self.points_of: dict[int, int] = {}

    def add(self):
        """Add the next keyframe, with all it sees, and return it."""
        n, m = self.count, self.map
        keyframe, seen = self._keyframe(n)
        if n == 0:
            m.add_keyframe(keyframe, np.array(self.true[0]), covariance=1e-12 * np.eye(6))
        else:
            step = se3_inverse(self.true[n - 1]) @ self.true[n]
            step[:3, 3] *= self.units[n - 1]
            step = step @ se3_exp(self.rng.normal(size=6) * self.step_sigma)
            Ad = se3_adjoint(se3_inverse(step))
            S = Ad @ m.covariance(n - 1) @ Ad.T + np.diag(np.maximum(self.step_sigma, 1e-4) ** 2)
            m.add_keyframe(keyframe, m.place(n - 1, step), covariance=S, scale=m.scale(n - 1))
        new = [p for p in seen.tolist() if n - self.known.get(p, (0, -99))[1] > MEMORY]
        local = self._local(n, new) * self.units[n]
        for p, k in zip(new, m.add_landmarks(n, local, self.walls.descriptors[new]).tolist()):
            self.known[p], self.points_of[k] = (k, n), p
        ids = [self.known[p][0] for p in seen.tolist()]
        for p, k in zip(seen.tolist(), ids):
            self.known[p] = k, n
        m.add_observations(n, ids, np.arange(len(ids)))
        self.count += 1
        return keyframe

    def _local(self, n, points):
        T = self.true[n]
        return (self.walls.points[points] - T[:3, 3]) @ T[:3, :3]

    def _keyframe(self, n):
        w, local = self.walls, self._local(n, slice(None))
        away = np.linalg.norm(local, axis=1)
        pixels = CAMERA.project(local)
        level = np.rint(np.log(w.finest / away) / np.log(SCALE))
        shown = (local[:, 2] > 0.5) & CAMERA.is_inside(pixels) & (level >= 0) & (level < LEVELS)
        seen = np.flatnonzero(shown)
        level = level[seen].astype(np.uint8)
        noise = self.rng.normal(size=(len(seen), 2)) * PIXELS * SCALE ** level[:, None]
        flipped = self.rng.random((len(seen), 256)) < 0.03
        features = Features(
            (pixels[seen] + noise).astype(np.float32),
            w.descriptors[seen] ^ np.packbits(flipped, axis=1),
            local[seen] / away[seen, None],
            np.full(len(seen), np.nan),
            level,
        )
        return Keyframe(n, 10**8 * n, features), seen

    def landmark_errors(self):
        """Return how far landmarks are from their points, (M,)."""
        ids = np.array(sorted(self.points_of))
        ids = ids[self.map.resolve(ids) == ids]
        points = self.walls.points[[self.points_of[k] for k in ids.tolist()]]
        return np.linalg.norm(self.map.points_world(ids) - points, axis=1)

    def errors(self):
        """Return how far keyframes are from where they were, (K,)."""
        Ts = self.map.Ts_world_body(np.arange(self.count))
        return np.linalg.norm(Ts[:, :3, 3] - self.true[: self.count, :3, 3], axis=1)
