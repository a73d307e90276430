"""Maps to be adjusted as a whole: a camera between two walls of points, of any size, made at once.

It goes round and round between the walls; what it sees is right but for the noise of pixels and
depths, while its poses bend away from the truth, and its points with them. So a map looks after a
loop was closed.
"""

from dataclasses import dataclass

import numpy as np

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.vision.features import Features
from system.circuits import around

CAMERA = Camera(intrinsics=(250.0, 250.0, 199.5, 149.5), resolution=(400, 300))
PIXELS, DEPTH = 0.7, 0.004
"""Standard deviations: of a keypoint on the finest level, pixels; of an inverse depth, 1/m."""
LEVELS, SCALE = 4, 1.2
NEAR, FAR = 1.0, 14.0


@dataclass(frozen=True, eq=False)
class AdjustWorld:
    """A map off its truth.

    Attributes:
        map: keyframes, landmarks, observations.
        true: (K, 4, 4) T_world_body.
        points: (M, 3) of landmarks 0, 1, ...
        T_body_camera: (4, 4) mount.
        seen: (m,) landmarks that several keyframes see.
        wrong: (w, 2) keyframes and landmarks of observations that are of something else.
    """

    map: Map
    true: np.ndarray
    points: np.ndarray
    T_body_camera: np.ndarray
    seen: np.ndarray
    wrong: np.ndarray

    def errors(self):
        """Return how far keyframes are from where they were, (K,)."""
        Ts = self.map.Ts_world_body(np.arange(len(self.true)))
        return np.linalg.norm(Ts[:, :3, 3] - self.true[:, :3, 3], axis=1)

    def landmark_errors(self):
        """Return how far landmarks that several keyframes see are from their points."""
        places = self.map.points_world(self.seen)
        return np.linalg.norm(places - self.points[self.seen], axis=1)

    def ate(self):
        return float(np.sqrt(np.mean(self.errors() ** 2)))


def adjust_world(
    keyframes=60,
    landmarks=1500,
    laps=1.15,
    spacing=0.6,
    deep=True,
    bend=0.2,
    off=0.01,
    wrong=0.0,
    scales=0.0,
    most=400,
    bias=0.0,
    seed=0,
):
    """Make a map.

    Args:
        keyframes, landmarks: how many.
        laps: how often around.
        spacing: metres between keyframes.
        deep: whether depth is measured.
        bend: by how much poses bend away, metres.
        off: standard deviation of poses beyond that, metres; angles a tenth.
        wrong: share of observations that are of something else.
        scales: by how much keyframes differ in scale: one camera, after a loop.
        most: points that a keyframe knows again.
        bias: what all inverse depths are off by, 1/m.
        seed: of all noise.
    """
    rng = np.random.default_rng(seed)
    radius = spacing * keyframes / laps / (2 * np.pi)
    mount = se3_exp(np.array([0.1, -0.05, 0.2, 0.02, -0.01, 0.03]))
    true = around(keyframes, laps, radius) @ se3_inverse(mount)
    points = _walls(rng, landmarks, radius)
    Ts_world_camera = true @ mount
    drift = _bent(true, bend, off, rng)
    units = 1.0 + scales * np.sin(np.arange(keyframes) / 7.0)
    m = Map()
    sights = []
    for k in range(keyframes):
        seen, features = _looked(rng, Ts_world_camera[k], points, deep, most, bias)
        sights.append(seen)
        m.add_keyframe(Keyframe(k, 10**8 * k, features), drift[k], scale=units[k])
    counts = np.array([len(seen) for seen in sights])
    keyframe, landmark = np.repeat(np.arange(keyframes), counts), np.concatenate(sights)
    keypoint = np.concatenate([np.arange(n) for n in counts])
    first = np.full(landmarks, keyframes)
    np.minimum.at(first, landmark, keyframe)
    first = np.where(first == keyframes, 0, first)
    local = np.einsum("nji,nj->ni", true[first, :3, :3], points - true[first, :3, 3])
    local += 0.02 * rng.normal(size=local.shape)
    m.add_landmarks(first, local / units[first, None], np.zeros((landmarks, 32), np.uint8))
    is_wrong = rng.random(len(landmark)) < wrong
    keypoint[is_wrong] = _mixed(keyframe[is_wrong], keypoint[is_wrong])
    m.add_observations(keyframe, landmark, keypoint)
    seen = np.flatnonzero(np.bincount(landmark, minlength=landmarks) > 1)
    pairs = np.stack([keyframe[is_wrong], landmark[is_wrong]], axis=1)
    return AdjustWorld(m, true, points, mount, seen, pairs)


def _walls(rng, count, radius):
    """Return points on both sides of the way."""
    angle = np.sort(rng.uniform(-np.pi, np.pi, count))
    away = radius + rng.choice([-3.0, 3.0], count) + rng.uniform(-0.5, 0.5, count)
    return np.stack([away * np.cos(angle), away * np.sin(angle), rng.uniform(-2, 2, count)], axis=1)


def _mixed(keyframe, keypoint):
    """Return keypoints, each that of the next landmark in its keyframe."""
    mixed = keypoint.copy()
    for k in np.unique(keyframe):
        mixed[keyframe == k] = np.roll(keypoint[keyframe == k], 1)
    return mixed


def _bent(true, bend, off, rng):
    """Return poses that stray from the truth smoothly, and a little each for itself."""
    k = np.arange(len(true)) / len(true)
    xi = rng.normal(size=(len(true), 6)) * off * np.array([1, 1, 1, 0.1, 0.1, 0.1])
    xi[:, :3] += bend * np.sin(np.pi * k)[:, None] * rng.normal(size=3)
    xi[0] = 0.0
    return true @ se3_exp(xi)


def _looked(rng, T_world_camera, points, deep, most, bias):
    """Return the points (n,) that a camera sees, and the features it has of them."""
    x, y, _ = T_world_camera[:3, 3]
    turn = np.arange(-np.pi, np.pi, 2 * np.pi / len(points))
    reach = int(np.ceil(len(points) * min(FAR / np.hypot(x, y), np.pi) / (2 * np.pi)))
    at = np.searchsorted(turn, np.arctan2(y, x))
    near = np.unique(np.arange(at - reach, at + reach) % len(points))
    local = (points[near] - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    pixels = CAMERA.project(local)
    shown = (local[:, 2] > NEAR) & (local[:, 2] < FAR) & CAMERA.is_inside(pixels)
    shown = np.flatnonzero(shown)
    shown = np.sort(rng.permutation(shown)[:most])
    seen, local = near[shown], local[shown]
    level = rng.integers(0, LEVELS, len(seen)).astype(np.uint8)
    noise = rng.normal(size=(len(seen), 2)) * PIXELS * SCALE ** level[:, None]
    bearings = np.ones((len(seen), 3))
    fx, fy, cx, cy = CAMERA.intrinsics
    keypoints = pixels[shown] + noise
    bearings[:, :2] = (keypoints - [cx, cy]) / [fx, fy]
    depth = 1.0 / (1.0 / local[:, 2] + bias + DEPTH * rng.normal(size=len(seen)))
    depth[(rng.random(len(seen)) < 0.2) | (not deep)] = np.nan
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    looks = np.zeros((len(seen), 32), np.uint8)
    return seen, Features(keypoints.astype(np.float32), looks, bearings, depth, level)
