"""`odomap register`: the motion between two clouds."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from odomap.lidar.registration import Registration

__all__ = ["Register", "rows"]


@dataclass(frozen=True)
class Register:
    """Find how one cloud lies in another (PLY or PCD files).

    Prints T_target_source, how many points met, and what the clouds do not fix; --out writes the
    source as it lies in the target. Exit code 1 if it did not converge.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """Cloud that is moved."""
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TARGET")]
    """Cloud that stays."""
    method: Literal["gicp", "plane", "icp", "ndt"] = "gicp"
    """What meets what: pieces of surface, points planes, points points, points distributions."""
    initial: Annotated[Path | None, tyro.conf.arg(metavar="FILE|global")] = None
    """First guess of T_target_source: 4 rows of 4 numbers; or global, which needs none; default
    identity."""
    voxel: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Side of the voxels both are down-sampled to; 0: not at all; default what suits the target."""
    max_distance: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Farthest that a pair may be apart; default four voxels."""
    loss: Literal["huber", "cauchy", "geman_mcclure", "tukey"] | None = None
    """Let pairs that fit badly count less."""
    threads: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """How many share the points."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Where to write the source moved into the target, as PLY."""

    def execute(self) -> int:
        """Register, write, and say what was found."""
        from odomap.files.cloudfiles import read_cloud
        from odomap.files.clouds import write_ply
        from odomap.lidar.registration import register
        from odomap.maps.surface import Surface

        source, target = read_cloud(self.source), read_cloud(self.target)
        found = register(
            source,
            target,
            self.method,
            initial=first_guess(self.initial),
            voxel=self.voxel,
            max_distance=self.max_distance,
            loss=self.loss,
            threads=self.threads,
        )
        for name, value in rows(found):
            print(f"{name:<16} {value}")
        if self.out is not None:
            T = found.T_target_source
            moved = (source.points @ T[:3, :3].T + T[:3, 3]).astype("float32")
            normals = source.normals
            if normals is not None:
                normals = (normals @ T[:3, :3].T).astype("float32")
            write_ply(self.out, Surface(moved, normals, source.colours, source.faces))
            print(f"{'wrote':<16} {self.out}")
        if not found.converged:
            print(f"odomap: not converged: {found.reason}", file=sys.stderr)
        return 0 if found.converged else 1


def first_guess(given: Path | None) -> "list[list[float]] | Literal['global'] | None":
    """Return what `register` takes: a motion, the word "global", or nothing."""
    if given is None:
        return None
    return "global" if str(given) == "global" else read_motion(given)


def read_motion(path: Path) -> list[list[float]]:
    """Read 4 rows of 4 numbers.

    Raises:
        InputError: the file holds something else.
    """
    from odomap.errors import InputError

    try:
        text = path.read_text("utf-8")
        numbers = [[float(word) for word in line.split()] for line in text.splitlines() if line]
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not all words are numbers"
        raise InputError(f"{path}: cannot be read: {reason}") from None
    if [len(row) for row in numbers] != [4, 4, 4, 4]:
        raise InputError(f"{path}: holds no motion: 4 rows of 4 numbers expected")
    return numbers


def rows(found: "Registration") -> list[tuple[str, str]]:
    """Return the lines of the conclusion, name and value."""
    import numpy as np

    matrix = [" ".join(f"{x + 0.0:12.9f}" for x in row) for row in found.T_target_source]
    share = found.num_inliers / max(found.num_points, 1)
    ended = "converged" if found.converged else "not converged"
    fixed = np.linalg.eigvalsh(found.information)
    sigma = np.sqrt(np.diag(np.linalg.pinv(found.information, hermitian=True)))
    lines = [("T_target_source", matrix[0]), *(("", row) for row in matrix[1:])]
    lines += [
        ("inliers", f"{found.num_inliers} of {found.num_points} points ({share:.0%})"),
        ("error", f"{found.error:.4g} m from the surface, root mean square"),
        ("iterations", f"{found.iterations}: {ended}"),
    ]
    if not found.is_degenerate and fixed[0] > 0:
        shift = ", ".join(f"{1e3 * s:.2g}" for s in sigma[:3])
        turn = ", ".join(f"{np.degrees(s):.2g}" for s in sigma[3:])
        lines.append(("σ", f"{shift} mm; {turn}°"))
    if found.reason:
        lines.append(("note", found.reason))
    return lines
