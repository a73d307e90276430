"""Atomic writes: a result is on disk whole, or not at all.

A file is written beside its target, flushed to the disk, and renamed over it. POSIX makes the
rename atomic, so a reader, a crash or a full disk never meets half a file, and an old result
survives a failed new one. A rename would replace a device or a pipe, too, and break it for all who
use it: only regular files are replaced. What the operating system complains about is raised as an
`OutputError` that names the file and the mend.

Reference: T. S. Pillai et al., "All file systems are not created equal: on the complexity of
crafting crash-consistent applications", OSDI 2014.
"""

import errno
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TextIO

from odomap.errors import OutputError

__all__ = [
    "atomic_binary",
    "atomic_text",
    "find_obstacle",
    "make_folder",
    "write_bytes",
    "write_text",
]

_MENDS = {
    errno.ENOSPC: "the disk is full: free some space, or choose another folder with --out",
    errno.EDQUOT: "the disk quota is used up: free some space, or choose another folder with --out",
    errno.EACCES: "no permission to write there: choose another folder with --out",
    errno.EPERM: "no permission to write there: choose another folder with --out",
    errno.EROFS: "the file system is read-only: choose another folder with --out",
    errno.ENOTDIR: "a part of the path is a file, not a folder: choose another folder with --out",
    errno.EEXIST: "a file of that name is in the way: choose another folder with --out",
    errno.EISDIR: "a folder of that name is in the way: remove it, or choose another with --out",
    errno.ENOENT: "the folder does not exist: create it first",
    errno.ENAMETOOLONG: "the name is too long: choose a shorter one",
    errno.EFBIG: "the file grew too large for this file system: choose another folder with --out",
}


@contextmanager
def atomic_binary(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file for writing bytes; it appears under its name when the block ends well.

    Args:
        path: the target; its folder must exist.

    Raises:
        OutputError: the operating system refuses (disk full, no permission, ...), or the target is
            there and is no regular file.
    """
    target = Path(path)
    obstacle = find_obstacle(target)
    if obstacle is not None:
        raise OutputError(f"{target}: cannot be written: {obstacle}")
    beside = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        try:
            with open(beside, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(beside, target)
        finally:
            _remove(beside)
    except OSError as error:
        if error.filename not in (None, str(beside), os.fspath(beside)):
            raise
        raise _output_error(target, error, target.parent.is_dir()) from error


@contextmanager
def atomic_text(path: str | Path) -> Iterator[TextIO]:
    """Open a file for writing UTF-8 text with `\\n` line ends; see `atomic_binary`."""
    with atomic_binary(path) as binary:
        text = io.TextIOWrapper(binary, encoding="utf-8", newline="\n", write_through=False)
        yield text
        text.flush()
        text.detach()


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write bytes atomically.

    Raises:
        OutputError: the operating system refuses.
    """
    with atomic_binary(path) as file:
        file.write(data)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text atomically.

    Raises:
        OutputError: the operating system refuses.
    """
    write_bytes(path, text.encode("utf-8"))


def find_obstacle(path: str | Path) -> str | None:
    """Return why a file must not replace what is under a name, in words; None if it may."""
    try:
        mode = os.stat(path).st_mode
    except OSError:
        # Nothing is there, or what keeps it from being seen keeps it from being written, too.
        return None
    if stat.S_ISDIR(mode):
        return _MENDS[errno.EISDIR]
    if not stat.S_ISREG(mode) or _leads_to_open_file(Path(path)):
        return "it is a device, a pipe or a socket, not a file: choose another name with --out"
    return None


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents, and make sure that files can be written in it.

    Returns:
        The folder.

    Raises:
        OutputError: it cannot be created or written to.
    """
    folder = Path(path)
    probe = folder / f".odomap.{os.getpid()}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            probe.write_bytes(b"")
        finally:
            _remove(probe)
    except OSError as error:
        raise _output_error(folder, error, True) from error
    return folder


def _leads_to_open_file(path: Path) -> bool:
    """Whether a name such as /dev/stdout stands for a file that a process has open."""
    while path.is_symlink():
        if Path(os.path.realpath(path.parent)).parts[:2] == ("/", "proc"):
            return True
        path = path.parent / os.readlink(path)
    return False


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:
        # What led here is being raised already and says more than this would.
        return


def _output_error(target: Path, error: OSError, has_folder: bool) -> OutputError:
    mend = _MENDS.get(error.errno or 0, error.strerror or str(error))
    if error.errno == errno.ENOENT and has_folder:
        mend = "no files can be made there: choose another folder with --out"
    return OutputError(f"{target}: cannot be written: {mend}")
