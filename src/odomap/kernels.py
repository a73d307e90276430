"""Compiled inner loops: `@kernel` is numba's njit without the GIL, cached on disk.

A kernel takes arrays and scalars only, allocates nothing in its loops, and says its formula in its
docstring. Kernels release the GIL, so that tracking, mapping and closing can run side by side, and
never use numba's own threads (`parallel=True` aborts when several Python threads call it).

A module that has kernels also has a function `warm_up()`, which calls each of them once on a
handful of numbers with the types used in earnest: that compiles them, or loads them from the cache.
With the environment variable ODOMAP_PLAIN=1 kernels are plain Python: slow, but a debugger can step
through them.
"""

import functools
import importlib
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast, overload

from odomap.kernelfiles import keep

__all__ = ["clear_cache", "kernel", "modules_with_kernels", "needed_modules", "warm_up"]

_PACKAGE = Path(__file__).parent

LATE = ("odomap.geometry.", "odomap.maps.views_kernels")
"""Modules that are often used without their kernels, which are imported at their first use."""
LOOPS = ("odomap.geometry.alignransac_kernels", "odomap.geometry.horn_kernels")
"""Those of them that only serve where loops are closed."""
CLOSER = "odomap.system.closing"
"""Imported where loops of cameras are closed."""
SIGHT = tuple(f"odomap.geometry.{name}_kernels" for name in ("lens", "p3p", "pnp"))
"""Those of them that only serve where images are looked at."""
EYES = "odomap.vision.features"
"""Imported where they are."""
F = TypeVar("F", bound=Callable[..., object])


def _is_plain() -> bool:
    return os.environ.get("ODOMAP_PLAIN", "") not in ("", "0")


@overload
def kernel(function: F) -> F: ...


@overload
def kernel(*, reorder: bool) -> Callable[[F], F]: ...


def kernel(function: F | None = None, *, reorder: bool = False) -> F | Callable[[F], F]:
    """Compile a function of arrays and scalars: no GIL, cached, IEEE division as NumPy does it.

    Args:
        function: what to compile. reorder: let the compiler change the order of sums, so that it
        can add several terms at once.
            Results stay the same from run to run on one machine; NaN and infinity keep their
            meaning.
    """

    def compile_it(inner: F) -> F:
        if _is_plain():
            return inner
        import numba

        fastmath = {"reassoc", "contract", "nsz", "arcp"} if reorder else False
        options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
        options["no_cfunc_wrapper"] = True  # nobody calls them from C
        compiled = numba.njit(fastmath=fastmath, **options)(inner)
        keep(compiled)
        return cast(F, compiled)

    return compile_it if function is None else compile_it(function)


def modules_with_kernels() -> list[str]:
    """Return the dotted names of all modules of the package that define `warm_up`, in order."""
    return list(_with_kernels())


@functools.cache
def _with_kernels() -> tuple[str, ...]:
    names = []
    for file in sorted(_PACKAGE.rglob("*.py")):
        if file != Path(__file__) and "\ndef warm_up(" in file.read_text(encoding="utf-8"):
            names.append(".".join(("odomap", *file.relative_to(_PACKAGE).with_suffix("").parts)))
    return tuple(names)


def needed_modules() -> list[str]:
    """Return those of them that are imported by now, or will be when their kernels are first used.

    Once a system is made, what it did not import it does not need.
    """
    imported = set(sys.modules)  # looking for kernels imports packages
    late = [n for n in modules_with_kernels() if n.startswith(LATE)]
    if CLOSER not in imported:
        late = [n for n in late if n not in LOOPS]
    if EYES not in imported:
        late = [n for n in late if n not in SIGHT]
    return [n for n in modules_with_kernels() if n in imported or n in late]


def warm_up(name: str) -> float:
    """Compile (or load from the cache) all kernels of one module.

    Args:
        name: dotted module name, as `modules_with_kernels` yields them.

    Returns:
        Seconds it took.
    """
    start = time.perf_counter()
    importlib.import_module(name).warm_up()
    return time.perf_counter() - start


def clear_cache() -> int:
    """Delete the compiled kernels kept beside the package, and return how many files went.

    Numba does not see edits in functions that a cached kernel calls: clear after changing one.
    """
    files = [f for f in _PACKAGE.rglob("*") if f.suffix in (".nbi", ".nbc")]
    for file in files:
        file.unlink()
    return len(files)
