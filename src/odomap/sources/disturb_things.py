"""Disturbances by things: a hand over the lens, an object that moves before the camera.

A moving object is a painted board facing the first camera, at distance z, whose centre c(t) crosses
the view. Every camera of the rig sees it through its own lens: the ray d of a pixel meets the board
where

    p = o + s d,   s = (z − o_z) / d_z,   (u, v) = (p_xy − c(t)) / size,

with o the camera's centre and all of it in the first camera's frame. So both images of a pair show
it shifted by its disparity, and a depth image shows its depth: whatever hides behind it, nothing
about it says that it is not a part of the world, but that it moves.

A hand is too near for any lens to make it sharp or any pair to measure it.

Reference: B. Bescos et al., "DynaSLAM: tracking, mapping and inpainting in dynamic scenes", IEEE
Robotics and Automation Letters 3(4), 2018 (what moving things do to SLAM).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.sensors.frame import Frame
from odomap.sensors.rig import CameraMount, Rig
from odomap.sources.source import Source
from odomap.sources.wrappers import Changed

__all__ = ["cover", "moving_object"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PAINT_PX = 512
"""Side of the picture on the board."""
DARK = 34.0
"""Mean level of a hand on the lens."""


def cover(
    source: Source,
    frames: Iterable[int],
    *,
    share: float = 0.9,
    cameras: Iterable[int] | None = None,
    seed: int = 0,
) -> Source:
    """Put a hand over the lens: dark and out of focus, it comes, covers most of it, and goes.

    Args:
        source: any source.
        frames: ids of the frames in which it is seen; it is largest in the middle one.
        share: share of the image it hides then, from 0 to 1.
        cameras: rows of the rig's cameras that it covers; default all, and depth with the first.
        seed: of its skin, and of the side it comes from.

    Raises:
        InputError: the share is not from 0 to 1.
    """
    if not 0 <= share <= 1:
        raise InputError(f"cover: share {share} must be from 0 to 1")
    place = {frame: k for k, frame in enumerate(sorted(set(frames)))}
    chosen = None if cameras is None else frozenset(cameras)
    side = np.random.default_rng(seed).uniform(0, 2 * np.pi)

    def change(frame: Frame) -> Frame:
        if frame.id not in place:
            return frame
        # From nothing before the first frame to all of it in the middle and back.
        phase = (place[frame.id] + 1) / (len(place) + 1)
        hidden = share * np.sin(np.pi * phase)
        images = list(frame.images)
        for k, image in enumerate(frame.images):
            if image is not None and (chosen is None or k in chosen):
                rng = np.random.default_rng((seed, frame.id, k))
                images[k] = _covered(image, _hand(image.shape, hidden, side), rng)
        depth = frame.depth
        if depth is not None and (chosen is None or 0 in chosen):
            depth = np.where(_hand(depth.shape, hidden, side) > 0.3, np.float32(0), depth)
        return replace(frame, images=tuple(images), depth=depth)

    return Changed(source, "hand over the lens", change)


def _hand(shape: tuple[int, ...], share: float, side: float) -> Array:
    """Return (H, W) how much of each pixel a hand hides that comes from a side of the image."""
    height, width = shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    x, y = (2 * x + 1) / width - 1, (2 * y + 1) / height - 1
    along, across = x * np.cos(side) + y * np.sin(side), y * np.cos(side) - x * np.sin(side)
    # The edge of four fingers; which of the pixels lie behind it decides how many there are.
    edge = along + 0.12 * np.abs(np.sin(3.5 * across)) + 0.25 * across**2
    front = np.quantile(edge, 1 - share)
    return np.asarray(1 / (1 + np.exp(np.clip((front - edge) / 0.07, -50, 50))))


def _covered(image: Image, hand: Array, rng: np.random.Generator) -> Image:
    """Return an image with a hand before it, its skin a faint texture without edges."""
    coarse = rng.standard_normal((image.shape[0] // 24 + 2, image.shape[1] // 24 + 2))
    skin = cv2.resize(coarse, image.shape[::-1], interpolation=cv2.INTER_CUBIC)
    level = DARK + 3.0 * skin + rng.normal(0, 1.2, image.shape)
    return np.rint(np.clip((1 - hand) * image + hand * level, 0, 255)).astype(np.uint8)


def moving_object(
    source: Source,
    frames: Iterable[int],
    *,
    share: float = 1 / 3,
    distance: float = 1.2,
    crossing: float = 1.0,
    seed: int = 0,
) -> Source:
    """Let a painted board move across the view, near and rigid, with a motion of its own.

    Args:
        source: any source with cameras.
        frames: ids of the frames in which it is there.
        share: share of the first camera's view it fills when all of it is in view.
        distance: along that camera's axis, metres.
        crossing: how much of the way across it goes: 1 from outside to outside, 0.2 slowly about
            the middle, 0 not at all, so that it goes along with the camera.
        seed: of its paint and of the noise of its pixels.

    Raises:
        InputError: the rig has no camera, the share is not from 0 to 1, or the distance or the
            crossing are not what they can be.
    """
    if not 0 < share <= 1:
        raise InputError(f"moving_object: share {share} must be above 0 and at most 1")
    if not (np.isfinite(distance) and distance > 0):
        raise InputError(f"moving_object: distance {distance} must be a positive number of metres")
    if not 0 <= crossing <= 1:
        raise InputError(f"moving_object: crossing {crossing} must be from 0 to 1")
    if not source.rig.cameras:
        raise InputError(f"{source.name}: moving_object needs a rig with a camera")
    place = {frame: k for k, frame in enumerate(sorted(set(frames)))}
    board = _Board.of(source.rig, share, distance, seed)

    def change(frame: Frame) -> Frame:
        if frame.id not in place:
            return frame
        phase = 2 * (place[frame.id] + 0.5) / len(place) - 1  # from -1 to 1
        return board.shown(frame, crossing * phase)

    return Changed(source, "moving object", change)


@dataclass(frozen=True, eq=False)
class _Board:
    """A painted board before the first camera.

    Attributes:
        paint: (PAINT_PX, PAINT_PX) its picture.
        size: (2,) width and height, metres.
        reach: how far from the axis its centre is when it has just left the view, metres.
        distance: along the axis, metres.
        hits: for each camera where the ray of each pixel meets its plane, (H, W, 2) metres, NaN
            where it does not.
        depth: row of the camera that depth is registered to, −1 for none.
        z: (H, W) depth of the plane as that camera measures it, metres.
        seed: of the noise.
    """

    paint: Image
    size: Array
    reach: float
    distance: float
    hits: tuple[Array, ...]
    depth: int
    z: Array
    seed: int

    @staticmethod
    def of(rig: Rig, share: float, distance: float, seed: int) -> "_Board":
        """Return a board that fills a share of the first camera's view."""
        first = rig.cameras[0]
        met = [_meet(mount, first, distance) for mount in rig.cameras]
        x, y = met[0][0][..., 0], met[0][0][..., 1]
        # Fisheyes see more of the plane than there is to it: the middle of the view is meant.
        middle = np.abs(np.array([np.nanquantile(v, [0.02, 0.98]) for v in (x, y)])).min(axis=1)
        half = min(1.0, 1.04 * np.sqrt(share)) * middle
        depth = -1 if rig.depth is None else rig.cameras.index(rig.camera(rig.depth.camera))
        return _Board(
            _paint(seed),
            2 * half,
            float(middle[0] + half[0]),
            distance,
            tuple(hits for hits, _ in met),
            depth,
            met[max(depth, 0)][1],
            seed,
        )

    def shown(self, frame: Frame, where: float) -> Frame:
        """Return a frame with the board in it, at -1 before it comes in, at 1 after it has left."""
        images, depth = list(frame.images), frame.depth
        for k, (image, hits) in enumerate(zip(frame.images, self.hits, strict=True)):
            if image is None:
                continue
            at = (hits - (where * self.reach, 0.0)) / self.size + 0.5
            on = np.all((at >= 0) & (at <= 1), axis=2)
            u, v = np.moveaxis(np.nan_to_num(at, nan=-1.0) * (PAINT_PX - 1), 2, 0)
            seen = cv2.remap(
                self.paint, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR
            )
            noise = np.random.default_rng((self.seed, frame.id, k)).normal(0, 1.5, image.shape)
            painted = np.rint(np.clip(seen + noise, 0, 255)).astype(np.uint8)
            images[k] = np.where(on, painted, image)
            if k == self.depth and depth is not None and depth.shape == on.shape:
                depth = np.where(on, self.z, depth).astype(np.float32)
        return replace(frame, images=tuple(images), depth=depth)


def _meet(mount: CameraMount, first: CameraMount, distance: float) -> tuple[Array, Array]:
    """Return where a camera's rays meet the plane z = distance of the first one, and at what depth.

    Returns:
        (H, W, 2) x and y in the first camera's frame and (H, W) depth in the camera's own, metres;
        NaN where the plane is not met.
    """
    camera: Camera = mount.camera
    T = se3_inverse(first.T_body_camera.matrix) @ mount.T_body_camera.matrix
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64))
    turned = rays @ T[:3, :3].T
    # A ray along the plane or away from it never meets it.
    ahead = np.where(turned[:, 2] > 0.05, turned[:, 2], np.nan)
    along = (distance - T[2, 3]) / ahead
    points = T[:3, 3] + along[:, None] * turned
    shape = (camera.height, camera.width)
    return points[:, :2].reshape(*shape, 2), (along * rays[:, 2]).reshape(shape)


def _paint(seed: int) -> Image:
    """Return a picture with corners of all sizes."""
    rng = np.random.default_rng((seed, 31))
    paint = np.full((PAINT_PX, PAINT_PX), 110, np.uint8)
    for _ in range(700):
        x, y = rng.integers(-20, PAINT_PX, 2)
        width, height = rng.integers(8, 70, 2)
        paint[max(y, 0) : y + height, max(x, 0) : x + width] = rng.integers(20, 236)
    return np.asarray(cv2.GaussianBlur(paint, (0, 0), 1.2), np.uint8)
