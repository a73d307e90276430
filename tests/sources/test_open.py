"""Opening by guessing: what is there is recognised, what is not is explained."""

import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest

from odomap.errors import CalibrationError, InputError
from odomap.files.rig import write_rig
from odomap.sensors.rig import Rig
from odomap.sources.euroc import EurocSource
from odomap.sources.kitti import KittiSource
from odomap.sources.open import open as open_source

Make = Callable[..., Path]


def test_formats_are_recognised(euroc: Make, kitti: Make) -> None:
    mav0, sequence = euroc(), kitti()
    for path in (mav0, mav0.parent, str(mav0.parent)):
        assert isinstance(open_source(path), EurocSource)
        assert open_source(path).name == "MH_00"
    assert isinstance(open_source(sequence), KittiSource)
    assert isinstance(open_source(str(sequence) + "/"), KittiSource)


def test_simulated_worlds_are_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []

    class SimulatedSource:
        def __init__(self, spec: str) -> None:
            opened.append(spec)

    module = types.ModuleType("odomap.sources.simulated")
    module.SimulatedSource = SimulatedSource  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "odomap.sources.simulated", module)
    (tmp_path / "world.yaml").write_text("odomap_world: 1\n")
    open_source("sim:room?seed=3&frames=2")
    open_source(tmp_path)
    open_source(tmp_path / "world.yaml")
    world = str(tmp_path / "world.yaml")
    assert opened == ["sim:room?seed=3&frames=2", world, world]
    with pytest.raises(InputError, match="has its own rig"):
        open_source("sim:room", Rig())


def test_missing_path_names_the_nearest(tmp_path: Path, euroc: Make) -> None:
    euroc()
    with pytest.raises(InputError, match=r"MH_0: does not exist \(did you mean 'MH_00'\?\)"):
        open_source(tmp_path / "MH_0")
    with pytest.raises(InputError, match=r"mav: does not exist \(did you mean 'mav0'\?\)"):
        open_source(tmp_path / "MH_00" / "mav")
    with pytest.raises(InputError, match=r"x: does not exist \(did you mean 'MH_00'\?\)"):
        open_source(tmp_path / "MH_OO" / "x")
    with pytest.raises(InputError, match=r"does not exist$"):
        open_source(tmp_path / "something else")


def test_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the folder is empty; supported are EuRoC .* KITTI"):
        open_source(tmp_path)


def test_unrecognised_folder_says_what_it_holds(tmp_path: Path) -> None:
    for name in ("a.txt", "b.txt", "c", "d", "e", "f"):
        (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=r"it holds a\.txt, b\.txt, c, d, e, \.\.\..*supported"):
        open_source(tmp_path)


def test_unrecognised_file(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3")
    with pytest.raises(InputError, match="files of this kind cannot be opened; supported are"):
        open_source(tmp_path / "a.xyz")


def test_folder_that_may_not_be_read(kitti: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    root = kitti()

    def refuse(self: Path) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(InputError, match=r"image_0: Permission denied"):
        open_source(root)


def test_around_a_recording(euroc: Make, kitti: Make, tmp_path: Path) -> None:
    mav0 = euroc()
    with pytest.raises(InputError, match=rf"holds one: open {mav0.parent}$"):
        open_source(tmp_path)
    with pytest.raises(InputError, match=rf"is a part of a recording: open {mav0}$"):
        open_source(mav0 / "cam0" / "data")
    sequence = kitti()
    with pytest.raises(InputError, match=rf"is a part of a recording: open {sequence}$"):
        open_source(sequence / "image_0")


def test_folder_without_a_camera(euroc: Make) -> None:
    mav0 = euroc()
    for name in ("cam0", "cam1"):
        (mav0 / name).rename(mav0 / f"no_{name}")
    with pytest.raises(InputError, match="not recognised"):
        open_source(mav0.parent)


def test_rig_of_the_user(kitti: Make, tmp_path: Path) -> None:
    sequence = kitti()
    rig = open_source(sequence).rig
    write_rig(tmp_path / "mine.yaml", Rig(rig.cameras[:1]))
    assert len(open_source(sequence, tmp_path / "mine.yaml").rig.cameras) == 1
    assert len(open_source(sequence, str(tmp_path / "mine.yaml")).rig.cameras) == 1
    # A rig.yaml in the folder counts where the recording has no calibration.
    write_rig(sequence / "rig.yaml", Rig(rig.cameras[:1]))
    assert len(open_source(sequence).rig.cameras) == 2
    (sequence / "calib.txt").unlink()
    assert len(open_source(sequence).rig.cameras) == 1
    (sequence / "rig.yaml").unlink()
    with pytest.raises(CalibrationError, match="or give --rig"):
        open_source(sequence)


def test_an_empty_file_is_said_to_be_empty(tmp_path: Path) -> None:
    (tmp_path / "a.pcap").write_bytes(b"")
    with pytest.raises(InputError, match=r"a\.pcap: is empty"):
        open_source(tmp_path / "a.pcap")
