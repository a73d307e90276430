"""Disturbances of 3D LiDARs: sweeps that say nothing, or not when, or too much, or something wrong.

What goes wrong with sweeps is mostly what is said beside the points: times in milliseconds that are
read as seconds, no times at all, a mount or a number of beams that is not what the rig says, points
that were compensated for motion by a driver which gives their times nevertheless. The last is made
of the truth, with the motion ξ from one stamp to the next,

    p' = exp(ξ t) p,   ξ = log(T_world_body(stamp)⁻¹ T_world_body(next)) / (next - stamp),

so that a point is where it would have been seen at the stamp.

Frames that are dropped or come twice, clocks that go back and recordings played there and back are
made as of any other sensor (`disturb`); backwards a point that came t after the stamp comes t
before it.

Reference: I. Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 8(2), 2023, section
III-A.
"""

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.geometry.pose import SE3
from odomap.lidar.deskew import deskew
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.sources.source import Source
from odomap.sources.wrappers import Changed

__all__ = [
    "compensate",
    "lose_sweeps",
    "miscount_beams",
    "misscale_times",
    "turn_lidar",
    "with_misses",
    "without_columns",
]

Array = NDArray[np.float64]
Loss = Literal["empty", "nan", "zero", "one"]
"""What a sweep without anything in it holds."""
COLUMNS = ("times", "intensities", "beams")


def lose_sweeps(source: Source, frames: Iterable[int], how: Loss = "empty") -> Source:
    """Let sweeps say nothing.

    Args:
        source: any source with a 3D LiDAR.
        frames: ids of the frames.
        how: no points at all ("empty"), all NaN ("nan"), all zero ("zero"), or a single point
            ("one").

    Raises:
        InputError: there is no 3D LiDAR, or no such way.
    """
    if how not in ("empty", "nan", "zero", "one"):
        raise InputError(f"lose_sweeps: how '{how}' is none of empty, nan, zero, one")
    _lidar(source, "lose_sweeps")
    chosen = frozenset(frames)

    def change(frame: Frame) -> Frame:
        sweep = frame.cloud
        if frame.id not in chosen or sweep is None:
            return frame
        if how in ("empty", "one"):
            middle = len(sweep) // 2
            rows = np.arange(len(sweep))[middle : middle + (how == "one")]
            return replace(frame, cloud=sweep.only(rows))
        points = np.full_like(sweep.points, np.nan if how == "nan" else 0.0)
        return replace(frame, cloud=replace(sweep, points=points))

    return Changed(source, f"{how} sweeps", change)


def with_misses(source: Source, *, share: float = 0.3, value: float = 0.0, seed: int = 0) -> Source:
    """Give rows for beams that did not return, too, as drivers of organised clouds do.

    Args:
        source: any source with a 3D LiDAR.
        share: share of the rows that are misses, from 0 to below 1. They stand between the others,
            in runs as the sky has them, with the time and the beam of the row before.
        value: what stands in their points: zero or NaN.
        seed: of where they are.

    Raises:
        InputError: there is no 3D LiDAR, or the share is not from 0 to below 1.
    """
    if not 0 <= share < 1:
        raise InputError(f"with_misses: share {share} must be from 0 to below 1")
    _lidar(source, "with_misses")

    def change(frame: Frame) -> Frame:
        sweep = frame.cloud
        if sweep is None or not len(sweep):
            return frame
        rng = np.random.default_rng((seed, frame.id, 71))
        runs = max(1, len(sweep) // 100)
        count = round(len(sweep) * share / (1 - share))
        lengths = rng.multinomial(count, np.full(runs, 1 / runs))
        times = np.ones(len(sweep), np.int64)
        np.add.at(times, rng.integers(0, len(sweep), runs), lengths)
        rows = np.repeat(np.arange(len(sweep)), times)
        padded = sweep.only(rows)
        points = padded.points.copy()
        points[np.diff(rows, prepend=-1) == 0] = value
        return replace(frame, cloud=replace(padded, points=points))

    return Changed(source, "with misses", change)


def turn_lidar(source: Source, R_lidar_turned: Array, *, told: bool = False) -> Source:
    """Mount the LiDAR turned.

    Args:
        source: any source with a 3D LiDAR.
        R_lidar_turned: (3, 3) axes of the turned LiDAR in those of the LiDAR as it was.
        told: whether the rig says so; then nothing is lost.

    Raises:
        InputError: there is no 3D LiDAR, or that is no rotation.
    """
    mount = _lidar(source, "turn_lidar")
    R = np.asarray(R_lidar_turned, np.float64)
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3)) or np.linalg.det(R) < 0:
        raise InputError("turn_lidar: R_lidar_turned must be a rotation, (3, 3)")

    def change(frame: Frame) -> Frame:
        if frame.cloud is None:
            return frame
        return replace(frame, cloud=replace(frame.cloud, points=frame.cloud.points @ R))

    turned = Changed(source, "turned", change)
    if told:
        T = mount.T_body_lidar @ SE3.from_parts(R, np.zeros(3))
        turned.rig = _refitted(source, replace(mount, T_body_lidar=T))
    return turned


def miscount_beams(source: Source, beams: int) -> Source:
    """Let the rig be wrong about how many beams are above each other.

    Args:
        source: any source with a 3D LiDAR.
        beams: what the rig says; sweeps say what they said.

    Raises:
        InputError: there is no 3D LiDAR, or it cannot have so many.
    """
    mount = _lidar(source, "miscount_beams")
    if not 0 <= beams <= 1024:
        raise InputError(f"miscount_beams: beams {beams} must be from 0 to 1024")
    wrong = Changed(source, f"{beams} beams", lambda frame: frame)
    wrong.rig = _refitted(source, replace(mount, beams=beams))
    return wrong


def misscale_times(source: Source, factor: float) -> Source:
    """Let times within a sweep be in a wrong unit.

    Args:
        source: any source with a 3D LiDAR.
        factor: on them: 1e3 for milliseconds that are taken for seconds.

    Raises:
        InputError: there is no 3D LiDAR, or the factor is not finite.
    """
    if not np.isfinite(factor):
        raise InputError(f"misscale_times: factor {factor} must be finite")
    _lidar(source, "misscale_times")

    def change(frame: Frame) -> Frame:
        sweep = frame.cloud
        if sweep is None or sweep.times is None:
            return frame
        return replace(frame, cloud=replace(sweep, times=factor * sweep.times))

    return Changed(source, f"times x {factor:g}", change)


def without_columns(source: Source, columns: Collection[str] = ("times",)) -> Source:
    """Let sweeps be of points alone, or without some of what else is said of them.

    Args:
        source: any source with a 3D LiDAR.
        columns: what goes, of "times", "intensities" and "beams".

    Raises:
        InputError: there is no 3D LiDAR, or no such column.
    """
    for name in columns:
        if name not in COLUMNS:
            raise InputError(f"without_columns: '{name}' is none of {', '.join(COLUMNS)}")
    _lidar(source, "without_columns")

    def change(frame: Frame) -> Frame:
        sweep = frame.cloud
        if sweep is None:
            return frame
        kept = {name: getattr(sweep, name) for name in COLUMNS if name not in columns}
        return replace(frame, cloud=Sweep(sweep.points, **kept))

    return Changed(source, f"without {' and '.join(columns)}", change)


def compensate(source: Source, *, keep_times: bool = False) -> Source:
    """Take the motion out of the sweeps beforehand, as some drivers and data sets do.

    Args:
        source: with a 3D LiDAR and truth, whose motion from stamp to stamp is taken.
        keep_times: whether the points keep the times they had, which invites to take the motion
            out once more.

    Raises:
        InputError: there is no 3D LiDAR, or no truth.
    """
    mount = _lidar(source, "compensate")
    truth = source.truth
    if truth is None or len(truth.stamps_ns) < 2:
        raise InputError(f"{source.name}: compensate needs a source with truth")
    stamps, Ts = truth.stamps_ns, truth.Ts_world_body
    T_body_lidar, T_lidar_body = mount.T_body_lidar, mount.T_body_lidar.inverse()

    def change(frame: Frame) -> Frame:
        sweep = frame.cloud
        if sweep is None or sweep.times is None:
            return frame
        # The motion to the next stamp; of the last frame that from the one before.
        k = int(np.searchsorted(stamps, frame.stamp_ns, side="right")) - 1
        k = min(max(k, 0), len(stamps) - 2)
        seconds = float(stamps[k + 1] - stamps[k]) * 1e-9
        twist = se3_log(se3_inverse(Ts[k]) @ Ts[k + 1]) / seconds
        points = T_lidar_body @ deskew(T_body_lidar @ sweep.points, sweep.times, twist)
        times = sweep.times if keep_times else None
        return replace(frame, cloud=replace(sweep, points=points, times=times))

    compensated = Changed(source, "compensated", change)
    if not keep_times:
        compensated.rig = _refitted(source, replace(mount, sweep="none"))
    return compensated


def _lidar(source: Source, who: str) -> LidarMount:
    """Return the 3D LiDAR of a source."""
    for mount in source.rig.lidars:
        if not mount.angles[2]:
            return mount
    raise InputError(f"{source.name}: {who} needs a rig with a 3D LiDAR")


def _refitted(source: Source, mount: LidarMount) -> Rig:
    """Return the rig of a source with its LiDAR mounted otherwise; the body stays what it is."""
    rig = source.rig
    lidars = tuple(mount if m.name == mount.name else m for m in rig.lidars)
    body = rig.body
    if body == mount.name and not np.allclose(mount.T_body_lidar.matrix, np.eye(4)):
        body = ""
    return replace(rig, lidars=lidars, body=body)
