"""Modules of kernels are shared out among processes, none is lost, and no process stays behind."""

import os
import signal
import subprocess
import sys
import time
from importlib import import_module

import pytest

from odomap import compiling
from odomap.compiling import _Share

SMALL = [f"tiny.{name}" for name in "abcdef"]

KERNEL = """
from odomap.kernels import kernel
{imported}

@kernel
def {name}(x):
    return {returned}

def warm_up():
    {name}(2.0)
"""

BEGIN = f"""
import os, signal, sys, time
from odomap import compiling, kernels
names = {SMALL!r}
compiling.num_cores, compiling.total_memory_gb = (lambda: 2), (lambda: 8.0)
started, told, start = [], [], compiling._start
compiling._start = lambda: started.append(start()) or started[-1]


def count(which):
    found = {{k for n in names for k in vars(sys.modules[n]).values() if hasattr(k, "stats")}}
    return sum(sum(getattr(k.stats, which).values()) for k in found)


def compile_all():
    compiling.compile_modules(names, lambda *step: told.append(step))


"""


@pytest.fixture
def tiny(tmp_path):
    """Return the folder of a package of six modules with a kernel each; each calls the last."""
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "__init__.py").touch()
    for name, last in zip("abcdef", " abcde"):
        imported = f"from tiny.{last} import {last}" if name != "a" else ""
        returned = f"1.0 + {last}(x)" if name != "a" else "x * x"
        text = KERNEL.format(name=name, imported=imported, returned=returned)
        (tmp_path / "tiny" / f"{name}.py").write_text(text)
    return tmp_path


def begun(folder, script, **environ):
    """Start a script where `tiny` is; it has no guard around what it does."""
    known = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    return subprocess.Popen(
        [sys.executable, "-c", BEGIN + script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**known, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]), **environ},
    )


def printed(folder, script, **environ):
    """Return the words that a script prints."""
    process = begun(folder, script, **environ)
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert errors == ""
    return out.split()


def test_two_helpers_compile_and_who_comes_after_them_calls_nobody(tiny):
    """All but the first module is loaded as those after this run will: for the same bytes."""
    script = "compile_all(); done = [step[0] for step in told]; helper = started[0].returncode; "
    script += "compile_all(); print(len(started), helper is not None, count('cache_misses'), "
    script += "count('cache_hits'), *done)"
    helpers, ended, misses, hits, *done = printed(tiny, script)
    assert (helpers, ended, misses, hits) == ("2", "True", "1", "5")
    counts = [int(count) for count in done]
    assert counts == sorted(counts)
    assert counts[-1] < len(SMALL)
    again = "compile_all(); print(len(started), count('cache_misses'), count('cache_hits'))"
    assert printed(tiny, again) == ["0", "0", "6"]


@pytest.mark.parametrize("off", ["ODOMAP_PLAIN", "NUMBA_DISABLE_JIT"])
def test_nobody_is_called_where_nothing_is_compiled(tiny, off):
    assert printed(tiny, "compile_all(); print(len(started))", **{off: "1"}) == ["0"]


def test_a_helper_that_dies_is_done_without(tiny):
    script = "compiling.ENTRY = 'raise SystemExit(3)'; compile_all(); "
    script += "print(len(started), count('cache_misses'))"
    assert printed(tiny, script) == ["2", "6"]


def test_an_error_is_raised_and_ends_the_helper(tiny):
    script = """
real = kernels.warm_up
def fail(name):
    if started:
        raise TypeError("no such type")
    return real(name)
kernels.warm_up = fail
try:
    compile_all()
except TypeError as error:
    print(len(started), started[0].returncode is not None, error)
"""
    assert printed(tiny, script) == ["2", "True", "no", "such", "type"]


@pytest.mark.skipif(sys.platform == "win32", reason="looks for processes as POSIX has them")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_helpers_end_with_their_caller(tiny, how):
    script = """
def wait(*step):
    if len(started) > 1:
        print(started[0].pid, flush=True)
        time.sleep(100)
compiling.compile_modules(names, wait)
"""
    process = begun(tiny, script)
    helper = int(process.stdout.readline())
    os.kill(helper, 0)  # it is there
    process.send_signal(how)
    process.communicate(timeout=20)
    end = time.monotonic() + 20
    while is_alive(helper):
        assert time.monotonic() < end, "a helper outlived its caller"
        time.sleep(0.05)


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True)
    return not stat.stdout.strip().startswith("Z") and stat.stdout.strip() != ""


def test_a_module_is_taken_once_and_after_what_it_imports(tmp_path):
    calls = {"a": set(), "b": {"a"}, "c": set(), "d": {"b", "c"}}
    caller = _Share(tmp_path, calls)
    helper = _Share(tmp_path, calls, 1)
    assert (caller.take(), helper.take(), caller.take()) == ("a", "c", None)
    caller.finish("a")
    assert (caller.take(), helper.take()) == ("b", None)
    caller.free(1)  # the helper died with c in hand
    caller.finish("b")
    assert caller.take() == "c"
    caller.finish("c")
    assert caller.take() == "d"
    assert caller.names("free") == set()
    assert caller.names("done") == {"a", "b", "c"}


def test_modules_come_after_those_they_import():
    names = ["odomap.backend.sparse.multifrontal", "odomap.backend.sparse.symbolic"]
    names += ["odomap.backend.sparse.blocks", "odomap.vision.turning"]
    for name in names:
        import_module(name)
    calls = compiling._calls(names)
    order = list(calls)
    assert order.index(names[2]) < order.index(names[1]) < order.index(names[0])
    assert {names[1], names[2]} <= calls[names[0]]
    assert calls["odomap.vision.turning"] == set()
    assert all(set(order[: order.index(n)]) >= calls[n] for n in order)


@pytest.mark.parametrize(
    ("cores", "memory", "helpers"),
    [(1, 8, 0), (2, 8, 2), (64, 64, 4), (8, 2.1, 2), (8, 1.5, 0), (8, 0, 2)],
)
def test_how_many_help(monkeypatch, cores, memory, helpers):
    monkeypatch.setattr(compiling, "num_cores", lambda: cores)
    monkeypatch.setattr(compiling, "total_memory_gb", lambda: float(memory))
    assert compiling._num_helpers() == helpers


def test_a_program_that_is_no_python_is_not_started_again(monkeypatch):
    monkeypatch.setattr(compiling, "num_cores", lambda: 2)
    monkeypatch.setattr(sys, "executable", "/opt/robot/bin/robot")
    assert compiling._num_helpers() == 0
