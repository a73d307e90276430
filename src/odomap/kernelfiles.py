"""Compiled kernels on disk: a file for each signature, which many processes may write at once.

Numba keeps an index beside each function, from signatures to numbered files, and changes it
without a lock. Two processes that compile one function for two signatures at the same time both
take the same number, and one of them then finds the other's machine code under its own signature:
it runs on arguments of other types, and reads what is not there.

Here there is no index. What names a file is the hash of the signature, the processor and the code,
its head says all of these, and the source it was made of, once more in full, and loading compares
them: a file is the right one or none. Files are written beside their place and moved into it, so
that nobody sees half of one. As nothing is shared, nothing is locked: it holds between processes,
containers and machines, on any file system. A file from an older source is written over.

Where another version of numba keeps its files in another way, it is left to do so (`is_safe` says
no, and then nobody compiles side by side).
"""

import functools
import hashlib
import inspect
import os
import pickle
import uuid
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

__all__ = ["SignatureFiles", "is_safe", "keep"]

CALLS = {"save": ["self", "key", "data"], "load": ["self", "key"], "flush": ["self"]}
"""What numba's cache asks of its files."""


class SignatureFiles:
    """The files of one kernel; it stands where numba has its `IndexDataCacheFile`."""

    def __init__(self, folder: str | Path, name: str, stamp: object) -> None:
        """Take a place for the files.

        Args:
            folder: where they lie. name: what their names begin with, of one function alone.
            stamp: says of which source they are; any value that can be pickled and compared.
        """
        import numba

        self._folder = Path(folder)
        self._name = name
        self._head = (numba.__version__, stamp)

    def save(self, key: object, data: object) -> None:
        """Write what was compiled for a key: signature, processor and hash of the code.

        What another process wrote meanwhile stays: it may have been loaded already.
        """
        if self.load(key) is not None:
            return
        import numba.core.serialize

        dumps: Callable[[object], bytes] = numba.core.serialize.dumps
        path = self._path(key)
        beside = path.with_name(f"{path.name}.tmp.{uuid.uuid4().hex[:16]}")
        try:
            with beside.open("wb") as file:
                pickle.dump(self._head, file)  # first: what another numba pickled may not load
                file.write(dumps(key))
                file.write(dumps(data))
            os.replace(beside, path)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise

    def load(self, key: object) -> Any:
        """Return what was compiled for a key, or None where there is none from this source."""
        try:
            with self._path(key).open("rb") as file:
                if pickle.load(file) != self._head or pickle.load(file) != key:
                    return None
                return pickle.load(file)
        except (FileNotFoundError, EOFError, pickle.UnpicklingError):  # none, or cut by a crash
            return None

    def flush(self) -> None:
        """Delete them all."""
        for path in self._folder.glob(f"{self._name}.*.nbc"):
            path.unlink(missing_ok=True)

    def _path(self, key: object) -> Path:
        digest = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return self._folder / f"{self._name}.{digest}.nbc"


def keep(dispatcher: Any) -> None:
    """Let a compiled function keep its machine code on disk, so that many processes may.

    Args:
        dispatcher: what `numba.njit` returned; a plain function, where its compiler is switched
            off, is left as it is.
    """
    if not hasattr(dispatcher, "enable_caching"):
        return
    dispatcher.enable_caching()
    cache = getattr(dispatcher, "_cache", None)
    files: Any = getattr(cache, "_cache_file", None)
    kind: Any = type(files)
    folder, stamp = getattr(files, "_cache_path", None), getattr(files, "_source_stamp", None)
    name = getattr(getattr(cache, "_impl", None), "filename_base", None)
    if cache is not None and folder and stamp and name and _is_known(kind):
        cache._cache_file = SignatureFiles(folder, name, stamp)


def is_safe(dispatcher: object) -> bool:
    """Whether several processes may compile a function at once and find each other's work."""
    cache = getattr(dispatcher, "_cache", None)
    return isinstance(getattr(cache, "_cache_file", None), SignatureFiles)


@functools.cache
def _is_known(files: Hashable) -> bool:
    """Whether a class of numba's has just the methods that `SignatureFiles` stands in for."""
    public = {n: m for n, m in vars(files).items() if inspect.isfunction(m) and n[0] != "_"}
    return {n: list(inspect.signature(m).parameters) for n, m in public.items()} == CALLS
