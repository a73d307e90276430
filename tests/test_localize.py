"""Saved maps used again: what is refused, in one line, before a frame is tracked."""

from dataclasses import replace

import numpy as np
import pytest

from mapworlds import features
from odomap.cli import main
from odomap.errors import InputError
from odomap.files.mapfile import save_map
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.localize import continue_map, localize
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.savedmap import SavedMap, rig_differences
from odomap.sensors.rig import CameraMount, DepthMount, Rig
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World
from odomap.sources.open import open as open_source


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Return a recording of a stereo pair, two frames long."""
    folder = tmp_path_factory.mktemp("recordings") / "pair"
    export_euroc(World.make(kind="room", seed=3, frames=2, resolution=(320, 200)), folder)
    return folder


def small_map(width=32, landmarks=True):
    """One keyframe with features, and landmarks seen at some of them."""
    rng = np.random.default_rng(0)
    m = Map()
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 0, features=features(rng, 30, width)), np.eye(4))
    if landmarks:
        ids = m.add_landmarks(0, rng.normal(size=(20, 3)))
        m.add_observations(0, ids, np.arange(20))
    return m


@pytest.fixture
def refused(tmp_path, pair, monkeypatch, capsys):
    """Say why a map and a recording are refused by both verbs, and that nothing was written."""
    monkeypatch.chdir(tmp_path)

    def call(saved, *words, data=pair):
        said = set()
        for verb in ("localize", "continue"):
            assert main([verb, str(saved), str(data), "--quiet", *words]) == 2
            out, err = capsys.readouterr()
            assert out == ""
            assert err.count("\n") == 1
            said.add(err)
        assert not (tmp_path / "runs").exists()
        assert len(said) == 1
        return said.pop()

    return call


def saved(folder, m, rig=None, **settings):
    save_map(folder / "map.odomap", m, rig, settings=settings)
    return folder / "map.odomap"


def test_maps_and_recordings_that_are_not_there(refused, tmp_path):
    assert "nowhere.odomap: cannot be read: No such file" in refused("nowhere.odomap")
    (tmp_path / "empty").mkdir()
    assert "empty: has no map.odomap" in refused("empty")
    file = saved(tmp_path, small_map())
    assert "no_such_recording" in refused(file, data="no_such_recording")
    file.write_bytes(file.read_bytes()[:-100])
    assert "map.odomap: " in refused(file)


def test_maps_in_which_nothing_could_be_found(refused, tmp_path):
    assert "the map has no landmarks" in refused(saved(tmp_path, small_map(landmarks=False)))
    assert "none of its landmarks has a descriptor" in refused(saved(tmp_path, small_map(width=0)))
    assert "the map has no landmarks" in refused(saved(tmp_path, Map()))


def test_maps_of_other_cameras(refused, tmp_path, pair):
    rig = open_source(pair).rig
    left = rig.cameras[0]
    fx, *others = left.camera.intrinsics
    longer = replace(left, camera=replace(left.camera, intrinsics=(fx + 1, *others)))
    file = saved(tmp_path, small_map(), replace(rig, cameras=(longer, rig.cameras[1])))
    said = refused(file)
    assert f"made with another rig: camera {left.name}: fx is {fx + 1:.9g} there, {fx:.9g}" in said
    file = saved(tmp_path, small_map(), replace(rig, depth=DepthMount(left.name)), sensors="rgbd")
    assert "was made with a camera with depth, not with a stereo pair" in refused(
        file, "--preset", "stereo"
    )
    # Unless another is asked for, the preset is that of the map.
    assert "another rig: a depth image there, none here" in refused(file)


def test_names_and_values_are_checked_first(refused, tmp_path):
    file = saved(tmp_path, small_map())
    assert "preset 'sterio'" in refused(file, "--preset", "sterio")
    assert "unknown field 'tracking.min_inlier'" in refused(file, "--tracking.min_inlier", "3")
    assert "max_frames is 0" in refused(file, "--max-frames", "0")


def test_a_map_says_what_it_was_made_with(tmp_path, pair):
    rig = open_source(pair).rig
    file = SavedMap.load(saved(tmp_path, small_map(), rig, sensors="stereo"))
    assert file.sensors == "stereo"
    assert file.eye().camera.resolution == (320, 200)
    assert SavedMap.load(saved(tmp_path, small_map(), sensors=["x"])).sensors == ""
    with pytest.raises(InputError, match="does not say which cameras"):
        SavedMap.of(small_map()).eye()
    assert SavedMap.of(file) is file


def test_programs_are_told_the_same(pair):
    for call in (localize, continue_map):
        with pytest.raises(InputError, match="map: the map has no landmarks"):
            call(Map(), pair)


def a_camera(name="cam", fx=300.0, k=(), turned=0.0, size=(320, 200)):
    camera = Camera(intrinsics=(fx, 300.0, 160.0, 100.0), resolution=size, distortion=k)
    return CameraMount(name, camera, SE3.exp(np.array([0.1, 0, 0, 0, turned, 0])))


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (a_camera("renamed"), None),
        (a_camera(fx=300.0 * (1 + 1e-9)), None),
        (a_camera(fx=301.0), "camera cam: fx is 301 there, 300 here"),
        (a_camera(size=(322, 200)), "camera cam: width is 322 there, 320 here"),
        (
            a_camera(k=(0.1, 0, 0, 0)),
            "camera cam: distortion is [0.1, 0.0, 0.0, 0.0] there, [] here",
        ),
        (a_camera(turned=0.01), "T_body_camera"),
    ],
)
def test_differences_of_rigs(other, said):
    here = Rig(cameras=(a_camera(),), depth=DepthMount("cam"))
    there = Rig(cameras=(other,), depth=DepthMount(other.name))
    found = list(rig_differences(there, here, "rgbd"))
    assert len(found) == (said is not None)
    assert said is None or said in found[0]
    if said == "T_body_camera":  # a single camera is the body
        assert not list(rig_differences(there, here, "mono"))


def test_a_pair_needs_two():
    one, two = Rig(cameras=(a_camera(),)), Rig(cameras=(a_camera(), a_camera("b", turned=0.2)))
    assert list(rig_differences(one, two, "stereo")) == ["1 cameras there, 2 here"]
    assert not list(rig_differences(one, two, "mono"))
