"""What a solver on files needs around it: kernels compiled before the clock runs, safe results.

A descent of milliseconds is preceded by kernels that compile once for seconds, and followed by
files that must be writable, must not be the input, and must hold all that was read. All of that is
made sure before the work begins.
"""

import sys
from collections.abc import Callable
from pathlib import Path

from odomap.errors import InputError
from odomap.files.atomic import make_folder
from odomap.kernels import modules_with_kernels, warm_up

__all__ = ["Tell", "check_out", "compile_imported"]

Tell = Callable[[int, int, str], None]
"""Progress: steps done, steps in all (0: not known), what is being done."""

ROOMS = ("odomap.backend.", "odomap.geometry.")


def compile_imported(tell: Tell) -> None:
    """Compile, or load from the cache, the kernels of all modules imported from the solvers."""
    imported = set(sys.modules)
    names = [n for n in modules_with_kernels() if n in imported and n.startswith(ROOMS)]
    for index, name in enumerate(names):
        tell(index, len(names), f"compiling {name}")
        warm_up(name)


def check_out(given: object, out: str | Path | None) -> None:
    """Make sure that a result can be written, and does not replace what it is made from.

    Args:
        given: the input, if it is a path.
        out: where the result goes; None is nowhere.

    Raises:
        InputError: both are the same file.
        OutputError: there is no writing there.
    """
    if out is None:
        return
    file = Path(out)
    if isinstance(given, str | Path) and file.exists() and file.samefile(given):
        raise InputError(f"{file}: is the input itself: choose another file")
    make_folder(file.parent)
