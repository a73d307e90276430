"""The doctor: finds what is broken, and says how to mend it."""

import importlib.metadata

import pytest

from odomap import doctor


def test_a_sound_installation_has_nothing_broken():
    findings = list(doctor.examine())
    assert [f for f in findings if f.state == "broken"] == []
    names = {f.name for f in findings}
    assert {"odomap", "python", "cores", "numpy", "opencv-python-headless", "kernel cache"} <= names


def test_a_second_opencv_is_found_with_its_mend(monkeypatch):
    real = importlib.metadata.version

    def version(name):
        return "4.10.0" if name == "opencv-python" else real(name)

    monkeypatch.setattr(doctor, "version", version)
    (finding,) = doctor.examine_opencv()
    assert finding.state == "broken"
    assert "opencv-python 4.10.0" in finding.text
    assert finding.mend.startswith("pip uninstall -y opencv-python opencv-python-headless")


def test_a_library_that_does_not_import_is_found(monkeypatch):
    monkeypatch.setitem(doctor.CORE, "no-such-thing", "no_such_module")
    broken = [f for f in doctor.examine_core() if f.state == "broken"]
    assert [f.name for f in broken] == ["no-such-thing"]
    assert "pip install" in broken[0].mend


def test_missing_extras_say_what_to_type(monkeypatch):
    monkeypatch.setattr(doctor, "installed", lambda name: "")
    findings = list(doctor.examine_extras())
    assert {f.mend for f in findings} == {
        "pip install 'odomap[ros]'",
        "pip install 'odomap[view]'",
        "pip install 'odomap[learned]'",
    }
    assert {f.state for f in findings} == {"note"}


def test_an_unwritable_cache_is_found(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocked))
    (finding,) = doctor.examine_cache()
    assert finding.state == "broken"
    assert "NUMBA_CACHE_DIR" in finding.mend


def test_a_kernel_that_does_not_compile_is_found(monkeypatch):
    def fail(name):
        raise TypeError("no such type\nand a long story")

    name = "odomap.vision.turning"
    monkeypatch.setattr("odomap.kernels.modules_with_kernels", lambda: [name])
    monkeypatch.setattr("odomap.kernels.warm_up", fail)
    seen = []
    finding = doctor.compile_kernels(lambda *step: seen.append(step))
    assert finding.state == "broken"
    assert f"{name} does not compile: TypeError: no such type" in finding.text
    assert set(seen) == {(0, 1, name)}


def test_a_module_that_does_not_import_is_named(monkeypatch):
    monkeypatch.setattr("odomap.kernels.modules_with_kernels", lambda: ["odomap.a"])
    finding = doctor.compile_kernels(lambda *step: None)
    assert finding.state == "broken"
    assert "odomap.a does not compile: ModuleNotFoundError: No module named" in finding.text


@pytest.mark.parametrize("name", ["does/not/exist", "."])
def test_writable_looks_at_the_nearest_parent_that_exists(name, tmp_path):
    assert doctor.is_writable(tmp_path / name)
