"""Disturbances: wrap a source to see what a system does when sensors fail or places recur.

    blank, drop, freeze, blur       a covered lens, lost frames, a camera that hangs, fast motion
    overexpose, exposure_jumps      too much light, an exposure that jumps
    cover, moving_object            a hand over the lens, a thing that moves through the view
    duplicate, kill_right           frames delivered twice, a pair whose right camera dies
    pierce_depth, roughen_depth     depth with holes (glass, black cloth, the sun), or noise
    walkers, lose_scans             people around a laser, scans that say nothing
    lose_sweeps, turn_lidar, ...    what goes wrong with a 3D LiDAR (`disturb_sweeps`)
    mirror_laser, turn_laser, widen a laser upside down, turned, or of another field of view
    slip, set_back                  wheels that slip, a clock that goes back
    reverse, there_and_back         the same recording played backwards, or forth and back

Each wrapper is a source like any other: it streams, its stamps increase strictly, and its truth is
that of the frames it gives, so wrappers nest and every metric works on them. Played there and
back, a recording passes every place twice, on different images (even frames forth, odd frames
back), with known truth: a loop, made from any sequence.

Time reversal maps an instant t to first + last - t: truth is re-timed, and a point that came t
after the stamp of its sweep comes t before it. Inertial samples do not survive it (rates change
sign, gravity does not), nor the even spacing of there-and-back, so these two sources have no IMU.

Reference: J. Engel, V. Usenko, D. Cremers, "A photometrically calibrated benchmark for monocular
visual odometry", arXiv:1607.02555, 2016 (sequences played forwards and backwards).
"""

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sources.disturb_light import exposure_jumps, overexpose
from odomap.sources.disturb_scans import (
    lose_scans,
    mirror_laser,
    set_back,
    slip,
    turn_laser,
    walkers,
    widen,
)
from odomap.sources.disturb_streams import duplicate, kill_right
from odomap.sources.disturb_sweeps import (
    compensate,
    lose_sweeps,
    miscount_beams,
    misscale_times,
    turn_lidar,
    with_misses,
    without_columns,
)
from odomap.sources.disturb_things import cover, moving_object
from odomap.sources.source import Source
from odomap.sources.wrappers import Changed, Dropped, Frozen, Replayed, seekable

__all__ = [
    "blank",
    "blur",
    "compensate",
    "cover",
    "drop",
    "duplicate",
    "exposure_jumps",
    "freeze",
    "kill_right",
    "lose_scans",
    "lose_sweeps",
    "mirror_laser",
    "miscount_beams",
    "misscale_times",
    "moving_object",
    "overexpose",
    "pierce_depth",
    "reverse",
    "roughen_depth",
    "set_back",
    "slip",
    "there_and_back",
    "turn_laser",
    "turn_lidar",
    "walkers",
    "widen",
    "with_misses",
    "without_columns",
]

PATCH_PX = 8
"""Side of the patches of depth that are lost together."""


def blank(source: Source, frames: Iterable[int], *, depth: bool = True) -> Source:
    """Blacken the images of some frames: a covered lens, or no light.

    Args:
        source: any source.
        frames: ids of the frames.
        depth: whether depth goes, too, as under a hand. Without light it stays: a depth camera
            brings its own.
    """
    chosen = frozenset(frames)

    def change(frame: Frame) -> Frame:
        if frame.id not in chosen:
            return frame
        dark = tuple(None if image is None else np.zeros_like(image) for image in frame.images)
        if frame.depth is None or not depth:
            return replace(frame, images=dark)
        return replace(frame, images=dark, depth=np.zeros_like(frame.depth))

    return Changed(source, "blank", change)


def pierce_depth(
    source: Source,
    frames: Iterable[int] | None = None,
    *,
    share: float = 0.0,
    box: tuple[int, int, int, int] | None = None,
    seed: int = 0,
) -> Source:
    """Set depth to unknown in a part of the image: glass, black cloth, the sun.

    Args:
        source: any source; frames without depth stay as they are.
        frames: ids of the frames; default all.
        share: share of the pixels that are lost, from 0 to 1, in square patches.
        box: first column, first row, width and height of a rectangle that is lost, pixels.
        seed: of the places of the patches.

    Raises:
        InputError: the share is not from 0 to 1.
    """
    if not 0 <= share <= 1:
        raise InputError(f"pierce_depth: share {share} must be from 0 to 1")
    chosen = None if frames is None else frozenset(frames)

    def change(frame: Frame) -> Frame:
        if frame.depth is None or (chosen is not None and frame.id not in chosen):
            return frame
        depth = frame.depth.copy()
        rows, columns = (-(-size // PATCH_PX) for size in depth.shape)
        lost = np.random.default_rng((seed, frame.id)).random((rows, columns)) < share
        lost = lost.repeat(PATCH_PX, 0).repeat(PATCH_PX, 1)[: depth.shape[0], : depth.shape[1]]
        depth[lost] = 0
        if box is not None:
            x, y, width, height = box
            depth[y : y + height, x : x + width] = 0
        return replace(frame, depth=depth)

    return Changed(source, "pierced depth", change)


def roughen_depth(
    source: Source, frames: Iterable[int] | None = None, *, sigma_m: float = 0.002, seed: int = 0
) -> Source:
    """Add noise to depth that grows with its square, as triangulation has it.

    Args:
        source: any source; unknown depth stays unknown.
        frames: ids of the frames; default all.
        sigma_m: standard deviation at a depth of 1 m, metres; at z it is sigma_m · z².
        seed: of the noise.

    Raises:
        InputError: sigma_m is negative.
    """
    if not sigma_m >= 0:
        raise InputError(f"roughen_depth: sigma_m {sigma_m} must be 0 or more")
    chosen = None if frames is None else frozenset(frames)

    def change(frame: Frame) -> Frame:
        if frame.depth is None or (chosen is not None and frame.id not in chosen):
            return frame
        rng = np.random.default_rng((seed, frame.id))
        noise = rng.standard_normal(frame.depth.shape, np.float32)
        rough = frame.depth + np.float32(sigma_m) * frame.depth**2 * noise
        return replace(frame, depth=np.maximum(rough, 0).astype(np.float32))

    return Changed(source, "rough depth", change)


def blur(
    source: Source, frames: Iterable[int], length_px: float = 15.0, angle_deg: float = 0.0
) -> Source:
    """Smear the images of some frames along a line: motion too fast for the exposure.

    Args:
        source: any source.
        frames: ids of the frames.
        length_px: how far a point moves during the exposure.
        angle_deg: direction in the image, 0 along x, 90 along y.
    """
    chosen = frozenset(frames)
    if not length_px >= 0:
        raise InputError(f"blur: length_px {length_px} must be 0 or more")
    line = _line(length_px, np.deg2rad(angle_deg))

    def change(frame: Frame) -> Frame:
        if frame.id not in chosen:
            return frame
        smeared = tuple(
            None if image is None else np.asarray(cv2.filter2D(image, -1, line), np.uint8)
            for image in frame.images
        )
        return replace(frame, images=smeared)

    return Changed(source, "blur", change)


def _line(length: float, angle: float) -> NDArray[np.float64]:
    """Return a blur kernel: a line through the centre, spread over pixels bilinearly."""
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    along = np.linspace(-length / 2, length / 2, max(2, int(8 * length)))
    x, y = half + along * np.cos(angle), half + along * np.sin(angle)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            weight = (1 - np.abs(x - left - dx)) * (1 - np.abs(y - top - dy))
            np.add.at(kernel, (top + dy, left + dx), weight)
    return np.asarray(kernel / kernel.sum())


def drop(source: Source, frames: Iterable[int]) -> Source:
    """Leave out some frames; their inertial samples go to the next frame that is there.

    Args:
        source: any source.
        frames: ids of the frames; the ids of the others stay, so that the gaps show.
    """
    return Dropped(source, frozenset(frames))


def freeze(source: Source, frames: Iterable[int]) -> Source:
    """Repeat the last image in some frames, under their own stamps: a camera that hangs.

    Args:
        source: any source.
        frames: ids of the frames; the first frame of a source cannot hang.
    """
    return Frozen(source, frozenset(frames))


def reverse(source: Source) -> Source:
    """Play a recording backwards.

    Args:
        source: a source whose frames can be read in any order.

    Returns:
        Frames from the last to the first, without IMU; an instant t becomes first + last - t, of
        the truth too.

    Raises:
        InputError: the source is a stream only.
    """
    inner = seekable(source)
    stamps = inner.stamps_ns
    order = np.arange(len(stamps))[::-1]
    mirror = int(stamps[0]) + int(stamps[-1]) if len(stamps) else 0
    truth = source.truth
    if truth is not None:
        truth = Trajectory(
            mirror - truth.stamps_ns[::-1],
            truth.Ts_world_body[::-1],
            None if truth.covariances is None else truth.covariances[::-1],
        )
    backwards = np.ones(len(order), np.bool_)
    played = Replayed(inner, "reversed", order, mirror - stamps[::-1], truth, backwards)
    other = {"clockwise": "counter_clockwise", "counter_clockwise": "clockwise", "none": "none"}
    lidars = tuple(replace(mount, sweep=other[mount.sweep]) for mount in played.rig.lidars)
    played.rig = replace(played.rig, lidars=lidars)
    return played


def there_and_back(source: Source) -> Source:
    """Play the even frames forth and the odd ones back, evenly spaced.

    Args:
        source: a source whose frames can be read in any order.

    Returns:
        Frames without IMU, from the first stamp on, twice the median step of the recording apart;
        its truth has one pose for each of them that the truth of the recording covers.

    Raises:
        InputError: the source is a stream only, or has less than three frames.
    """
    inner = seekable(source)
    stamps = inner.stamps_ns
    if len(stamps) < 3:
        raise InputError(f"{source.name}: there and back needs three frames or more")
    places = np.arange(len(stamps))
    order = np.concatenate([places[::2], places[1::2][::-1]])
    step = 2 * round(float(np.median(np.diff(stamps))))
    played = stamps[0] + places * step
    truth = _retimed(source.truth, stamps[order], played)
    return Replayed(inner, "there and back", order, played, truth, order % 2 == 1)


def _retimed(
    truth: Trajectory | None, recorded: NDArray[np.int64], played: NDArray[np.int64]
) -> Trajectory | None:
    """Return the true poses of frames recorded at one time and played at another."""
    if truth is None:
        return None
    covered = (recorded >= truth.stamps_ns[0]) & (recorded <= truth.stamps_ns[-1])
    if not covered.any():
        return None
    in_order = np.argsort(recorded[covered])
    poses = truth.interpolate(recorded[covered][in_order]).Ts_world_body
    back = np.empty_like(in_order)
    back[in_order] = np.arange(len(in_order))
    return Trajectory(played[covered], poses[back])
