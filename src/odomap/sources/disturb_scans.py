"""Disturbances of 2D lasers: people before them, scans that say nothing, mounts that are wrong.

People are discs that walk about the laser, at 0.8 to 3 m: they hide what is behind them and are
seen as what they are, parts of the world but for their motion. A disc of radius q at distance c and
bearing β is met by the beam at bearing a at

    r = c cos(a − β) − sqrt(q² − c² sin²(a − β)).

A mount is wrong in two ways: the rig knows of it (a laser upside down, its beams in the other
sense), and all must be as it was; or it does not, and the system must notice or fail honestly.
Wheels that slip turn more or less than the body moves; their later steps are right again.

Reference: D. Hähnel, D. Schulz, W. Burgard, "Map building with mobile robots in populated
environments", IROS 2002 (people in scans).
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.geometry.pose import SE3
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.source import RandomAccess, Source
from odomap.sources.wrappers import Changed

__all__ = ["lose_scans", "mirror_laser", "set_back", "slip", "turn_laser", "walkers", "widen"]

Array = NDArray[np.float64]
Loss = Literal["nan", "inf", "empty", "one"]
"""What a scan without anything in it holds."""

WALK = (0.8, 3.0)
"""Distances of people, metres."""
GIRTH = (0.2, 0.35)
"""Their radii at the height of a laser, metres."""


def walkers(source: Source, frames: Iterable[int], *, share: float = 0.2, seed: int = 0) -> Source:
    """Let people walk around the laser, so many that they fill a share of each scan.

    Args:
        source: any source with a 2D laser.
        frames: ids of the frames in which they are there.
        share: share of the beams they hide, from 0 to 1.
        seed: of where they are and where they go.

    Raises:
        InputError: there is no 2D laser, or the share is not from 0 to 1.
    """
    if not 0 <= share <= 1:
        raise InputError(f"walkers: share {share} must be from 0 to 1")
    mount = _laser(source, "walkers")
    chosen = frozenset(frames)
    angles = np.linspace(*mount.angles[:2], mount.angles[2])
    rng = np.random.default_rng((seed, 43))
    # More than are needed: in each frame as many of them are there as hide the share.
    start = rng.uniform(-np.pi, np.pi, 64)
    pace = rng.choice([-1.0, 1.0], 64) * rng.uniform(0.01, 0.04, 64)
    near = rng.uniform(*WALK, 64)
    girth = rng.uniform(*GIRTH, 64)

    def change(frame: Frame) -> Frame:
        if frame.id not in chosen or frame.scan is None or len(frame.scan) != len(angles):
            return frame
        scan = frame.scan.copy()
        hidden = np.zeros(len(scan), np.bool_)
        for k in range(len(start)):
            if hidden.mean() >= share:
                break
            off = angles - start[k] - pace[k] * frame.id
            under = girth[k] ** 2 - (near[k] * np.sin(off)) ** 2
            seen = (under > 0) & (np.cos(off) > 0) & ~hidden
            seen &= ~(scan < near[k])
            # The last one is as wide as is missing.
            seen &= np.cumsum(seen) <= share * len(scan) - hidden.sum()
            scan[seen] = near[k] * np.cos(off[seen]) - np.sqrt(under[seen])
            hidden |= seen
        return replace(frame, scan=scan)

    return Changed(source, "people", change)


def lose_scans(source: Source, frames: Iterable[int], how: Loss = "nan") -> Source:
    """Let scans say nothing.

    Args:
        source: any source with a 2D laser.
        frames: ids of the frames.
        how: all beams invalid ("nan"), all out of reach ("inf"), no beams at all ("empty"), or all
            invalid but the middle one ("one").

    Raises:
        InputError: there is no 2D laser, or no such way.
    """
    if how not in ("nan", "inf", "empty", "one"):
        raise InputError(f"lose_scans: how '{how}' is none of nan, inf, empty, one")
    _laser(source, "lose_scans")
    chosen = frozenset(frames)

    def change(frame: Frame) -> Frame:
        if frame.id not in chosen or frame.scan is None:
            return frame
        if how == "empty":
            return replace(frame, scan=np.zeros(0))
        scan = np.full(len(frame.scan), np.inf if how == "inf" else np.nan)
        if how == "one":
            scan[len(scan) // 2] = frame.scan[len(scan) // 2]
        return replace(frame, scan=scan)

    return Changed(source, f"{how} scans", change)


def mirror_laser(source: Source, *, told: bool = False) -> Source:
    """Mount the laser upside down: its beams come in the other sense.

    Args:
        source: any source with a 2D laser.
        told: whether the rig says so; then nothing is lost.

    Raises:
        InputError: there is no 2D laser.
    """
    mount = _laser(source, "mirror_laser")

    def change(frame: Frame) -> Frame:
        return frame if frame.scan is None else replace(frame, scan=frame.scan[::-1].copy())

    mirrored = Changed(source, "mirrored", change)
    if told:
        first, last, beams = mount.angles
        over = SE3(se3_exp([0, 0, 0, np.pi, 0, 0]))
        mirrored.rig = _refitted(
            source,
            replace(mount, T_body_lidar=mount.T_body_lidar @ over, angles=(-last, -first, beams)),
        )
    return mirrored


def turn_laser(source: Source, angle: float, *, told: bool = False) -> Source:
    """Mount the laser turned about its axis.

    Args:
        source: any source with a 2D laser.
        angle: by which it is turned to the left, radians.
        told: whether the rig says so; then nothing is lost. Else beams are taken to go where they
            would without the turn.

    Raises:
        InputError: there is no 2D laser.
    """
    mount = _laser(source, "turn_laser")
    first, last, beams = mount.angles
    turned = Changed(source, "turned", lambda frame: frame)
    angles = (first - angle, last - angle, beams)
    # The same beams are said to be at other bearings of a laser that is turned.
    T = mount.T_body_lidar @ SE3(se3_exp([0, 0, 0, 0, 0, angle])) if told else mount.T_body_lidar
    turned.rig = _refitted(source, replace(mount, T_body_lidar=T, angles=angles))
    return turned


def widen(source: Source, factor: float) -> Source:
    """Let the rig be wrong about the field of view.

    Args:
        source: any source with a 2D laser.
        factor: on its angles.

    Raises:
        InputError: there is no 2D laser, or the factor is not above 0.
    """
    if not (np.isfinite(factor) and factor > 0):
        raise InputError(f"widen: factor {factor} must be finite and above 0")
    mount = _laser(source, "widen")
    first, last, beams = mount.angles
    widened = Changed(source, "widened", lambda frame: frame)
    widened.rig = _refitted(source, replace(mount, angles=(factor * first, factor * last, beams)))
    return widened


def slip(source: Source, frames: Iterable[int], *, factor: float = 3.0) -> Source:
    """Let wheels slip: they measure more or less than the body moves.

    Args:
        source: a source whose odometry is known as a whole (`odometry`).
        frames: ids of the frames whose step from the frame before is measured wrongly.
        factor: on the way and the turn of those steps: 3 for wheels that spin, 0 for wheels that
            are blocked.

    Raises:
        InputError: there is no odometry, or the factor is not finite.
    """
    odometry: Array | None = getattr(source, "odometry", None)
    if odometry is None:
        raise InputError(f"{source.name}: slip needs a source with odometry")
    if not np.isfinite(factor):
        raise InputError(f"slip: factor {factor} must be finite")
    slipped = _slipped(odometry, frozenset(frames), factor)

    def change(frame: Frame) -> Frame:
        return frame if frame.odometry is None else replace(frame, odometry=slipped[frame.id])

    return Changed(source, "wheels slip", change)


def _slipped(odometry: Array, frames: frozenset[int], factor: float) -> Array:
    """Return odometry put together again with some of its steps times a factor."""
    poses = odometry.copy()
    for k in range(1, len(poses)):
        step = se3_inverse(odometry[k - 1]) @ odometry[k]
        if k in frames:
            turn = factor * np.arctan2(step[1, 0], step[0, 0])
            step[:3, 3] *= factor
            step[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        poses[k] = poses[k - 1] @ step
    poses.setflags(write=False)
    return poses


def set_back(source: Source, frames: Iterable[int], *, by_s: float = 0.5) -> Source:
    """Let the clock be behind in some frames, so that stamps go back.

    Args:
        source: any source.
        frames: ids of the frames.
        by_s: by how much, seconds.

    Raises:
        InputError: that is not finite.
    """
    if not np.isfinite(by_s):
        raise InputError(f"set_back: by_s {by_s} must be finite")
    chosen, back = frozenset(frames), round(by_s * 1e9)

    def change(frame: Frame) -> Frame:
        behind = back if frame.id in chosen else 0
        return replace(frame, stamp_ns=frame.stamp_ns - behind)

    late = Changed(source, "set back", change)
    if isinstance(source, RandomAccess):
        behind = np.isin(late.ids, sorted(chosen))
        late.stamps_ns = source.stamps_ns - back * behind
    return late


def _laser(source: Source, who: str) -> LidarMount:
    """Return the 2D laser of a source."""
    for mount in source.rig.lidars:
        if mount.angles[2]:
            return mount
    raise InputError(f"{source.name}: {who} needs a rig with a 2D laser")


def _refitted(source: Source, mount: LidarMount) -> Rig:
    """Return the rig of a source with its laser mounted otherwise."""
    lidars = tuple(mount if m.name == mount.name else m for m in source.rig.lidars)
    return replace(source.rig, lidars=lidars)
