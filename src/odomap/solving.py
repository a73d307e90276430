"""What a solver on files needs around it: kernels compiled before the clock runs, safe results.

A descent of milliseconds is preceded by kernels that compile once for seconds, and followed by
files that must be writable, must not be the input nor each other, and must hold all that was read.
All of that is made sure before the work begins.
"""

import sys
from collections.abc import Callable
from pathlib import Path

from odomap.compiling import compile_modules
from odomap.errors import InputError
from odomap.files.atomic import find_obstacle, make_folder
from odomap.kernels import modules_with_kernels

__all__ = ["Tell", "check_out", "compile_imported"]

Tell = Callable[[int, int, str], None]
"""Progress: steps done, steps in all (0: not known), what is being done."""

ROOMS = ("odomap.backend.", "odomap.geometry.")


def compile_imported(tell: Tell) -> None:
    """Compile, or load from the cache, the kernels of all modules imported from the solvers."""
    imported = set(sys.modules)
    names = [n for n in modules_with_kernels() if n in imported and n.startswith(ROOMS)]
    compile_modules(names, lambda done, total, name: tell(done, total, f"compiling {name}"))


def check_out(given: object, *outs: str | Path | None) -> None:
    """Make sure that results can be written, and replace neither their source nor each other.

    Args:
        given: the input, if it is a path.
        outs: where the results go; None is nowhere.

    Raises:
        InputError: two of them are the same file, or one is there and is no regular file.
        OutputError: there is no writing there.
    """
    files = [Path(out) for out in outs if out is not None]
    for index, file in enumerate(files):
        if isinstance(given, str | Path) and file.exists() and file.samefile(given):
            raise InputError(f"{file}: is the input itself: choose another file")
        if file.resolve() in [other.resolve() for other in files[:index]]:
            raise InputError(f"{file}: two results would go into this file: give each its own")
        obstacle = find_obstacle(file)
        if obstacle is not None:
            raise InputError(f"{file}: cannot be written: {obstacle}")
    for file in files:
        make_folder(file.parent)
