"""The face: every public name is there, and importing it costs nothing."""

import subprocess
import sys

import pytest

import odomap


@pytest.mark.parametrize("name", odomap.__all__)
def test_every_public_name_loads(name):
    assert getattr(odomap, name) is not None


def test_names_are_listed_once_and_in_dir():
    assert len(set(odomap.__all__)) == len(odomap.__all__)
    assert set(dir(odomap)) == set(odomap.__all__)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Slamm'"):
        odomap.Slamm  # noqa: B018


@pytest.mark.parametrize("statement", ["import odomap", "import odomap.cli", "odomap.SE3.identity"])
def test_import_loads_nothing_heavy(statement):
    code = f"import odomap, sys; {statement}; print(*sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = {name.split(".")[0] for name in result.stdout.split()}
    assert not loaded & {"numba", "cv2", "scipy", "matplotlib"}


def test_run_is_callable_whatever_was_imported_before():
    code = "import odomap.run, odomap; from odomap.run import RunResult; odomap.run('/no/such')"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "InputError" in result.stderr
    assert "not callable" not in result.stderr
