"""`odomap merge`: two maps of one place made one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from odomap.cli.progress import Steps

__all__ = ["Merge"]


@dataclass(frozen=True)
class Merge:
    """Merge two maps of one place, made with the same cameras, into one.

    Places of the second are recognised in the first, and it is moved to where they are; landmarks
    that are the same become one. Both files stay as they are. Exit code 1, and nothing written, if
    they have no place in common.
    """

    first: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """A map file, or the output folder of `odomap run`; its world stays."""
    second: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """Another, which is brought to it."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("merged.odomap")
    """Where to write the merged map."""
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rig.yaml: the sensors both were made with, for maps that do not say."""
    vocabulary: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A vocabulary to recognise places by, as `odomap vocabulary train` writes it; default that
    which comes with odomap."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Merge, write, and say what was found."""
        from odomap.files.rig import read_rig
        from odomap.merge import merge_maps

        rig = None if self.rig is None else read_rig(self.rig)
        with Steps("merge", self.quiet) as steps:
            merged = merge_maps(
                self.first,
                self.second,
                self.out,
                rig=rig,
                vocabulary=self.vocabulary,
                progress=steps.show,
            )
        m, size = merged.map, self.out.stat().st_size / 2**20
        print(f"{'merged':<16} {merged.summary}")
        counts = f"{m.num_keyframes} keyframes, {m.num_landmarks} landmarks, {size:.2f} MB"
        print(f"{'wrote':<16} {self.out}: {counts}")
        return 0
