"""Compile kernels before they are needed, several modules at once where nothing is cached.

Numba compiles under a lock of the whole process, so threads do not help, but processes do, as each
finds on disk what the others left (`kernelfiles`). A process begins alone: as long as all is loaded
from the cache, nobody is called. The first kernel that has to be compiled calls helpers: the same
interpreter on the same paths, which compiles until all modules are taken, and goes. The caller
waits and loads what they left, as every later run will: the same code compiled twice may differ in
the order of a sum, and a run that compiled must give the same bytes as those after it.

Modules are shared out through a folder of empty files, whose names say how far each of them is:
`a.free` becomes `a.by1` when helper 1 takes it, and then `a.done`. Renaming is atomic, so one alone
gets it. A module is taken after those it imports, or two processes would both compile what both
call; and of those that may be taken, first the one on which most source code waits. This list
scheduling (Graham, Bounds on multiprocessing timing anomalies, SIAM J. Appl. Math. 1969) leaves two
processes idle for less than a tenth of the time.

A helper that fails or dies is no error: what it had is free again, and where none is left the
caller compiles it and finds out what is wrong. Helpers end with their caller, however that ends:
their stdin is a pipe from it.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import IO

from odomap import kernels
from odomap.kernelfiles import is_safe
from odomap.machine import num_cores, total_memory_gb

__all__ = ["Tell", "compile_modules", "help_compiling"]

Tell = Callable[[int, int, str], None]
"""Progress: modules done, modules in all, which is next."""

MOST = 4
"""Helpers at most."""
GB_EACH = 1.0
"""Memory of the machine that there must be for each of them."""
FEW = 4
"""So few modules are not shared out."""
PAUSE_S = 0.02
"""Between two looks whether a module has become free."""
ENTRY = (
    "import json, sys; given = json.loads(sys.stdin.readline()); sys.path[:] = given.pop('paths'); "
    "from odomap.compiling import help_compiling; help_compiling(**given)"
)


def compile_modules(names: Iterable[str], tell: Tell) -> None:
    """Compile all kernels of modules, or load them from the cache, in up to `MOST` processes.

    Args:
        names: dotted names of modules with kernels.
        tell: called before each module with how many are done, how many there are, and its name.

    Raises:
        Exception: whatever a module's `warm_up` raises.
    """
    names = list(names)
    for name in names:
        if name not in sys.modules:
            tell(0, len(names), name)
            import_module(name)
    calls = _calls(names)
    left, total, helpers = list(calls), len(calls), 0
    while left and not helpers:
        name = left.pop(0)
        tell(total - len(left) - 1, total, name)
        before = _num_compiled(name)
        kernels.warm_up(name)
        if _num_compiled(name) > before and len(left) > FEW:
            helpers = _num_helpers()
    if not left:
        return
    with tempfile.TemporaryDirectory(prefix="odomap-") as folder:
        share = _Share(Path(folder), {name: calls[name] & set(left) for name in left})
        with _helpers(share, helpers) as running:
            others = _compile_with(share, running, lambda done, name: tell(done, total, name))
    for name in others:  # from the cache, where the helpers left them
        kernels.warm_up(name)


def help_compiling(folder: str, calls: dict[str, list[str]], me: int) -> None:
    """Compile modules of a folder of tasks until all are taken; what a helper process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the caller's to answer
    threading.Thread(target=_go_with_caller, daemon=True).start()
    share = _Share(Path(folder), {name: set(others) for name, others in calls.items()}, me)
    while share.names("free"):
        if name := share.take():
            kernels.warm_up(name)
            share.finish(name)
        else:
            time.sleep(PAUSE_S)


class _Share:
    """Modules shared out among processes, each module an empty file in one folder."""

    def __init__(self, folder: Path, calls: dict[str, set[str]], me: int = 0) -> None:
        self.folder, self.calls, self._mine = folder, calls, f"by{me}"
        if me == 0:  # the caller, who lays them out
            for name in calls:
                (folder / f"{name}.free").touch()

    def names(self, state: str) -> set[str]:
        """Return the modules that are "free", "done" or taken ("by1")."""
        files = (file.rpartition(".") for file in os.listdir(self.folder))
        return {name for name, _, suffix in files if suffix == state}

    def take(self) -> str | None:
        """Take the first free module, of those whose imports are done."""
        done = self.names("done")
        free = self.names("free") - done
        for name in self.calls:
            if name in free and self.calls[name] <= done and self._move(name, "free", self._mine):
                return name
        return None

    def finish(self, name: str) -> None:
        """Say that a module that was taken is compiled."""
        self._move(name, self._mine, "done")

    def free(self, dead: int) -> None:
        """Let others take what a helper left behind."""
        for name in self.names(f"by{dead}"):
            self._move(name, f"by{dead}", "free")

    def _move(self, name: str, old: str, new: str) -> bool:
        try:
            (self.folder / f"{name}.{old}").rename(self.folder / f"{name}.{new}")
        except FileNotFoundError:  # another was faster
            return False
        return True


def _compile_with(
    share: _Share, helpers: "list[subprocess.Popen[bytes]]", tell: Callable[[int, str], None]
) -> list[str]:
    """Wait until all modules are done, or compile them; return those that helpers have done."""
    mine: set[str] = set()
    told = -1
    while len(done := share.names("done")) < len(share.calls):
        if len(done) > told and (now := share.names(f"by{1 + len(done) % max(len(helpers), 1)}")):
            told = len(done)
            tell(told, min(now))
        is_gone = [helper.poll() is not None for helper in helpers]
        for number, gone in enumerate(is_gone, start=1):
            if gone:
                share.free(number)
        if all(is_gone) and (name := share.take()):
            tell(len(done), name)
            kernels.warm_up(name)
            share.finish(name)
            mine.add(name)
        else:
            time.sleep(PAUSE_S)
    return [name for name in share.calls if name not in mine]


@contextlib.contextmanager
def _helpers(share: _Share, number: int) -> "Iterator[list[subprocess.Popen[bytes]]]":
    """Start helpers, and end them when the block ends, in whatever way."""
    running: list[subprocess.Popen[bytes]] = []
    calls = {name: sorted(others) for name, others in share.calls.items()}
    given = {"paths": sys.path, "folder": str(share.folder), "calls": calls}
    try:
        for _ in range(number):
            with contextlib.suppress(OSError):  # no memory, no right to, or dead: then without
                running.append(_start())
                _send(running[-1], {**given, "me": len(running)})
        yield running
    finally:
        for helper in running:
            helper.kill()
        for helper in running:
            helper.wait()
            with contextlib.suppress(OSError):  # what it did not read
                _pipe(helper).close()


def _start() -> "subprocess.Popen[bytes]":
    nowhere = subprocess.DEVNULL
    window = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # none on Windows; elsewhere none anyway
    command = [sys.executable, "-c", ENTRY]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere, creationflags=window
    )


def _send(helper: "subprocess.Popen[bytes]", given: dict[str, object]) -> None:
    pipe = _pipe(helper)
    pipe.write(json.dumps(given).encode() + b"\n")
    pipe.flush()


def _pipe(helper: "subprocess.Popen[bytes]") -> IO[bytes]:
    assert helper.stdin is not None
    return helper.stdin


def _go_with_caller() -> None:
    """End this process when the other end of its stdin is closed, as it is when a process ends."""
    while os.read(0, 4096):
        pass
    os._exit(1)


def _num_helpers() -> int:
    """Return how many processes to start: one for each core and gigabyte; none for a single one."""
    is_python = Path(sys.executable or "").stem.lower().startswith("python")
    if not is_python or getattr(sys, "frozen", False):  # starting it would start the program again
        return 0
    memory_gb = total_memory_gb()
    most = min(MOST, num_cores(), int(memory_gb / GB_EACH) if memory_gb else 2)
    return most if most > 1 else 0


def _num_compiled(name: str) -> int:
    """Count the kernels of a module compiled by now, and kept where other processes may, too."""
    found = [k for k in vars(sys.modules[name]).values() if is_safe(k)]
    return sum(sum(k.stats.cache_misses.values()) for k in found)


def _calls(wanted: list[str]) -> dict[str, set[str]]:
    """Return which of some imported modules each imports, over any number of others, in order.

    The order is that of list scheduling: first come those on which most source code waits.
    """
    rooms = tuple({name.partition(".")[0] + "." for name in wanted})
    package = {n: m for n, m in sys.modules.items() if n.startswith(rooms)}
    imports = {name: _imported(module) & set(package) for name, module in package.items()}
    calls = {name: _reached(name, imports) & set(wanted) for name in wanted}
    size = {name: Path(str(package[name].__file__)).stat().st_size for name in wanted}
    waiting = {n: sum(size[m] for m in wanted if n in calls[m] or n == m) for n in wanted}
    order = sorted(wanted, key=lambda n: (-waiting[n], n))  # what is imported comes before
    return {n: calls[n] & set(order[:i]) for i, n in enumerate(order)}  # so none waits in a circle


def _imported(module: ModuleType) -> set[str]:
    """Return the modules whose functions and classes are in a module's namespace."""
    return {str(getattr(value, "__module__", "")) for value in vars(module).values()}


def _reached(name: str, imports: dict[str, set[str]]) -> set[str]:
    """Return all modules that one imports, and those import, and so on, but itself."""
    reached: set[str] = set()
    left = imports[name]
    while left:
        reached |= left
        left = set[str]().union(*(imports[n] for n in left)) - reached
    return reached - {name}
