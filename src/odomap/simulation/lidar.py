"""What laser scanners say: 2D scans and 3D sweeps, each beam at its own time along the path.

A beam leaves the moving sensor at T_world_lidar(t) in direction d and comes back from the nearest
surface at range r, measured with noise that grows a little with range, n ~ N(0, σ(1 + r/50 m)).
Beams are lost now and then, more often on dark surfaces and at grazing incidence; a beam that meets
nothing within reach does not return (inf in a scan, no point in a cloud). During a sweep the sensor
moves: points are given in the frame of their own moment, as a real sweep holds them, with that
moment beside them. A beam half on an edge may return a range between the two surfaces.

Cost: O(beams · log N).

Paper: S. Thrun, W. Burgard and D. Fox, "Probabilistic robotics", 2005, ch. 6 (beam models).
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep
from odomap.simulation.path import Path
from odomap.simulation.rays import cast_kernel
from odomap.simulation.scene import Scene

__all__ = ["RINGS", "LidarNoise", "scan", "sweep"]

Array = NDArray[np.float64]

RINGS = 32
"""Beams above each other, where nothing else is said."""


@dataclass(frozen=True)
class LidarNoise:
    """How imperfect a scanner is."""

    range_m: float = 0.01
    """Standard deviation of a range near by, metres."""
    dropout: float = 0.01
    """Share of beams lost at random; grazing ones are lost more often."""
    mixed: float = 0.3
    """Share of beams on an edge that return a range between both surfaces."""
    divergence: float = 0.0015
    """Half the angle a beam spreads over, radians."""

    def scaled(self, factor: float) -> "LidarNoise":
        """Return a scanner with all imperfections times a factor."""
        return LidarNoise(**{f.name: factor * getattr(self, f.name) for f in fields(self)})

    @classmethod
    def none(cls) -> "LidarNoise":
        """Return an exact scanner."""
        return cls(0.0, 0.0, 0.0, 0.0)


def scan(
    scene: Scene, path: Path, mount: LidarMount, time: float, noise: LidarNoise,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Take one 2D scan at one instant.

    Args:
        scene: what is there.
        path: of the body.
        mount: with its first angle, last angle and number of beams, in its x-y plane.
        time: of the scan, seconds.
        noise: how imperfect it is.
        rng: where the noise comes from.

    Returns:
        (N,) ranges in metres, NaN where the beam was lost, inf where nothing returned.
    """
    first, last, beams = mount.angles
    angles = np.linspace(first, last, beams)
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(beams)])
    return _ranges(scene, path, mount, np.full(beams, time), directions, noise, rng)


def sweep(
    scene: Scene, path: Path, mount: LidarMount, time: float, noise: LidarNoise,
    rng: np.random.Generator, *, rings: int = RINGS, columns: int = 900,
    elevations_deg: tuple[float, float] = (-25.0, 10.0),
) -> Sweep:  # fmt: skip
    """Take one 3D sweep that starts at a time.

    Args:
        scene: what is there.
        path: of the body.
        mount: which way it turns; with sweep "none" all beams leave at once.
        time: start of the sweep, seconds.
        noise: how imperfect it is.
        rng: where the noise comes from.
        rings: beams above each other.
        columns: directions per turn.
        elevations_deg: lowest and highest beam.

    Returns:
        What returned, with times since `time` and beams.
    """
    turn = {"clockwise": -1.0, "counter_clockwise": 1.0, "none": 1.0}[mount.sweep]
    share = np.repeat(np.arange(columns) / columns, rings)
    azimuth = np.pi + turn * 2 * np.pi * share
    beams = np.tile(np.arange(rings, dtype=np.int16), columns)
    elevation = np.radians(np.linspace(*elevations_deg, rings))[beams]
    directions = np.column_stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    delays = np.zeros(len(share)) if mount.sweep == "none" else share / mount.rate_hz
    ranges = _ranges(scene, path, mount, time + delays, directions, noise, rng)
    kept = np.isfinite(ranges)
    return Sweep(directions[kept] * ranges[kept, None], delays[kept], None, beams[kept])


def _ranges(
    scene: Scene, path: Path, mount: LidarMount, times: Array, directions: Array,
    noise: LidarNoise, rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Return (N,) measured ranges of beams (N, 3) in the LiDAR, each at its own time."""
    steps, which = np.unique(times, return_inverse=True)
    Ts_world_lidar = path.at(steps).Ts_world_body @ mount.T_body_lidar.matrix
    moved = Ts_world_lidar[which]
    rays = np.einsum("nij,nj->ni", moved[:, :3, :3], directions)
    ranges, who = _cast(scene, times, moved[:, :3, 3], rays, mount.range_m[1])
    beside, _ = _beside(scene, times, moved[:, :3, 3], rays, mount.range_m[1], noise, rng)
    split = (np.abs(beside - ranges) > 0.1) & (who >= 0) & np.isfinite(beside)
    split &= rng.random(len(ranges)) < noise.mixed
    weight = rng.random(len(ranges))
    measured = np.where(split, weight * ranges + (1 - weight) * beside, ranges)
    spread = noise.range_m * (1.0 + measured / 50.0)
    measured = measured + np.where(who >= 0, spread, 0.0) * rng.standard_normal(len(ranges))
    lost = rng.random(len(ranges)) < noise.dropout * (
        1.0 + 4.0 * (_grazing(scene, who, rays) < 0.1)
    )
    measured[who < 0] = np.inf
    measured[(lost & (who >= 0)) | (measured < mount.range_m[0])] = np.nan
    return measured


def _beside(
    scene: Scene, times: Array, origins: Array, rays: Array, farthest: float, noise: LidarNoise,
    rng: np.random.Generator,
) -> tuple[Array, NDArray[np.int64]]:  # fmt: skip
    """Cast each beam once more at its rim; infinite where mixing is off."""
    if noise.mixed <= 0 or noise.divergence <= 0:
        return np.full(len(rays), np.inf), np.full(len(rays), -1)
    rim = rays + noise.divergence * rng.standard_normal(rays.shape)
    rim /= np.linalg.norm(rim, axis=1, keepdims=True)
    ranges, who = _cast(scene, times, origins, rim, farthest)
    return np.where(who >= 0, ranges, np.inf), who


def _cast(
    scene: Scene, times: Array, origins: Array, rays: Array, farthest: float
) -> tuple[Array, NDArray[np.int64]]:
    """Return true ranges (N,) and who was hit (N,)."""
    start = float(times[0]) if len(times) else 0.0
    frames, (rows, velocities) = scene.frames_at(start), scene.moving(start)
    distance, hit = np.empty(len(rays)), np.empty(len(rays), np.int64)
    tree = scene.tree
    cast_kernel(
        np.ascontiguousarray(origins), np.ascontiguousarray(rays), times - start, farthest,
        frames, scene.rectangles.faces, tree.boxes, tree.nodes, tree.order, rows, velocities,
        distance, hit,
    )  # fmt: skip
    return distance, hit


def _grazing(scene: Scene, who: NDArray[np.int64], rays: Array) -> Array:
    """Return (N,) cosines between the beams and the surfaces they met (as they stand at start)."""
    f = scene.rectangles.frames[np.maximum(who, 0)]
    cosine: Array = np.abs((np.cross(f[:, 3:6], f[:, 6:9]) * rays).sum(1))
    return cosine
