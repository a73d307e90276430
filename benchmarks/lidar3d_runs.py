"""What runs over recordings and worlds of 3D LiDARs give (`lidar3d.py`)."""

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lidar3d_odometry import Played, config_of, played, without_times
from loopcases import end_error
from numpy.typing import NDArray

from odomap.evaluation.consistency import consistency
from odomap.evaluation.match import match
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.geometry.trajectory import Trajectory
from odomap.lidar.frontend import FrontEnd, SweepMatch
from odomap.lidar.sweeps import SweepPoints
from odomap.maps.map import Map
from odomap.sources.disturb import there_and_back
from odomap.sources.open import open as open_source
from odomap.sources.source import Source
from odomap.sources.wrappers import Changed
from odomap.system.cloudslam import CloudSlam
from odomap.system.slam import Slam

Array = NDArray[np.float64]

REMEMBERED = 3
"""Sweeps that odometry knows of where the older map is hidden from it."""
CELL_M, FEWEST, WIDE_M, THIN_M = 1.0, 12, 0.15, 0.04
"""Cells in which planes are looked for; how many points make one, how wide they lie, and how far
off it at most, standard deviations of a single sweep."""
ALIKE = 0.95
"""How much of what sweeps say of a plane's normal must be the same."""
DENSELY = (("cloud_tracking.keyframe_voxel", "0.1"), ("cloud_tracking.keyframe_m", "1.0"))
"""Keyframes that keep so many points that each shows planes by itself."""
ACROSS = np.cos(np.radians(45.0))
"""From which on the normal of a surface points along the way."""


# ---- there and back ----


class LastSweeps:
    """A front-end that knows the last few sweeps only."""

    def __init__(self, inner: FrontEnd[Any], count: int = REMEMBERED) -> None:
        self._inner = inner
        self._last: deque[tuple[Any, Array, Array]] = deque(maxlen=count)

    def prepare(self, sweep: SweepPoints) -> Any:
        """Make a sweep ready."""
        return self._inner.prepare(sweep)

    def match(
        self, prepared: Any, T_map_body: Array, twist: Array, again: bool = False
    ) -> SweepMatch:
        """Lay a sweep onto the last ones."""
        return self._inner.match(prepared, T_map_body, twist, again)

    def insert(self, prepared: Any, T_map_body: Array, twist: Array) -> None:
        """Make the map anew of the last sweeps, and this one."""
        self._last.append((prepared, T_map_body, twist))
        self._inner.clear()
        for sweep in self._last:
            self._inner.insert(*sweep)

    def seed(self, points: Array) -> None:
        """Add points of another map."""
        self._inner.seed(points)

    def clear(self) -> None:
        """Forget all."""
        self._last.clear()
        self._inner.clear()


class Forgetful(CloudSlam):
    """A system whose odometry does not see the older map."""

    def _front_end(self) -> FrontEnd[Any]:
        return LastSweeps(super()._front_end())


@dataclass(frozen=True)
class Back:
    """A recording there and back, with and without loops.

    Attributes:
        loops: closed.
        refused: candidates that were not.
        lost: sweeps.
        end_m: error of the last pose seen from the first, by the recording's truth.
        apart_m: how far the last pose is from the way there, where that passed at the same instant
            of the recording: what loops can mend, and no GPS is in it.
        odometry_end_m: without loops.
        odometry_apart_m: likewise.
    """

    loops: int
    refused: int
    lost: int
    end_m: float
    apart_m: float
    odometry_end_m: float
    odometry_apart_m: float


def back(source: Source, front_end: str = "points") -> Back:
    """Play even sweeps forth and odd ones back."""
    both = there_and_back(source)
    assert both.truth is not None, f"{source.name}: has no truth"
    runs = [played(both, Forgetful(both.rig, config_of(front_end, on))) for on in (True, False)]
    paths = [run.result.trajectory for run in runs]
    errors = [
        error for path in paths for error in (end_error(path, both.truth, 1.0)[0], apart(path))
    ]
    first = runs[0]
    return Back(first.closed, len(first.loops) - first.closed, len(first.reasons), *errors)


def apart(path: Trajectory) -> float:
    """Return how far the last pose of a path there and back is from between the first two, m.

    The last sweep was taken midway between them in time, and a tenth of a second is too short for
    much else than going on evenly.
    """
    first, second, last = path.Ts_world_body[[0, 1, -1]]
    between = first @ se3_exp(0.5 * se3_log(se3_inverse(first) @ second))
    return float(np.linalg.norm(last[:3, 3] - between[:3, 3]))


# ---- deskewing ----


@dataclass(frozen=True)
class Deskewed:
    """What deskewing does to a map.

    Attributes:
        with_mm: how thick planes of the map are, median standard deviation.
        without_mm: the same of sweeps that were taken as if of one instant.
        across_with_mm: the same of planes across the way, along which sweeps are stretched.
        across_without_mm: likewise.
        motion_percent: median error of the motion over a sweep, of its length.
        length_percent: error of the length of the path, of that.
    """

    with_mm: float
    without_mm: float
    across_with_mm: float
    across_without_mm: float
    motion_percent: float
    length_percent: float


def deskewed(name: str | Path) -> Deskewed:
    """Map sweeps with and without times."""
    source = open_source(name)
    assert source.truth is not None, f"{source.name}: has no truth"
    runs = [
        played(each, Slam(each.rig, config_of("points", False, DENSELY)))
        for each in (source, Changed(source, "without times", without_times))
    ]
    (all_, across), (all_without, across_without) = (thickness(run.result.map) for run in runs)
    found = motion(runs[0].result.trajectory, source.truth)
    return Deskewed(all_, all_without, across, across_without, *found)


def thickness(map: Map) -> tuple[float, float]:
    """Return how thick planes are in the map, standard deviations, medians, mm.

    A plane is what in a cell is one in each of two sweeps or more, looked at alone: that does not
    depend on how they lie to each other. In the map it is as thick as all of them together.

    Returns:
        Of all planes, and of those that face the way on which they were seen.
    """
    keyframes = [(map.keyframe(k).cloud, map.T_world_body(k)) for k in map.keyframe_ids.tolist()]
    planes = [_planes(cloud, T) for cloud, T in keyframes if cloud is not None]
    cells, counts, means, spreads, ways = (np.concatenate(row) for row in zip(*planes, strict=True))
    _, of = np.unique(cells, axis=0, return_inverse=True)
    of = of.ravel()
    every = np.bincount(of, counts)
    off = means - (_sums(of, counts[:, None] * means) / every[:, None])[of]
    together = spreads + off[:, :, None] * off[:, None]
    together = _sums(of, (counts[:, None, None] * together).reshape(-1, 9)) / every[:, None]
    n = np.linalg.eigh(spreads)[1][:, :, 0]
    normals = _sums(of, (n[:, :, None] * n[:, None]).reshape(-1, 9)) / np.bincount(of)[:, None]
    shares, axes = np.linalg.eigh(normals.reshape(-1, 3, 3))
    n = axes[:, :, 2]
    thick = 1e3 * np.sqrt(np.einsum("ni,nij,nj->n", n, together.reshape(-1, 3, 3), n))
    is_plane = (np.bincount(of) >= 2) & (shares[:, 2] > ALIKE)
    ahead = _sums(of, ways) / np.bincount(of)[:, None]
    is_across = is_plane & (np.abs(np.einsum("ni,ni->n", n, ahead)) > ACROSS)
    return float(np.median(thick[is_plane])), float(np.median(thick[is_across]))


def _planes(
    cloud: NDArray[np.float32], T: Array
) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """Return the planes of a sweep: cells, numbers of points, means, spreads, and the way ahead."""
    points = cloud[:, :3] @ T[:3, :3].T + T[:3, 3]
    cells = np.floor(points / CELL_M).astype(np.int64)
    cells, of, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()
    means = _sums(of, points) / counts[:, None]
    off = points - means[of]
    spreads = _sums(of, (off[:, :, None] * off[:, None]).reshape(-1, 9)) / counts[:, None]
    spreads = spreads.reshape(-1, 3, 3)
    thin, wide, _ = np.linalg.eigvalsh(spreads).T
    kept = (counts >= FEWEST) & (thin < THIN_M**2) & (wide > WIDE_M**2)
    ways = np.broadcast_to(T[:3, 0], (int(kept.sum()), 3))
    return cells[kept], counts[kept].astype(float), means[kept], spreads[kept], ways


def _sums(of: NDArray[np.int64], rows: Array) -> Array:
    """Return the sum of the rows of each cell."""
    return np.stack([np.bincount(of, column) for column in rows.T], axis=1)


def motion(path: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return the errors of the motion from sweep to sweep and of the whole path, in percent."""
    pairs = match(path, truth)
    ours, true = (se3_inverse(Ts[:-1]) @ Ts[1:] for Ts in (pairs.Ts_estimate, pairs.Ts_reference))
    lengths = np.linalg.norm(true[:, :3, 3], axis=1)
    off = np.linalg.norm(ours[:, :3, 3] - true[:, :3, 3], axis=1)
    whole = np.linalg.norm(ours[:, :3, 3], axis=1).sum() / lengths.sum()
    return 100.0 * float(np.median(off / lengths)), 100.0 * abs(float(whole) - 1.0)


# ---- circuits ----


@dataclass(frozen=True)
class Circuit:
    """A street gone round once and a bit more.

    Attributes:
        path_m: true length.
        percent: ATE relative to the path.
        live_percent: the same of the poses as they were told when the sweeps came.
        nees: mean normalised error squared per degree of freedom.
        keyframes: at the end.
        loops: closed.
        refused: candidates that were not.
        lost: sweeps.
        ms: of a sweep, median.
        ms_p95: 95 of 100 are below.
        said: why sweeps were lost, how many of them, and the first of them.
    """

    path_m: float
    percent: float
    live_percent: float
    nees: float
    keyframes: int
    loops: int
    refused: int
    lost: int
    ms: float
    ms_p95: float
    said: list[str]


def circuit(name: str, front_end: str = "points") -> Circuit:
    """Go round a world."""
    source = open_source(name)
    assert source.truth is not None, f"{source.name}: has no truth"
    run = played(source, Slam(source.rig, config_of(front_end)))
    path = run.result.trajectory
    return Circuit(
        source.truth.path_length,
        ate(path, source.truth).percent,
        ate(run.result.trajectory_live, source.truth).percent,
        nees(path, source.truth),
        run.result.map.num_keyframes,
        run.closed,
        len(run.loops) - run.closed,
        len(run.reasons),
        float(np.median(run.ms)),
        float(np.percentile(run.ms, 95)),
        said(run),
    )


def nees(path: Trajectory, truth: Trajectory) -> float:
    """Return the mean normalised error squared per degree of freedom."""
    return consistency(path, truth).per_dof


def said(run: Played) -> list[str]:
    """Say why sweeps were lost, reasons that differ in numbers alone once."""
    alike: dict[str, list[int]] = {}
    for frame, reason in run.reasons.items():
        words = "".join("#" if c.isdigit() else c for c in reason)
        alike.setdefault(words, []).append(frame)
    return [f"{len(f)} from {f[0]} on: {run.reasons[f[0]]}" for f in alike.values()]
