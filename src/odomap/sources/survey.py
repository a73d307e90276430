"""Surveys: what the sweeps of a recording are like, from a few of them.

Points, range and field of view are those of up to eight sweeps, evenly spaced: enough to tell a
sensor, and to make its mount where no rig.yaml does. Nothing that differs from sweep to sweep (the
beams of one, its times) is taken from there without a look at each.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.sensors.rig import LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.sources.source import RandomAccess, UnusableFrame

__all__ = ["SweepSurvey", "mounted_sweeps", "sample", "survey", "survey_frames"]

Read = TypeVar("Read")

SAMPLES, FEW_SAMPLES = 8, 2
NEAR_M, FAR_M = 0.5, 120.0
"""Range of a LiDAR of which nothing is said: nearer is its carrier."""
STRAY = 3.0
"""What is so many times as far as all but a hundredth of a usual sweep was never measured."""
MOST_WRONG = 0.75
"""A rig with so few of the beams, or so many more, is that of another sensor."""


@dataclass(frozen=True)
class SweepSurvey:
    """What sweeps are like.

    Attributes:
        rows: fewest, usual and most rows of a sweep.
        share_lost: share of rows that are NaN or zero.
        range_m: nearest and farthest point.
        reach_m: how far the sensor sees: to the farthest point, unless that is a stray one.
        elevation: lowest and highest point, radians; all but a thousandth of the points.
        view: how much of a turn is seen, radians.
        times: how it is known when each point was measured; empty if it is not.
        span_s: shortest to longest time since the stamp.
        beams: beams above each other, 0 if not known.
        beams_how: how they are told apart.
        intensities: smallest and largest, or None.
    """

    rows: tuple[int, int, int] = (0, 0, 0)
    share_lost: float = 0.0
    range_m: tuple[float, float] = (0.0, 0.0)
    reach_m: float = 0.0
    elevation: tuple[float, float] = (0.0, 0.0)
    view: float = 0.0
    times: str = ""
    span_s: tuple[float, float] = (0.0, 0.0)
    beams: int = 0
    beams_how: str = ""
    intensities: tuple[float, float] | None = None


def sample(count: int, read: Callable[[int], Read], most: int = SAMPLES) -> list[Read]:
    """Read some sweeps of a recording, evenly spaced; those that cannot be read are left out.

    Args:
        count: how many there are.
        read: reads one.
        most: how many to read.
    """
    sweeps = []
    for index in np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)):
        try:
            sweeps.append(read(int(index)))
        except UnusableFrame:  # is said when it is its turn
            continue
    return sweeps


def survey(sweeps: Sequence[Sweep], times: str = "", beams: int = 0, how: str = "") -> SweepSurvey:
    """Look at some sweeps.

    Args:
        sweeps: with times, beams and intensities where a recording has them.
        times: how times are known.
        beams: how many there are.
        how: how they are known.
    """
    if not sweeps:
        return SweepSurvey(times=times, beams=beams, beams_how=how)
    rows = np.array([len(sweep) for sweep in sweeps])
    points = np.concatenate([sweep.points for sweep in sweeps])
    distance = np.linalg.norm(points, axis=1)
    seen = np.isfinite(distance) & (distance > 0)
    facts = SweepSurvey(
        (int(rows.min()), int(np.median(rows)), int(rows.max())),
        float(1 - seen.mean()) if len(seen) else 0.0,
        times=times,
        beams=beams,
        beams_how=how,
        intensities=_span([s.intensities for s in sweeps if s.intensities is not None]),
        span_s=_span([s.times for s in sweeps if s.times is not None]) or (0.0, 0.0),
    )
    if not seen.any():
        return facts
    ends = np.cumsum(rows)[:-1]
    each = zip(np.split(distance, ends), np.split(seen, ends), strict=True)
    reach = _reach([far[is_seen] for far, is_seen in each])
    points, distance = points[seen], distance[seen]
    elevation = np.arcsin(np.clip(points[:, 2] / distance, -1, 1))
    low, high = np.quantile(elevation, [0.0005, 0.9995]).tolist()
    return replace(
        facts,
        range_m=(float(distance.min()), float(distance.max())),
        reach_m=reach,
        elevation=(low, high),
        view=_view(np.arctan2(points[:, 1], points[:, 0])),
    )


def survey_frames(source: RandomAccess) -> SweepSurvey:
    """Look at two sweeps of a source that has made no survey itself."""
    frames = sample(len(source), source.frame, FEW_SAMPLES)
    sweeps = [frame.cloud for frame in frames if frame.cloud is not None]
    has_times = any(sweep.times is not None for sweep in sweeps)
    beams = max(
        (int(s.beams.max()) + 1 for s in sweeps if s.beams is not None and len(s)), default=0
    )
    is_above = any(mount.beams for mount in source.rig.lidars)
    how = "in the sweeps" + ("" if is_above else "; not above each other")
    return survey(sweeps, "in the sweeps" if has_times else "", beams, how if beams else "")


def _reach(distances: Sequence[NDArray[np.float64]]) -> float:
    """Return the farthest of the distances (N,) of each sweep, but for stray ones."""
    usual = np.median([np.quantile(some, 0.99) for some in distances if len(some)])
    every = np.concatenate(distances)
    return float(every[every <= STRAY * usual].max())


def _span(columns: Sequence[NDArray[np.floating]]) -> tuple[float, float] | None:
    """Return smallest and largest of all numbers, None if there is no column."""
    if not columns:
        return None
    values = np.concatenate(columns)
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)


def _view(azimuth: NDArray[np.float64]) -> float:
    """Return what is left of a turn without its largest gap; to a degree."""
    degrees = np.unique(np.floor(np.degrees(azimuth)).astype(int) % 360)
    gaps = np.diff(np.r_[degrees, degrees[0] + 360]) - 1
    return float(np.radians(360 - gaps.max()))


def mounted_sweeps(mount: LidarMount, rig: Rig | None, facts: SweepSurvey, where: Path) -> Rig:
    """Return the rig of one 3D LiDAR: what a recording says of it, or what a given rig does.

    Args:
        mount: name, place, rate and sweep as the recording has them.
        rig: a rig with one 3D LiDAR, or None.
        facts: what sweeps are like.
        where: the recording.

    Raises:
        CalibrationError: the rig has not one LiDAR, a 2D one, or one with other beams.
    """
    if rig is None:
        near, far = mount.range_m
        reach = (near, max(far, float(np.ceil(facts.reach_m))))
        return Rig(lidars=(replace(mount, range_m=reach, beams=facts.beams),))
    if len(rig.lidars) != 1:
        raise CalibrationError(
            f"{where}: is of one LiDAR, but the rig has {len(rig.lidars)}: list that one"
        )
    given = rig.lidars[0]
    if given.angles[2]:
        raise CalibrationError(
            f"{where}: holds 3D sweeps, the rig's '{given.name}' is a 2D laser: leave out 'angles'"
        )
    low, high = sorted((given.beams, facts.beams))
    if low and (facts.beams > given.beams or low < MOST_WRONG * high):
        raise CalibrationError(
            f"{where}: sweeps have {facts.beams} beams, the rig says {given.beams}: mend 'beams'"
        )
    given = replace(
        given,
        beams=given.beams or facts.beams,
        rate_hz=mount.rate_hz,
        sweep=mount.sweep if given.sweep == "none" else given.sweep,
    )
    return Rig(lidars=(given,), body=rig.body if rig.body == given.name else "")
