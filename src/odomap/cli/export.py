"""`odomap export`: a coloured cloud and a mesh of what a run saw."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from odomap.cli.progress import Steps

__all__ = ["Export"]


@dataclass(frozen=True)
class Export:
    """Make a coloured point cloud and a mesh (PLY) from a run with depth or stereo.

    They are re-made from the run's keyframes, for which its recording is opened again. Without
    --cloud and --mesh both are written into the run's folder.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The output folder of `odomap run`."""
    cloud: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """PLY file for the coloured points."""
    mesh: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """PLY file for the triangles; a picture of them is drawn beside it."""
    voxel: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Side of a voxel; default by the scene: 0.02 in a room, more in a street."""
    max_depth: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Depths beyond are not used; default as far as their noise is below two voxels."""
    data: Annotated[str | None, tyro.conf.arg(metavar="PATH")] = None
    """The recording, if it is no longer where the run found it."""
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rig.yaml, if it is no longer where the run found it."""
    picture: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Do not draw the mesh."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Make and write them, and say what they are."""
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
