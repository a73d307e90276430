"""The doctor: says what this installation is made of, what is missing, and how to mend it.

Each examination is a function that returns findings; nothing here prints, and nothing here needs
the library that it examines to be healthy: versions come from package metadata, and an import that
breaks is itself a finding.
"""

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from odomap.machine import num_cores, total_memory_gb
from odomap.version import __version__

__all__ = [
    "Finding",
    "compile_kernels",
    "examine",
    "examine_cache",
    "examine_core",
    "examine_extras",
    "examine_machine",
    "examine_opencv",
]

CORE = {
    "numpy": "numpy",
    "scipy": "scipy",
    "numba": "numba",
    "opencv-python-headless": "cv2",
    "qdldl": "qdldl",
    "tyro": "tyro",
    "rich": "rich",
    "pyyaml": "yaml",
    "matplotlib": "matplotlib",
}
"""Distribution on the package index → module it brings."""

EXTRAS = {
    "ros": ("rosbags", "reads ROS bags"),
    "view": ("viser", "shows a run live in the browser"),
    "learned": ("onnxruntime", "runs learned features"),
}
"""Extra → distribution it brings, and what for."""

RIVALS = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
"""Distributions that write their own files into the same folder `cv2`."""


@dataclass(frozen=True)
class Finding:
    """One thing the doctor saw.

    Attributes:
        name: what was looked at.
        state: "ok", "note" (works, could be better) or "broken".
        text: what was found.
        mend: what to do about it; empty when there is nothing to do.
    """

    name: str
    state: str
    text: str
    mend: str = ""


def installed(distribution: str) -> str:
    """Return the version of an installed distribution, or an empty text."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return ""


def examine_machine() -> Iterator[Finding]:
    """Yield what odomap, the interpreter and the machine are."""
    yield Finding("odomap", "ok", f"{__version__} in {Path(__file__).parent}")
    yield Finding("python", "ok", f"{platform.python_version()} on {platform.platform()}")
    yield Finding("cores", "ok", str(num_cores()))
    memory = total_memory_gb()
    if memory:
        small = memory < 2.0
        mend = "long recordings may need more than 2 GB" if small else ""
        yield Finding("memory", "note" if small else "ok", f"{memory:.1f} GB", mend)


def examine_core() -> Iterator[Finding]:
    """Yield a finding per library that odomap needs: its version, and whether it imports."""
    for distribution, module in CORE.items():
        release = installed(distribution)
        try:
            import_module(module)
        except Exception as error:  # a broken binary raises more than ImportError
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            mend = f"pip install --force-reinstall {distribution}"
            yield Finding(distribution, "broken", f"{release or 'not installed'}: {reason}", mend)
        else:
            yield Finding(distribution, "ok", release or "present, of unknown version")


def examine_opencv() -> Iterator[Finding]:
    """Yield a finding for every other OpenCV installed into the same folder as the headless one."""
    beside = [f"{name} {installed(name)}" for name in RIVALS if installed(name)]
    if not beside:
        return
    names = " ".join(name.split()[0] for name in beside)
    yield Finding(
        "opencv",
        "broken",
        f"{', '.join(beside)} beside opencv-python-headless: they overwrite each other's cv2",
        f"pip uninstall -y {names} opencv-python-headless && pip install opencv-python-headless",
    )


def examine_extras() -> Iterator[Finding]:
    """Yield a finding per optional library."""
    for extra, (distribution, purpose) in EXTRAS.items():
        release = installed(distribution)
        if release:
            yield Finding(f"extra '{extra}'", "ok", f"{distribution} {release}")
        else:
            text = f"not installed ({distribution}: {purpose})"
            yield Finding(f"extra '{extra}'", "note", text, f"pip install 'odomap[{extra}]'")


def examine_cache() -> Iterator[Finding]:
    """Yield where compiled kernels are kept, and whether that folder can be written."""
    folders = cache_folders()
    for folder in folders:
        if is_writable(folder):
            yield Finding("kernel cache", "ok", f"{folder} ({kernel_files(folder)} files)")
            return
    yield Finding(
        "kernel cache",
        "broken",
        f"cannot write {' nor '.join(map(str, folders))}: no kernel can be kept",
        "set NUMBA_CACHE_DIR to a folder you can write",
    )


def cache_folders() -> list[Path]:
    """Return where numba looks for a place to keep kernels, first choice first."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(chosen)]
    if sys.platform == "win32":
        user = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        user = Path.home() / "Library" / "Caches"
    else:
        user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return [Path(__file__).parent, user / "numba"]


def is_writable(folder: Path) -> bool:
    """Whether a file can be made in a folder, or in the nearest of its parents that exists."""
    while not folder.exists():
        if folder.parent == folder:
            return False
        folder = folder.parent
    probe = folder / f".odomap-{os.getpid()}"
    try:
        probe.touch()
        probe.unlink()
    except OSError:
        return False
    return True


def kernel_files(folder: Path) -> int:
    """Count the kernels kept in a folder."""
    return sum(1 for _ in folder.rglob("*.nbc")) if folder.exists() else 0


def examine() -> Iterator[Finding]:
    """Yield all findings but the kernels, which take long (see `compile_kernels`)."""
    yield from examine_machine()
    yield from examine_core()
    yield from examine_opencv()
    yield from examine_extras()
    yield from examine_cache()


def compile_kernels(progress: Callable[[int, int, str], None]) -> Finding:
    """Compile every kernel of the package, or load it from the cache.

    Args:
        progress: called before each module with its index, the number of modules and its name.

    Returns:
        One finding: how long it took, or which module does not compile and why.
    """
    from odomap.compiling import compile_modules
    from odomap.kernels import modules_with_kernels

    names = list(modules_with_kernels())
    last = ""

    def tell(done: int, total: int, name: str) -> None:
        nonlocal last
        last = name
        progress(done, total, name)

    start = time.perf_counter()
    try:
        compile_modules(names, tell)
    except Exception as error:  # whatever breaks a compilation is the finding
        reason = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        mend = "clear the cache (odomap doctor --clear); if it stays, report it with this text"
        return Finding("kernels", "broken", f"{last} does not compile: {reason}", mend)
    seconds = time.perf_counter() - start
    return Finding("kernels", "ok", f"{len(names)} modules compiled or loaded in {seconds:.1f} s")
