"""The simulated world as a source: names, files, and what is wrong with them."""

from pathlib import Path

import numpy as np
import pytest

from odomap.errors import ConfigError, InputError
from odomap.simulation.export import export_euroc
from odomap.simulation.world import WorldSpec
from odomap.sources.euroc import EurocSource
from odomap.sources.simulated import SimulatedSource, is_simulated, read_spec
from odomap.sources.source import Source

SMALL = "sim:room?seed=3&frames=3&resolution=96x64&sensors=stereo,imu"


@pytest.fixture(scope="module")
def source() -> SimulatedSource:
    return SimulatedSource(SMALL)


def test_it_is_a_source_that_starts_anew_each_time(source: SimulatedSource) -> None:
    assert isinstance(source, Source)
    assert len(source) == 3
    assert source.truth is not None
    first, second = list(source), list(source)
    assert [f.id for f in first] == [0, 1, 2]
    assert [f.stamp_ns for f in first] == source.truth.stamps_ns.tolist()
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.images[1], b.images[1])
        assert len(a.images) == len(source.rig.cameras) == 2


def test_names_and_files_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "world.yaml").write_text(
        "odomap_world: 1\nkind: room\nseed: 3\nframes: 3\nresolution: [96, 64]\n"
        "sensors: [stereo, imu]\nnoise: 1\n"
    )
    wanted = WorldSpec("room", 3, 3, resolution=(96, 64))
    assert read_spec(tmp_path) == read_spec(tmp_path / "world.yaml") == read_spec(SMALL) == wanted
    assert read_spec("sim:street") == WorldSpec("street")
    assert is_simulated(tmp_path)
    assert is_simulated("sim:room")
    assert not is_simulated(tmp_path / "elsewhere")


def test_a_name_may_choose_the_lens() -> None:
    source = SimulatedSource("sim:room?lens=double_sphere&frames=1&resolution=96x64")
    assert {m.camera.model for m in source.rig.cameras} == {"double_sphere"}
    assert next(iter(source)).images[0].shape == (64, 96)
    with pytest.raises(ConfigError, match=r"lens: 'kanala_brandt'.*did you mean 'kannala_brandt'"):
        read_spec("sim:room?lens=kanala_brandt")


def test_exported_images_come_back_through_the_euroc_reader(
    source: SimulatedSource, tmp_path: Path
) -> None:
    back = EurocSource(export_euroc(source.world, tmp_path))
    assert len(back) == len(source)
    assert back.truth is not None
    assert source.truth is not None
    for frame, original in zip(back, source, strict=True):
        assert frame.stamp_ns == original.stamp_ns
        np.testing.assert_array_equal(frame.images[0], original.images[0])
        np.testing.assert_array_equal(frame.images[1], original.images[1])
    np.testing.assert_allclose(
        back.truth.Ts_world_body, source.truth.Ts_world_body, rtol=0, atol=1e-12
    )
    for mount, original_mount in zip(back.rig.cameras, source.rig.cameras, strict=True):
        np.testing.assert_allclose(
            mount.T_body_camera.matrix, original_mount.T_body_camera.matrix, atol=1e-12
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("odomap_world: 1\nframs: 10\n", "no field 'frams' (did you mean 'frames'?)"),
        ("odomap_word: 1\nframes: 10\n", "'odomap_world' is missing (did you mean 'odomap_word'?)"),
        ("odomap_world: 2\n", "version 2 is not known"),
        ("odomap_world: 1\nframes: ten\n", "frames: 'ten' is not a whole number"),
        ("odomap_world: 1\nframes: 2.5\n", "frames: '2.5' is not a whole number"),
        ("odomap_world: 1\nnoise: yes\n", "noise: 'True' is not a number"),
        ("odomap_world: 1\nresolution: 640\n", "resolution: '640' is not two whole numbers"),
        ("odomap_world: 1\nkind: rooom\n", "did you mean 'room'?"),
        ("- a\n- b\n", "add 'odomap_world: 1'"),
        ("", "add 'odomap_world: 1'"),
        ("a: [b\n", "not a YAML file"),
    ],
)
def test_wrong_files_are_named_with_the_mend(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "world.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        SimulatedSource(path)
    assert message in str(error.value)
    assert "world.yaml" in str(error.value)
    assert "\n" not in str(error.value)


def test_wrong_names_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'street'"):
        read_spec("sim:stret")
    with pytest.raises(ConfigError, match="did you mean 'seed'"):
        read_spec("sim:room?sed=3")
    with pytest.raises(InputError, match="cannot be read"):
        read_spec(tmp_path / "world.yaml")


def test_it_can_be_played_there_and_back(source: SimulatedSource) -> None:
    from odomap.sources.disturb import there_and_back

    frames = list(source)
    assert [f.stamp_ns for f in frames] == source.stamps_ns.tolist()
    assert np.array_equal(source.frame(1).images[0], frames[1].images[0])
    assert len(list(there_and_back(source))) == len(source)
