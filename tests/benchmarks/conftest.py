import importlib
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def folder():
    """Return the folder of the benchmarks; the source package comes without it."""
    if not FOLDER.is_dir():
        pytest.skip("the benchmarks are in the repository, not in the source package")
    return FOLDER


@pytest.fixture
def load(folder, monkeypatch):
    """Return a function that imports a benchmark as running it does: its folder is on the path."""
    monkeypatch.syspath_prepend(str(folder))
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if (folder / f"{name}.py").exists():
            del sys.modules[name]
