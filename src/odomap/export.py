"""Dense 3D from a run: a coloured cloud and a mesh, re-made from its keyframes.

    odomap.export("runs/desk")         # writes cloud.ply, mesh.ply and mesh.png there

A run keeps no dense map: depth is in the recording, and poses are in the run's folder. So the
recording is opened again, the frames at the keyframes' stamps are read, each one's depth is fused
at the keyframe's final pose, and the surface is extracted. A better path later needs no more than
doing so again.

The size of voxels follows the scene: a hundredth of its median depth, or half the noise of depth
there, whichever is more; and depth is used as far as its noise is below half the band that
distances are cut at. The cloud is the mesh's points: each is the mean of all that saw it, about one
per voxel, with a normal, and what hangs loose in the air is gone. Depth points thinned per voxel
would keep the noise and the double walls.

Reference: B. Curless, M. Levoy, "A volumetric method for building complex models from range
images", SIGGRAPH 1996.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from odomap.errors import InputError, OdomapError
from odomap.files.atomic import make_folder, write_bytes
from odomap.geometry.trajectory import Trajectory
from odomap.reopening import keyframe_poses, keyframe_views, need_metres, open_recording

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from odomap.maps.depthviews import DepthViews
    from odomap.maps.surface import Surface
    from odomap.maps.tsdf import Tsdf, TsdfConfig
    from odomap.sensors.rig import Rig
    from odomap.sources.source import Source

__all__ = ["Exported", "export"]

VOXELS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Sizes of voxels that are chosen from, metres."""
PER_DEPTH = 100.0
"""Voxels up to the median depth."""
SAMPLES = 5
"""Keyframes looked at to choose the size of voxels."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Exported:
    """What was made.

    Attributes:
        surface: the mesh; its points are the cloud.
        keyframes: how many keyframes were fused.
        config: size of voxels, and how far depth was used.
        written: the files.
        notes: what a person should know, one sentence each.
        seconds: how long it took, without compiling.
    """

    surface: "Surface"
    keyframes: int
    config: "TsdfConfig"
    written: tuple[Path, ...]
    notes: tuple[str, ...]
    seconds: float


def export(
    run: str | Path,
    cloud: str | Path | None = None,
    mesh: str | Path | None = None,
    *,
    data: str | Path | None = None,
    rig: "Rig | str | Path | None" = None,
    voxel: float | None = None,
    max_depth: float | None = None,
    picture: bool = True,
    progress: Progress | None = None,
) -> Exported:
    """Make a coloured cloud and a mesh of what a run saw.

    Args:
        run: the output folder of a run.
        cloud: PLY file for the points; where neither this nor `mesh` is given, both are written
            into the run's folder.
        mesh: PLY file for the triangles.
        data: the recording, if it is no longer where the run found it.
        rig: a rig or rig.yaml; default what the run was given.
        voxel: side of a voxel, metres; default by the scene.
        max_depth: depths beyond are not used, metres; default by the noise of depth.
        picture: whether to draw the mesh, as a PNG beside it.
        progress: called with steps done, steps in all, and what is being done.

    Returns:
        The surface and where it was written.

    Raises:
        InputError: no run, no depth, a path without scale, a recording that is not there or
            another one, values that cannot be.
        OutputError: a file cannot be written.

    Example:
        >>> export("runs/desk", mesh="desk.ply", voxel=0.01)  # doctest: +SKIP
    """
    from odomap.maps.depthviews import depth_views
    from odomap.maps.tsdf import TsdfConfig

    for name, value in (("voxel", voxel), ("max_depth", max_depth)):
        if value is not None:
            TsdfConfig(**{name: value})  # a wrong value is said before anything is opened
    tell = progress or (lambda done, total, text: None)
    folder = Path(run)
    files = _files(folder, cloud, mesh)
    poses, notes = keyframe_poses(folder)
    need_metres(folder)
    source = open_recording(folder, data, rig)
    try:
        views = depth_views(source.rig)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from error
    _warm_up(tell)
    start = time.perf_counter()
    config, more = _config(source, views, poses, voxel, max_depth)
    tsdf, skipped = _fused(source, views, poses, config, voxel is None, tell)
    tell(len(poses), len(poses), "extracting the surface")
    # A single look of a stereo pair may be a wrong match; a sensor measures each pixel by itself.
    least = 2 if source.rig.depth is None and tsdf.num_views > 2 else 1
    surface = tsdf.surface(least)
    if not len(surface.faces):
        raise OdomapError(
            f"{source.name}: no surface within {tsdf.config.max_depth:g} m of "
            f"{tsdf.num_views} keyframes: use more depth (--max-depth) or larger voxels (--voxel)"
        )
    if tsdf.config.voxel != config.voxel:
        more.append(f"voxels are {tsdf.config.voxel:g} m, for smaller ones need too much memory")
    written = _write(files, surface, _cameras(poses, views), picture)
    seconds = time.perf_counter() - start
    notes += [*more, *skipped]
    return Exported(surface, tsdf.num_views, tsdf.config, written, tuple(notes), seconds)


def _files(folder: Path, cloud: str | Path | None, mesh: str | Path | None) -> dict[str, Path]:
    """Return where cloud and mesh go, after trying whether they can."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: give the output folder of `odomap run`")
    if cloud is None and mesh is None:
        cloud, mesh = folder / "cloud.ply", folder / "mesh.ply"
    files = {n: Path(f) for n, f in (("cloud", cloud), ("mesh", mesh)) if f is not None}
    for name, file in files.items():
        if file.suffix.lower() != ".ply":
            raise InputError(f"--{name} {file}: only PLY is written: give a name that ends in .ply")
        make_folder(file.parent)
    if len({file.resolve() for file in files.values()}) < len(files):
        raise InputError(f"--cloud and --mesh are both {cloud}: give two names")
    return files


def _warm_up(tell: Progress) -> None:
    """Compile, or load, what fusing needs."""
    from odomap.compiling import compile_modules

    names = ("maps.tsdf_depth", "maps.tsdf_kernels", "maps.surface_kernels", "views.mesh_picture")
    compile_modules(
        [f"odomap.{name}" for name in names],
        lambda done, total, name: tell(done, total, f"compiling {name}"),
    )


def _config(
    source: "Source",
    views: "DepthViews",
    poses: Trajectory,
    voxel: float | None,
    max_depth: float | None,
) -> tuple["TsdfConfig", list[str]]:
    """Return the size of voxels and the reach of depth, and what to say about them."""
    from odomap.maps.tsdf import TsdfConfig

    said: list[str] = []
    if voxel is None:
        some = poses.rows(np.unique(np.linspace(0, len(poses) - 1, SAMPLES).astype(np.int64)))
        found = keyframe_views(source, views, some, [])
        depths = [view.depth[view.depth > 0] for _, view in found]
        seen = np.concatenate([*depths, np.zeros(0, np.float32)])
        seen = seen[np.isfinite(seen)]
        if not len(seen):
            raise OdomapError(f"{source.name}: the keyframes have no depth")
        median = float(np.median(seen))
        wanted = max(median / PER_DEPTH, 0.5 * views.noise * median**2)
        voxel = min(VOXELS, key=lambda size: abs(np.log(size / wanted)))
        said.append(f"voxels of {voxel:g} m, since depth is {median:.2g} m in the middle")
    config = TsdfConfig(voxel=voxel)
    if max_depth is None:
        max_depth = float(np.sqrt(0.5 * config.band / views.noise))
        said.append(f"depth is used up to {max_depth:.2g} m, where its noise is two voxels")
    return replace(config, max_depth=max_depth), said


def _fused(
    source: "Source",
    views: "DepthViews",
    poses: Trajectory,
    config: "TsdfConfig",
    may_coarsen: bool,
    tell: Progress,
) -> tuple["Tsdf", list[str]]:
    """Fuse all keyframes; with larger voxels where those chosen need too much memory."""
    from odomap.maps.tsdf import Tsdf, TsdfFull

    tsdf, skipped = Tsdf(config), list[str]()
    try:
        for row, view in keyframe_views(source, views, poses, skipped):
            tell(row, len(poses), f"{tsdf.memory_mb:.0f} MB")
            tsdf.integrate(
                view.depth, view.colour, views.camera, poses.pose(row) @ views.T_body_camera
            )
    except TsdfFull:
        if not may_coarsen:
            raise
        return _fused(source, views, poses, replace(config, voxel=2 * config.voxel), True, tell)
    if tsdf.num_views == 0:
        raise OdomapError(f"{source.name}: the keyframes have no depth")
    return tsdf, skipped


def _cameras(poses: Trajectory, views: "DepthViews") -> "NDArray[np.float64]":
    return np.asarray(poses.Ts_world_body @ views.T_body_camera.matrix)


def _write(
    files: dict[str, Path],
    surface: "Surface",
    Ts_world_camera: "NDArray[np.float64]",
    picture: bool,
) -> tuple[Path, ...]:
    """Write what was asked for."""
    from odomap.files.clouds import write_ply

    written = []
    for name, file in files.items():
        write_ply(file, surface.cloud() if name == "cloud" else surface)
        written.append(file)
    if picture and "mesh" in files:
        from odomap.views.mesh_picture import mesh_png

        written.append(files["mesh"].with_suffix(".png"))
        write_bytes(written[-1], mesh_png(surface, Ts_world_camera))
    return tuple(written)


class _CallableModule(ModuleType):
    """Let `odomap.export` be called, whether it is the function or, once imported, this module."""

    def __call__(self, *args: Any, **kwargs: Any) -> Exported:
        return export(*args, **kwargs)


sys.modules[__name__].__class__ = _CallableModule
