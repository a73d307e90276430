"""Compiled kernels on disk: right or none, however many processes write them at once."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from odomap import kernelfiles
from odomap.kernelfiles import SignatureFiles, is_safe, keep

KEY = (("array(float64, 1d, C)",), ("x86", "cpu"), ("code", "cells"))

KERNELS = "from odomap.kernels import kernel\n" + "".join(
    f"""
@kernel
def k{i}(values):
    total = values[0] * 0 + {i}
    for value in values:
        total += value
    return total
"""
    for i in range(12)
)

RACE = """
import sys, time
from pathlib import Path
import numpy as np
import manykernels

me, count, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
types = (np.int64, np.float64, np.complex128, np.int32)
values = [np.arange(5).astype(t) * (1j if t is np.complex128 else 1) for t in types]
for i in range(12):
    compiled = getattr(manykernels, f"k{i}")
    if me >= 0:  # one of those that race: all start each kernel at once
        (folder / f"{i}.{me}").touch()
        while len(list(folder.glob(f"{i}.*"))) < count:
            time.sleep(0.0005)
        compiled(values[me])
        continue
    for v in values:  # the judge, who compiles nothing and finds everything right
        assert compiled(v) == v.sum() + i, (i, v, compiled(v))
        assert type(compiled(v)) is type((v[0] * 2).item()), (i, v)
    assert not compiled.stats.cache_misses, (i, compiled.stats)
    assert len(compiled.signatures) == len(values)
"""


@pytest.fixture
def files(tmp_path):
    return SignatureFiles(tmp_path, "module.name-7.py311", "stamp")


def test_what_is_saved_is_loaded(files, tmp_path):
    assert files.load(KEY) is None
    files.save(KEY, ("binary", 1))
    other = (*KEY[:2], ("code", "other"))
    files.save(other, ("binary", 2))
    assert files.load(KEY) == ("binary", 1)
    assert files.load(other) == ("binary", 2)
    assert len(list(tmp_path.iterdir())) == 2
    files.flush()
    assert files.load(KEY) is None


def test_what_is_there_stays(files):
    """Another process may have loaded it, and a second compilation may differ in its last bits."""
    files.save(KEY, "first")
    files.save(KEY, "second")
    assert files.load(KEY) == "first"


def test_what_an_older_source_left_is_not_loaded_and_written_over(files, tmp_path):
    files.save(KEY, "old")
    newer = SignatureFiles(tmp_path, "module.name-7.py311", "newer")
    assert newer.load(KEY) is None
    newer.save(KEY, "new")
    assert newer.load(KEY) == "new"
    assert files.load(KEY) is None
    assert len(list(tmp_path.iterdir())) == 1


def test_a_file_says_whose_it_is(files, monkeypatch):
    monkeypatch.setattr(SignatureFiles, "_path", lambda self, key: self._folder / "same.nbc")
    files.save(KEY, "its own")  # two keys with the same hash
    assert files.load(("another",)) is None
    assert files.load(KEY) == "its own"


@pytest.mark.parametrize("length", [0, 5, -3])
def test_a_file_that_was_cut_is_none(files, tmp_path, length):
    files.save(KEY, "x" * 1000)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:length])
    assert files.load(KEY) is None


def test_what_cannot_be_written_leaves_nothing_behind(files, tmp_path):
    with pytest.raises(TypeError):
        files.save(KEY, (line for line in ()))
    assert list(tmp_path.iterdir()) == []


def test_processes_that_compile_a_kernel_for_different_types_at_once(tmp_path):
    (tmp_path / "manykernels.py").write_text(KERNELS)
    path = os.pathsep.join([str(tmp_path), *sys.path])
    environ = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    (tmp_path / "starts").mkdir()

    def start(me):
        command = [sys.executable, "-c", RACE, str(me), "4", str(tmp_path / "starts")]
        return subprocess.Popen(command, env=environ, stderr=subprocess.PIPE, text=True)

    for who in (range(4), [-1]):
        for process in [start(me) for me in who]:
            _, errors = process.communicate(timeout=120)
            assert process.returncode == 0, errors


def compiled_here(**options):
    import numba

    def twice(x):
        return x + x

    return numba.njit(**options)(twice)


def test_a_kernel_kept_is_safe():
    compiled = compiled_here()
    assert not is_safe(compiled)
    keep(compiled)
    assert is_safe(compiled)
    assert compiled(np.float32(2)) == 4
    assert not is_safe(compiled_here(cache=True))
    assert not is_safe(len)


def test_another_numba_is_left_to_itself(monkeypatch):
    monkeypatch.setitem(kernelfiles.CALLS, "load", ["self", "key", "more"])
    kernelfiles._is_known.cache_clear()
    try:
        compiled = compiled_here()
        keep(compiled)
        assert not is_safe(compiled)
        assert compiled._cache.cache_path
        assert compiled(3) == 6
    finally:
        kernelfiles._is_known.cache_clear()


def test_without_a_compiler_there_is_nothing_to_keep():
    plain = SimpleNamespace()
    keep(plain)
    assert not vars(plain)
