"""`odomap export`: a cloud, a mesh or a grid of what a run saw; landmarks and poses of a map."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from odomap.cli.progress import Steps
from odomap.errors import InputError

if TYPE_CHECKING:
    from odomap.savedmap import SavedMap

__all__ = ["Export"]


@dataclass(frozen=True)
class Export:
    """Make a coloured cloud and a mesh of a run with depth or stereo; write parts of a map file.

    Cloud and mesh are re-made from the run's keyframes, for which its recording is opened again.
    Without options both are written into the run's folder. --points, --trajectory, --graph and
    --colmap take what the map holds, and need no recording, nor does the cloud of a LiDAR. --grid
    makes an occupancy grid of the map's scans or clouds, or of the recording's depth.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN|MAP")]
    """The output folder of `odomap run`, or a map file."""
    points: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """PLY file for the landmarks of the map."""
    trajectory: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """TUM file for the keyframes of the map."""
    graph: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """g2o file for the keyframes of the map and the edges between them."""
    colmap: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder for the map as COLMAP text: cameras.txt, images.txt, points3D.txt."""
    grid: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """YAML file for an occupancy grid as map_server loads it, with a PGM and a PNG beside it."""
    resolution: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.05
    """Size of the grid's cells."""
    height: Annotated[tuple[float, float], tyro.conf.arg(metavar="LOW HIGH")] = (0.1, 1.8)
    """What is in the way, metres above the floor; of clouds and depth."""
    floor: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """How far the floor is below the sensor; default by what was seen."""
    up: Literal["gravity", "body", "ground"] = "gravity"
    """What heights are counted from: a level floor; body for a floor that goes with what drives on
    wheels, up ramps, too; ground that rises and falls, which clouds without one floor have, too."""
    cloud: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File for the points: PLY, coloured; of a LiDAR PLY or PCD, with intensities."""
    mesh: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """PLY file for the triangles; a picture of them is drawn beside it."""
    voxel: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Side of a voxel; default by the scene: 0.02 in a room, more in a street; 0.2 of a LiDAR."""
    max_depth: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Depths beyond are not used; default as far as their noise is below two voxels."""
    data: Annotated[str | None, tyro.conf.arg(metavar="PATH")] = None
    """The recording, if it is no longer where the run found it."""
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rig.yaml, if it is no longer where the run found it, or a map does not say one."""
    picture: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Do not draw the mesh or the grid."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Make and write them, and say what they are."""
        of_map = {
            "--points": (self.points, (".ply",)),
            "--trajectory": (self.trajectory, (".tum", ".txt", ".gz")),
            "--graph": (self.graph, (".g2o", ".gz")),
        }
        is_of_map = self.colmap is not None or any(file is not None for file, _ in of_map.values())
        if is_of_map:
            self._write_map(of_map)
        if self.grid is not None:
            self._make_grid(self.grid)
        asks_for_surface = self.cloud is not None or self.mesh is not None
        if asks_for_surface or not (is_of_map or self.grid is not None):
            saved = self._of_lidar()
            if saved is not None:
                return self._make_cloud(saved)
        if self.cloud is not None or self.mesh is not None:
            return self._make_surface()
        if is_of_map or self.grid is not None:
            return 0
        if self.run.is_file():
            raise InputError(
                f"{self.run}: say what of the map: --points, --trajectory, --graph or --grid FILE, "
                "or --colmap FOLDER (a cloud and a mesh are made of a run's folder)"
            )
        return self._make_surface()

    def _of_lidar(self) -> "SavedMap | None":
        """Return the map if a 3D LiDAR made it: its keyframes hold the cloud."""
        from odomap.savedmap import FILE, SavedMap

        file = self.run / FILE if self.run.is_dir() else self.run
        if not file.is_file():
            return None
        saved = SavedMap.load(file)
        return saved if saved.sensors == "lidar" else None

    def _make_cloud(self, saved: "SavedMap") -> int:
        from odomap.files.atomic import make_folder
        from odomap.files.cloudfiles import check_ending, write_cloud
        from odomap.files.rig import read_rig
        from odomap.maps.cloudmap import VOXEL, cloud_of_map

        if self.mesh is not None:
            raise InputError("--mesh: a LiDAR's map has points and no surface: give --cloud FILE")
        rig = saved.rig if self.rig is None else read_rig(self.rig)
        if rig is None:
            raise InputError(f"{saved.name}: does not say where its LiDAR was: give --rig")
        folder = self.run if self.run.is_dir() else self.run.parent
        file = folder / "cloud.ply" if self.cloud is None else self.cloud
        check_ending(file)
        made = cloud_of_map(saved.map, rig, VOXEL if self.voxel is None else self.voxel)
        make_folder(file.parent)
        write_cloud(file, made.columns())
        written = [file]
        if self.picture:
            from odomap.files.atomic import write_bytes
            from odomap.views.cloudpicture import cloud_png

            written.append(file.with_suffix(".png"))
            write_bytes(written[-1], cloud_png(made))
        for note in made.notes:
            print(f"odomap: {note}", file=sys.stderr)
        print(f"{'keyframes':<16} {len(made.path)}")
        print(f"{'points':<16} {len(made.points)}")
        for each in written:
            print(f"{'wrote':<16} {each}")
        return 0

    def _make_grid(self, file: Path) -> None:
        from odomap.gridmap import export_grid
        from odomap.lidar.slices import SliceConfig
        from odomap.maps.occupancy import GridConfig

        band = SliceConfig(low=self.height[0], high=self.height[1])
        config = GridConfig(resolution=self.resolution, slice=band, up=self.up, floor=self.floor)
        with Steps("export", self.quiet) as steps:
            result = export_grid(
                self.run,
                file,
                config,
                data=self.data,
                rig=self.rig,
                picture=self.picture,
                progress=steps.show,
            )
        for note in result.notes:
            print(f"odomap: {note}", file=sys.stderr)
        grid = result.made.grid.cropped()
        wide, high = (grid.resolution * cells for cells in grid.log_odds.shape[::-1])
        rows = [
            ("keyframes", f"{len(result.made.path)} with {result.made.made_of}"),
            ("grid", f"{wide:.1f} x {high:.1f} m, cells of {grid.resolution:g} m"),
            *(("wrote", str(written)) for written in result.written),
        ]
        for name, value in rows:
            print(f"{name:<16} {value}")

    def _write_map(self, wanted: dict[str, tuple[Path | None, tuple[str, ...]]]) -> None:
        from odomap.files.atomic import make_folder
        from odomap.files.mapexport import write_map_parts
        from odomap.savedmap import SavedMap, map_file

        source = map_file(self.run)
        files = [file for file, _ in wanted.values() if file is not None]
        for option, (file, endings) in wanted.items():
            if file is not None and file.suffix.lower() not in endings:
                raise InputError(f"{option} {file}: give a name that ends in {endings[0]}")
        if len({file.resolve() for file in [source, *files]}) < 1 + len(files):
            raise InputError("--points, --trajectory and --graph: give names of their own")
        saved = SavedMap.load(source)
        for file in files:
            make_folder(file.parent)
        for line in write_map_parts(saved.map, self.points, self.trajectory, self.graph):
            print(f"{'wrote':<16} {line}")
        if self.colmap is not None:
            self._write_colmap(saved, self.colmap)

    def _write_colmap(self, saved: "SavedMap", folder: Path) -> None:
        from odomap.files.atomic import make_folder
        from odomap.files.colmap import write_colmap
        from odomap.files.rig import read_rig

        if self.rig is not None:
            saved = replace(saved, rig=read_rig(self.rig))
        if saved.sensors in ("lidar", "lidar2d"):
            raise InputError(
                f"{saved.name}: --colmap: a laser's map has no images: give --cloud FILE"
            )
        eye = saved.eye()
        model = write_colmap(make_folder(folder), saved.map, eye.camera, eye.T_body_camera)
        counts = f"{len(model.keyframes)} images, {len(model.point_ids)} points"
        print(f"{'wrote':<16} {folder}: {counts}, seen {len(model.obs_image)} times")

    def _make_surface(self) -> int:
        from odomap.export import export

        with Steps("export", self.quiet) as steps:
            result = export(
                self.run,
                self.cloud,
                self.mesh,
                data=self.data,
                rig=self.rig,
                voxel=self.voxel,
                max_depth=self.max_depth,
                picture=self.picture,
                progress=steps.show,
            )
        for note in result.notes:
            print(f"odomap: {note}", file=sys.stderr)
        surface = result.surface
        extent = " x ".join(f"{length:.2f}" for length in surface.extent())
        rows = [
            ("keyframes", str(result.keyframes)),
            ("surface", f"{len(surface.points)} points, {len(surface.faces)} triangles"),
            ("box", f"{extent} m, voxels of {result.config.voxel:g} m"),
            ("time", f"{result.seconds:.1f} s"),
            *(("wrote", str(file)) for file in result.written),
        ]
        for name, value in rows:
            print(f"{name:<16} {value}")
        return 0
