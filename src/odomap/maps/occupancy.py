"""Occupancy grids of maps: made from what keyframes saw, at where they are now.

    grid = occupancy_grid(map, rig)

A grid is a view of a map, as all that is dense: evidence that was laid into cells cannot be moved
when a loop corrects the path, but scans can be laid into new cells, in a second per thousand. Each
keyframe is one scan. A 2D scan is laid at T_world_body, of which the plane keeps x, y and heading;
a 3D sweep or a depth image is sliced (`lidar/slices`): heights are above a floor, which is a plane

    of the world (up = "gravity"): one for all keyframes, for sensors held by hand as well;
    of the body (up = "body"):     what stands on wheels takes its floor with it, up a ramp;

or, of clouds, the ground as it rises and falls (up = "ground", `lidar/terrain`), which is taken too
where gravity is asked for and one plane is not the floor of all: streets are not level.

Upwards is z of the world, or, where the body is a camera, away from its image's lower border, on
average; the plane is found in the points themselves. x and y of the grid are the world's, where the
world is level to ten degrees; where not, it is turned as little as needed.

Cost: 1 ms per scan of 360 beams at most, some 3 ms per 20,000 points.

Reference: W. Hess et al., "Real-time loop closure in 2D LIDAR SLAM", ICRA 2016 (grids re-made from
scans after a loop).
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from odomap.errors import ConfigError, InputError
from odomap.lidar.grid import Evidence, OccupancyGrid
from odomap.lidar.scanconfig import ScanConfig
from odomap.lidar.scans import Beams
from odomap.lidar.slices import SliceConfig, find_floor, level, slice_sweep
from odomap.lidar.terrain import Terrain, terrain_of
from odomap.limits import Positive, check_limits
from odomap.maps.atlas import Atlas
from odomap.maps.map import Map
from odomap.sensors.rig import LidarMount, Rig

__all__ = [
    "LOOKED_AT",
    "GridConfig",
    "GridMap",
    "Sweep",
    "grid_of_map",
    "grid_of_sweeps",
    "occupancy_grid",
    "upwards",
]

Array = NDArray[np.float64]

UPS = ("gravity", "body", "ground")
LEVEL = np.cos(np.deg2rad(10.0))
LOOKED_AT, POINTS_EACH = 24, 1000
"""Sweeps in which the floor is looked for, and points of each."""
LOWEST = 0.02
"""Share of the points below the floor where no plane is found."""
RISES = "the ground is not one plane: heights are counted from the lowest points around"


@dataclass(frozen=True)
class GridConfig:
    """How a grid is made from keyframes."""

    resolution: Positive = 0.05
    """Size of a cell, metres."""
    evidence: Evidence = field(default_factory=Evidence)
    """What a beam says."""
    scan: ScanConfig = field(default_factory=ScanConfig)
    """What of a 2D scan is used."""
    slice: SliceConfig = field(default_factory=SliceConfig)
    """What of a cloud is in the way."""
    up: str = "gravity"
    """What heights are counted from and along: a floor, "gravity" or "body", or "ground" that rises
    and falls."""
    floor: float | None = None
    """How far it is below the sensor, in the middle of all, metres; None looks for it in the points
    seen. To be given where a table is seen and the floor under it is not; not for "ground"."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.up not in UPS:
            raise ConfigError(f"up: '{self.up}' is none of {', '.join(UPS)}")
        if self.floor is not None and not np.isfinite(self.floor):
            raise ConfigError(f"floor: {self.floor} must be a finite number")


@dataclass(frozen=True, eq=False)
class Sweep:
    """What one keyframe saw of space.

    Attributes:
        T_world_body: (4, 4) where it is.
        eye_body: (3,) where the sensor is on the body.
        points_body: (N, 3) finite points, metres.
    """

    T_world_body: Array
    eye_body: Array
    points_body: Array


@dataclass(frozen=True, eq=False)
class GridMap:
    """A grid, and what it was made of.

    Attributes:
        grid: the cells.
        T_grid_world: (4, 4) whose x and y are those of the grid; z is the height above the floor
            where heights are counted along gravity.
        path: (K, 2) where the keyframes are in it, in order.
        made_of: "scans", "clouds" or "depth".
        notes: what a person should know, one sentence each.
    """

    grid: OccupancyGrid
    T_grid_world: Array
    path: Array
    made_of: str
    notes: tuple[str, ...] = ()


def occupancy_grid(
    map: Map, rig: Rig, resolution: float = 0.05, config: GridConfig | None = None
) -> OccupancyGrid:
    """Make a grid from the scans or clouds of a map's keyframes, at their poses of now.

    Args:
        map: what is remembered.
        rig: the sensors it was made with.
        resolution: size of a cell, metres.
        config: how; its resolution is not used.

    Raises:
        InputError: no keyframe has a scan or a cloud, or the rig has no such sensor.

    Example:
        >>> grid = occupancy_grid(load_map("map.odomap"), rig)  # doctest: +SKIP
    """
    config = replace(config or GridConfig(), resolution=resolution)
    return grid_of_map(map, rig, config).grid


def grid_of_map(map: Map, rig: Rig, config: GridConfig | None = None) -> GridMap:
    """Make a grid as `occupancy_grid` does, and say where its keyframes are in it.

    Of a map with 2D scans and with clouds the scans are used: nothing need be known of a floor. Of
    a map in pieces, whose places to each other are not known, the largest is shown.
    """
    config = GridConfig() if config is None else config
    pieces = Atlas(map).pieces
    largest = max(pieces, key=lambda piece: len(piece.keyframe_ids), default=None)
    made = _grid_of_piece(map, rig, config, None if largest is None else largest.keyframe_ids)
    if len(pieces) < 2 or largest is None:
        return made
    count, share = len(pieces), len(largest.keyframe_ids) / map.num_keyframes
    note = f"the map is in {count} pieces, not known to each other: {share:.0%} of it are shown"
    return replace(made, notes=(*made.notes, note))


def _grid_of_piece(
    map: Map, rig: Rig, config: GridConfig, keyframe_ids: NDArray[np.int64] | None
) -> GridMap:
    """Make a grid from some keyframes, as far as they live."""
    with map.lock:
        ids = map.keyframe_ids
        ids = ids if keyframe_ids is None else ids[np.isin(ids, keyframe_ids)]
        Ts = np.asarray(map.Ts_world_body(ids)) if len(ids) else np.zeros((0, 4, 4))
        keyframes = [map.keyframe(k) for k in ids.tolist()]
    scans = [(T, k.scan) for T, k in zip(Ts, keyframes) if k.scan is not None]
    if scans:
        return _grid_of_scans(scans, _mount(rig, "2D"), config)
    clouds = [(T, k.cloud) for T, k in zip(Ts, keyframes) if k.cloud is not None]
    if not clouds:
        raise InputError(
            "the map holds neither scans nor clouds: a grid is made from those of a LiDAR, or from "
            "depth with the folder of a run"
        )
    mount = _mount(rig, "3D")
    T_body_lidar = mount.T_body_lidar.matrix

    def sweeps() -> Iterator[Sweep]:
        for T, cloud in clouds:
            points = cloud[np.isfinite(cloud[:, :3]).all(axis=1), :3]
            yield Sweep(
                T, T_body_lidar[:3, 3], points @ T_body_lidar[:3, :3].T + T_body_lidar[:3, 3]
            )

    return grid_of_sweeps(sweeps, upwards(rig), config, "clouds")


def _mount(rig: Rig, kind: str) -> LidarMount:
    for mount in rig.lidars:
        if (mount.angles[2] > 0) == (kind == "2D"):
            return mount
    raise InputError(f"the rig has no {kind} LiDAR, of which the map holds what it saw")


def _grid_of_scans(
    scans: list[tuple[Array, Array]], mount: LidarMount, config: GridConfig
) -> GridMap:
    grid, beams = OccupancyGrid(config.resolution, config.evidence), Beams(mount, config.scan)
    for T, ranges in scans:
        if len(ranges) != len(beams):
            raise InputError(
                f"a scan of the map has {len(ranges)} beams, '{mount.name}' of the rig has "
                f"{len(beams)}: give the rig that the map was made with"
            )
        seen = beams.rays(ranges)
        R, t = T[:2, :2].T, T[:2, 3]
        parts = {"between": seen.between @ R + t, "free": seen.free @ R + t}
        grid.insert(seen.origin @ R + t, seen.hits @ R + t, **parts)
    path = np.array([T[:2, 3] for T, _ in scans])
    return GridMap(grid, np.eye(4), path, "scans")


def upwards(rig: Rig) -> Array:
    """Return which direction (3,) of the body is up, of unit length, by how sensors are held.

    Bodies have z up, but one that is a camera, or an IMU mounted anyhow beside one, does not.
    """
    body = rig.body_sensor
    cameras = {mount.name: mount for mount in rig.cameras}
    if body in cameras or (body == "imu" and cameras):
        mount = cameras.get(body, rig.cameras[0])
        return np.asarray(-mount.T_body_camera.matrix[:3, 1])
    if body == "imu" and rig.lidars:
        return np.asarray(rig.lidars[0].T_body_lidar.matrix[:3, 2])
    return np.array([0.0, 0.0, 1.0])


def grid_of_sweeps(
    sweeps: Callable[[], Iterable[Sweep]],
    up_body: Array,
    config: GridConfig | None = None,
    made_of: str = "depth",
    some: Iterable[Sweep] | None = None,
) -> GridMap:
    """Make a grid by slicing what was seen in space.

    Args:
        sweeps: gives all of them.
        up_body: (3,) which direction of the body is up, by and large.
        config: how.
        made_of: what they are, for people.
        some: those in which the floor is looked for; by default all are given twice.

    Raises:
        InputError: there is none, or none with a point.
    """
    config = GridConfig() if config is None else config
    ground, notes = _find_ground(sweeps() if some is None else some, up_body, config)
    if config.up == "ground" or (ground.is_guessed and made_of == "clouds"):
        ground, notes = _with_terrain(ground, sweeps, config.slice.farthest), (RISES,)
    grid = OccupancyGrid(config.resolution, config.evidence)
    path = []
    for sweep in sweeps():
        points, eye = ground.above(sweep, sweep.points_body), ground.above(sweep, sweep.eye_body)
        found = slice_sweep(points, eye, config.slice)
        grid.insert(eye[:2], found.hits[:0], between=found.hits, free=found.free,
                    free_from=found.free_from)  # fmt: skip
        path.append(ground.above(sweep, np.zeros(3))[:2])
    return GridMap(grid, ground.T_level_world, np.array(path), made_of, notes)


@dataclass(frozen=True, eq=False)
class _Ground:
    """What heights are counted from.

    Attributes:
        T_level_world: (4, 4) whose x and y are those of the grid.
        up: (3,) what heights are counted along, of the world or of the body.
        height: of the floor along it.
        of_body: whether these are the body's.
        is_guessed: whether no floor was found and none given.
        terrain: heights of the ground in that frame, or None where it is one plane.
    """

    T_level_world: Array
    up: Array
    height: float
    of_body: bool
    is_guessed: bool = False
    terrain: Terrain | None = None

    def above(self, sweep: Sweep, points_body: Array) -> Array:
        """Return x and y in the plane and z above the floor of points (..., 3)."""
        T = sweep.T_world_body
        points_world = points_body @ T[:3, :3].T + T[:3, 3]
        placed = points_world @ self.T_level_world[:3, :3].T
        measured = points_body if self.of_body else points_world
        placed[..., 2] = measured @ self.up - self.height
        if self.terrain is not None:
            placed[..., 2] -= np.nan_to_num(self.terrain.at(placed[..., :2]))
        return np.asarray(placed)


def _with_terrain(
    ground: _Ground, sweeps: Callable[[], Iterable[Sweep]], farthest: float
) -> _Ground:
    """Return the same with the heights of the ground that all sweeps see, near where they are."""

    def near() -> Iterator[Array]:
        for sweep in sweeps():
            placed, eye = (ground.above(sweep, p) for p in (sweep.points_body, sweep.eye_body))
            yield placed[np.square(placed[:, :2] - eye[:2]).sum(axis=1) < farthest**2]

    places = [sweep.T_world_body[:3, 3] for sweep in sweeps()]
    return replace(ground, terrain=terrain_of(near(), float(np.ptp(places, axis=0).max())))


def _find_ground(
    sweeps: Iterable[Sweep], up_body: Array, config: GridConfig
) -> tuple[_Ground, tuple[str, ...]]:
    """Return what heights are counted from, and what to say of it."""
    some = _some(sweeps)
    if not some:
        raise InputError("there is not one point: nothing to make a grid of")
    up_world = np.mean([s.T_world_body[:3, :3] @ up_body for s in some], axis=0)
    up_world /= max(float(np.linalg.norm(up_world)), 1e-9)
    of_body = config.up == "body"
    points, eyes = [], []
    for s in some:
        T = np.eye(4) if of_body else s.T_world_body
        points.append(s.points_body @ T[:3, :3].T + T[:3, 3])
        eyes.append(T[:3, :3] @ s.eye_body + T[:3, 3])
    up = up_body if of_body else up_world
    seen, notes = np.concatenate(points), list[str]()
    up, found = find_floor(seen, np.array(eyes), up)
    height = float(np.quantile(seen @ up, LOWEST)) if found is None else found
    eye = float(np.median(np.array(eyes) @ up))
    if config.floor is not None:
        height = eye - config.floor
    elif found is not None:
        notes.append(f"the floor is {eye - height:.2f} m below the sensor, by what was seen")
    else:
        notes.append("no floor was seen: heights are counted from the lowest points")
    plane = up_world if of_body else up
    plane = np.array([0.0, 0.0, 1.0]) if plane[2] > LEVEL else plane
    T_level_world = level(plane, 0.0 if of_body else height)
    is_guessed = found is None and config.floor is None
    return _Ground(T_level_world, up, height, of_body, is_guessed), tuple(notes)


def _some(sweeps: Iterable[Sweep]) -> list[Sweep]:
    """Return evenly spaced sweeps with evenly spaced points, twice as many as needed at most."""
    kept: list[Sweep] = []
    step, n = 1, 0
    for sweep in sweeps:
        if not len(sweep.points_body):
            continue
        if n % step == 0:
            rows = np.linspace(0, len(sweep.points_body) - 1, POINTS_EACH).astype(np.int64)
            kept.append(replace(sweep, points_body=sweep.points_body[np.unique(rows)]))
        n += 1
        if len(kept) >= 2 * LOOKED_AT:
            kept, step = kept[::2], 2 * step
    return kept
