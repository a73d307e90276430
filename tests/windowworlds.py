"""Local windows of a synthetic world: points that cameras in a row or on a circle see.

Points have a random descriptor, of which each sighting flips some bits, and a distance at which
they show on the finest level. Keypoints come in random order, among them some of nothing.
"""

from dataclasses import dataclass, replace

import numpy as np

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.system.localwindow import LocalWindow
from odomap.vision.features import Features

CAMERA = Camera(intrinsics=(450.0, 450.0, 319.5, 239.5), resolution=(640, 480))
SCALE, LEVELS = 1.2, 8


@dataclass(frozen=True, eq=False)
class World:
    """A window and the truth about it."""

    window: LocalWindow
    points: np.ndarray
    """(P, 3) all there are."""
    point_at: tuple[np.ndarray, ...]
    """Per keyframe (n,) the point at each keypoint, −1 for nothing."""
    landmarks: np.ndarray
    """(M,) the point of each landmark."""


def row(count, step=0.3):
    """Return camera poses side by side, looking along z."""
    Ts = np.tile(np.eye(4), (count, 1, 1))
    Ts[:, 0, 3] = step * (np.arange(count) - count + 1)
    return Ts


def turning(count, step_deg=3.0):
    """Return camera poses in one place, each turned a little further."""
    angle = np.radians(step_deg) * (np.arange(count) - count + 1)
    Ts = np.tile(np.eye(4), (count, 1, 1))
    Ts[:, 0, 0], Ts[:, 0, 2] = np.cos(angle), np.sin(angle)
    Ts[:, 2, 0], Ts[:, 2, 2] = -np.sin(angle), np.cos(angle)
    return Ts


def circle(count, step_deg=6.0, radius=7.0, middle=7.0):
    """Return camera poses on a circle around (0, 0, middle), looking at it."""
    Ts = turning(count, step_deg)
    Ts[:, :3, 3] = np.array([0.0, 0.0, middle]) - radius * Ts[:, :3, 2]
    return Ts


def flipped(descriptors, rate, rng):
    """Return (N, 32) descriptors with that rate of their bits flipped."""
    return descriptors ^ np.packbits(rng.random((len(descriptors), 256)) < rate, axis=1)


def see(T_world_camera, points, descriptors, shows_at, rng, sigma_px, flips, clutter, sigma_depth):
    """Return the features of one view and the point at each, −1 for nothing."""
    T = se3_inverse(T_world_camera)
    local = points @ T[:3, :3].T + T[:3, 3]
    distance = np.linalg.norm(local, axis=1)
    level = np.round(np.log(shows_at / distance) / np.log(SCALE)).astype(int).clip(0, LEVELS - 1)
    noise = rng.normal(size=(len(points), 2)) * sigma_px * SCALE ** level[:, None]
    pixels = CAMERA.project(local) + noise
    visible = np.flatnonzero((local[:, 2] > 0.1) & CAMERA.is_inside(pixels, 5.0))
    who = np.concatenate([visible, np.full(clutter, -1)])
    far_off = rng.uniform([5, 5], [634, 474], (clutter, 2))
    inverse = 1.0 / local[visible, 2] + sigma_depth * rng.normal(size=len(visible))
    keypoints = np.concatenate([pixels[visible], far_off]).astype(np.float32)
    features = Features(
        keypoints,
        np.concatenate(
            [
                flipped(descriptors[visible], flips, rng),
                rng.integers(0, 256, (clutter, 32), np.uint8),
            ]
        ),
        CAMERA.unproject(keypoints),
        np.concatenate([1.0 / inverse, np.full(clutter, np.nan)])
        if sigma_depth
        else np.full(len(who), np.nan),
        np.concatenate([level[visible], rng.integers(0, LEVELS, clutter)]).astype(np.uint8),
    )
    order = rng.permutation(len(who))
    columns = (getattr(features, name)[order] for name in Features.__dataclass_fields__)
    return Features(*columns), who[order]


def world(
    Ts=None,
    count=500,
    known=0.5,
    sigma_px=0.5,
    flips=0.05,
    clutter=50,
    sigma_depth=0.0,
    fixed=1,
    seed=0,
):
    """Return a world of which some points are landmarks already, seen wherever they are visible.

    Args:
        Ts: (K, 4, 4) camera poses, the newest last; the `fixed` oldest are fixed.
        count: points, 4 to 10 m along z.
        known: part of them that are landmarks.
        sigma_px, flips, clutter: noise on the finest level, rate of wrong bits, false keypoints.
        sigma_depth: noise of inverse depths; 0 for no depth.
        seed: of all that is random.
    """
    rng = np.random.default_rng(seed)
    Ts = row(6) if Ts is None else Ts
    z = rng.uniform(4.0, 10.0, count)
    points = np.stack([*(rng.uniform(-0.65, 0.65, (2, count)) * z), z], axis=1)
    descriptors = rng.integers(0, 256, (count, 32), np.uint8)
    shows_at = rng.uniform(4.0, 20.0, count)
    views = [
        see(T, points, descriptors, shows_at, rng, sigma_px, flips, clutter, sigma_depth)
        for T in Ts
    ]
    point_at = tuple(who for _, who in views)
    is_known = np.zeros(count + 1, bool)
    is_known[:count] = rng.random(count) < known
    seen = np.concatenate(point_at)
    keyframe = np.repeat(np.arange(len(Ts)), [len(who) for who in point_at])
    keypoint = np.concatenate([np.arange(len(who)) for who in point_at])
    used = np.flatnonzero(is_known[seen])
    landmarks, obs_landmark = np.unique(seen[used], return_inverse=True)
    window = LocalWindow(
        keyframes=tuple(Keyframe(10 + k, 10**8 * k, f) for k, (f, _) in enumerate(views)),
        is_fixed=np.arange(len(Ts)) < fixed,
        Ts_world_camera=Ts,
        points_world=points[landmarks] + 0.002 * rng.normal(size=(len(landmarks), 3)),
        descriptors=flipped(descriptors[landmarks], flips, rng),
        num_observers=np.bincount(obs_landmark, minlength=len(landmarks)),
        obs_keyframe=keyframe[used],
        obs_landmark=obs_landmark,
        obs_keypoint=keypoint[used],
        newest=len(Ts) - 1,
        camera=CAMERA,
        sigma_px=max(sigma_px, 1e-3),
        level_scale=SCALE,
        inverse_depth_sigma=sigma_depth or 1.0,
    )
    return World(window, points, point_at, landmarks)


def keep_observations(window, kept):
    """Return the window without the observations that a (N,) mask leaves out."""
    counts = np.bincount(window.obs_landmark[kept], minlength=len(window.points_world))
    return replace(
        window,
        obs_keyframe=window.obs_keyframe[kept],
        obs_landmark=window.obs_landmark[kept],
        obs_keypoint=window.obs_keypoint[kept],
        num_observers=counts,
    )


def with_duplicates(window, rows, from_keyframe, off=0.005, seed=0):
    """Return the window with a second landmark for each row, which late keyframes see instead."""
    rng = np.random.default_rng(seed)
    twin = np.full(len(window.points_world), -1)
    twin[rows] = len(window.points_world) + np.arange(len(rows))
    late = (window.obs_keyframe >= from_keyframe) & (twin[window.obs_landmark] >= 0)
    obs_landmark = np.where(late, twin[window.obs_landmark], window.obs_landmark)
    moved = window.points_world[rows] + off * rng.normal(size=(len(rows), 3))
    return replace(
        window,
        points_world=np.concatenate([window.points_world, moved]),
        descriptors=np.concatenate(
            [window.descriptors, flipped(window.descriptors[rows], 0.03, rng)]
        ),
        obs_landmark=obs_landmark,
        num_observers=np.bincount(obs_landmark, minlength=len(window.points_world) + len(rows)),
    )


def with_features(window, k, **columns):
    """Return the window with some columns of keyframe row k's features replaced."""
    keyframes = list(window.keyframes)
    features = replace(keyframes[k].features, **columns)
    keyframes[k] = replace(keyframes[k], features=features)
    return replace(window, keyframes=tuple(keyframes))
