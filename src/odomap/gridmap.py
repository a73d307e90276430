"""Occupancy grids of what a run saw, made and written.

    odomap.gridmap.export_grid("runs/office", "office.yaml")

makes a grid of the map's 2D scans or 3D sweeps, or else of the depth in the recording that the run
was made from, at where the keyframes are now; and writes it as YAML and PGM, which map_server
loads, with a PNG for people, in which the path is drawn.

Of a depth image every few pixels are used, cleaned of those that fly between two surfaces, and as
far as the noise of depth is below a cell: a wall that is spread over more is none.

Reference: H. Moravec, A. Elfes, "High resolution maps from wide angle sonar", ICRA 1985.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from odomap.errors import InputError
from odomap.files.atomic import make_folder
from odomap.files.grids import GRID_SUFFIXES
from odomap.files.mapfile import MapFile
from odomap.files.rig import read_rig
from odomap.geometry.trajectory import Trajectory
from odomap.reopening import keyframe_poses, keyframe_views, need_metres, open_recording
from odomap.savedmap import FILE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from odomap.maps.depthviews import DepthView, DepthViews
    from odomap.maps.occupancy import GridConfig, GridMap
    from odomap.sensors.rig import Rig

__all__ = ["GridExport", "export_grid"]

PIXELS = 20_000
"""Of a depth image at most."""
NEAR_M, JUMP = 0.1, 0.05
"""Nearest depth used; share of depth that is a jump between neighbouring pixels."""
NOISE_CELLS = 1.0
"""Cells that the noise of depth may be, standard deviation."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class GridExport:
    """What was made.

    Attributes:
        made: the grid, the path in it, and what it was made of.
        written: the files.
        notes: what a person should know, one sentence each.
    """

    made: "GridMap"
    written: tuple[Path, ...]
    notes: tuple[str, ...]


def export_grid(
    run: str | Path,
    file: str | Path,
    config: "GridConfig | None" = None,
    *,
    data: str | Path | None = None,
    rig: "Rig | str | Path | None" = None,
    picture: bool = True,
    progress: Progress | None = None,
) -> GridExport:
    """Make a grid of what a run saw, and write it.

    Args:
        run: the output folder of a run, or a map file.
        file: ends in `.yaml`; the pictures get its name with `.pgm` and `.png`.
        config: how it is made.
        data: the recording, if depth is needed and it is no longer where the run found it.
        rig: a rig or rig.yaml; default what the map says, or the run was given.
        picture: whether to write the PNG.
        progress: called with steps done, steps in all, and what is being done.

    Returns:
        The grid and where it was written.

    Raises:
        InputError: there are neither scans nor clouds nor depth, or something is wrong or missing.
        OutputError: a file cannot be written.

    Example:
        >>> export_grid("runs/office", "office.yaml")  # doctest: +SKIP
    """
    from odomap.maps.occupancy import GridConfig

    target, config = Path(file), GridConfig() if config is None else config
    if target.suffix.lower() not in GRID_SUFFIXES:
        raise InputError(f"{target}: give a name that ends in .yaml")
    tell = progress or (lambda done, total, text: None)
    place, notes = Path(run), list[str]()
    _warm_up(tell)
    saved = place / FILE if place.is_dir() else place
    made = _of_map(saved, rig, config) if saved.exists() or not place.is_dir() else None
    if made is None:
        if not place.is_dir():
            raise InputError(
                f"{place}: the map holds neither scans nor clouds, and depth is not kept in maps: "
                "give the folder of a run with depth"
            )
        made, notes = _of_depth(place, data, rig, config, tell)
    if not made.grid.is_known.any():
        raise InputError(f"{run}: nothing was seen at these heights and ranges: choose others")
    from odomap.views.gridpicture import write_grid

    make_folder(target.parent)
    return GridExport(made, write_grid(target, made, picture), (*notes, *made.notes))


def _warm_up(tell: Progress) -> None:
    """Compile, or load, what grids need."""
    from odomap.compiling import compile_modules

    names = ("lidar.grid", "lidar.scans", "lidar.slices", "maps.tsdf_depth")
    compile_modules(
        [f"odomap.{name}" for name in names],
        lambda done, total, name: tell(done, total, f"compiling {name}"),
    )


def _of_map(file: Path, rig: "Rig | str | Path | None", config: "GridConfig") -> "GridMap | None":
    """Return a grid of a map's scans or clouds; None where it has none."""
    from odomap.maps.occupancy import grid_of_map

    with MapFile(file) as opened:
        if not {"scan/keyframe", "cloud/keyframe"} & set(opened.arrays):
            return None
        map, own = opened.map(), opened.rig
    given = read_rig(rig) if isinstance(rig, (str, Path)) else rig
    mounts = given or own
    if mounts is None:
        raise InputError(f"{file}: does not say how its LiDAR is mounted: give it with --rig FILE")
    try:
        return grid_of_map(map, mounts, config)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def _of_depth(
    folder: Path,
    data: str | Path | None,
    rig: "Rig | str | Path | None",
    config: "GridConfig",
    tell: Progress,
) -> tuple["GridMap", list[str]]:
    """Return a grid of the depth in the recording that a run was made from."""
    from odomap.maps.depthviews import depth_views
    from odomap.maps.occupancy import LOOKED_AT, Sweep, grid_of_sweeps, upwards

    poses, notes = keyframe_poses(folder)
    need_metres(folder)
    source = open_recording(folder, data, rig)
    try:
        views = depth_views(source.rig)
    except InputError:
        raise InputError(
            f"{folder}: a grid needs scans or clouds in the map, or a recording with depth; "
            f"{source.name} has neither depth nor a stereo pair"
        ) from None
    reach = float(np.sqrt(NOISE_CELLS * config.resolution / views.noise))
    if reach < config.slice.farthest:
        config = replace(config, slice=replace(config.slice, farthest=reach))
        notes.append(f"depth is used up to {reach:.2g} m, where its noise is a cell")
    T_body_camera, skipped = views.T_body_camera.matrix, list[str]()

    def sweeps(some: Trajectory) -> Iterator[Sweep]:
        skipped.clear()
        for row, view in keyframe_views(source, views, some, skipped):
            tell(row, len(some), "keyframes")
            points = _points(views, view, reach) @ T_body_camera[:3, :3].T + T_body_camera[:3, 3]
            yield Sweep(some.Ts_world_body[row], T_body_camera[:3, 3], points)

    few = poses.rows(np.unique(np.linspace(0, len(poses) - 1, LOOKED_AT).astype(np.int64)))
    try:
        made = grid_of_sweeps(lambda: sweeps(poses), upwards(source.rig), config, some=sweeps(few))
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from error
    return made, [*notes, *skipped]


def _points(views: "DepthViews", view: "DepthView", reach: float) -> "NDArray[np.float64]":
    """Return points (N, 3) of a depth image in the camera."""
    from odomap.maps.tsdf_depth import clean_kernel

    depth = np.ascontiguousarray(view.depth, np.float32)
    clean = np.empty_like(depth)
    clean_kernel(depth, NEAR_M, reach, JUMP, clean)
    step = max(1, int(np.ceil(np.sqrt(clean.size / PIXELS))))
    rows, columns = np.nonzero(clean[step // 2 :: step, step // 2 :: step])
    rows, columns = rows * step + step // 2, columns * step + step // 2
    z = clean[rows, columns].astype(np.float64)
    camera = views.camera
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.column_stack([x * z, y * z, z])
