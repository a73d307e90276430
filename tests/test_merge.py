"""`odomap merge` and `odomap.merge_maps`: what they say, what they write, and what they refuse."""

from dataclasses import replace

import numpy as np
import pytest

from mapworlds import features
from odomap.cli import main
from odomap.errors import InputError, TrackingFailed
from odomap.files.mapexport import keyframe_trajectory
from odomap.files.mapfile import load_map, read_map_rig, save_map
from odomap.files.rig import write_rig
from odomap.files.vocabulary import default_vocabulary_path
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.maps.atlas import Atlas
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.merge import merge_maps
from odomap.run import chosen_config
from odomap.savedmap import SavedMap, map_settings
from odomap.sensors.rig import CameraMount, DepthMount, Rig
from odomap.simulation.world import World
from odomap.system.slam import Slam
from system.circuits import CAMERA, Walls
from system.test_merging import bytes_of, halves

EYE = Rig(cameras=(CameraMount("eye", CAMERA),))


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """Return files of two maps of one camera, halves of a circuit in units of their own."""
    folder = tmp_path_factory.mktemp("maps")
    first, second, _ = halves(1, 0.4)
    elsewhere, _, _ = halves(1, walls=Walls.make(seed=5))
    for name, circuit in (("first", first), ("second", second), ("elsewhere", elsewhere)):
        save_map(folder / f"{name}.odomap", circuit.map, EYE, settings={"sensors": "mono"})
    return folder / "first.odomap", folder / "second.odomap", folder / "elsewhere.odomap"


@pytest.fixture
def cli(capsys, tmp_path, monkeypatch):
    """Run the command in an empty folder; return exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        code = main(["merge", *map(str, words)])
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def refused(cli, tmp_path):
    """Say in one line why maps are not merged; nothing is written."""

    def call(*words, code=2):
        there = {file: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()}
        said, out, err = cli(*words, "--quiet")
        assert (said, out, err.count("\n")) == (code, "", 1)
        assert err.startswith("odomap: ")
        assert {file: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()} == there
        return err

    return call


def test_two_halves_of_a_circuit_become_one_file(cli, maps, tmp_path):
    first, second, _ = maps
    before = first.read_bytes(), second.read_bytes()
    code, out, _ = cli(first, second, "--out", "new/both.odomap")
    assert code == 0
    found, wrote = out.splitlines()
    assert "places in common, the second map moved by" in found
    assert float(found.split("scaled by ")[1].split(",")[0]) == pytest.approx(2.5, abs=0.02)
    assert "landmarks fused" in found
    assert wrote.split()[:2] == ["wrote", "new/both.odomap:"]
    assert "100 keyframes" in wrote
    assert (first.read_bytes(), second.read_bytes()) == before
    both = tmp_path / "new" / "both.odomap"
    saved = SavedMap.load(both)
    assert (saved.sensors, saved.rig) == ("mono", read_map_rig(first))
    assert len(Atlas(saved.map).pieces) == 1
    # A merged map is a map: it can be merged again, and with what it was made of.
    merged = merge_maps(both, first)
    assert merged.num_places > 20
    assert merged.scale == pytest.approx(1.0, abs=0.02)
    assert np.linalg.norm(merged.T_first_second[:3, 3]) < 0.1
    (piece,) = Atlas(merged.map).pieces
    assert len(piece.merged) == 2


def test_another_vocabulary_is_told_by_the_merged_map(cli, refused, maps, tmp_path):
    first, second, _ = maps
    words = tmp_path / "words.odomap-vocabulary"
    words.write_bytes(default_vocabulary_path().read_bytes())
    assert cli(first, second, "--vocabulary", words)[0] == 0
    assert SavedMap.load(tmp_path / "merged.odomap").vocabulary == str(words)
    words.write_bytes(words.read_bytes()[:1000])
    said = refused(first, second, "--vocabulary", words)
    assert str(words) in said


def test_maps_of_a_program_are_merged_and_stay_as_they_are(maps):
    first, second = (load_map(file) for file in maps[:2])
    before, told = (bytes_of(first), bytes_of(second)), []
    merged = merge_maps(
        SavedMap("first", first, EYE, "mono"),
        SavedMap("second", second, EYE, "mono"),
        progress=lambda *step: told.append(step),
    )
    assert (bytes_of(first), bytes_of(second)) == before
    assert merged.num_places == sum(loop.is_accepted for loop in merged.loops)
    assert told[0][2].startswith("compiling")
    assert "places in common" in told[-1][2]
    assert merge_maps(first, second, rig=EYE).num_places == merged.num_places


def test_maps_of_two_places_are_not_merged(refused, maps, tmp_path):
    said = refused(maps[0], maps[2], "--out", "both.odomap", code=1)
    assert f"{maps[2]}: has no place in common with {maps[0]}: " in said
    with pytest.raises(TrackingFailed, match="no place in common"):
        merge_maps(maps[0], maps[2])


def test_files_that_are_no_maps_and_results_that_would_replace_one(refused, maps, tmp_path):
    first, second, _ = maps
    assert "nowhere.odomap: cannot be read" in refused("nowhere.odomap", second)
    (tmp_path / "text.odomap").write_text("no map")
    assert "text.odomap: " in refused(first, "text.odomap")
    (tmp_path / "run").mkdir()
    assert "run: has no map.odomap" in refused(first, "run")
    short = tmp_path / "short.odomap"
    short.write_bytes(second.read_bytes()[:-100])
    assert "short.odomap: " in refused(first, short)
    for file in (first, second):
        said = refused(first, second, "--out", file)
        assert f"{file}: is one of the maps to be merged: choose another file" in said
    assert f"{first}: is both maps: give two" in refused(first, first)
    assert "run: cannot be written: " in refused(first, second, "--out", "run")
    assert "MAP is missing" in refused(first)


def one_keyframe(width=32, landmarks=True):
    rng = np.random.default_rng(0)
    m = Map()
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 0, features=features(rng, 30, width)), np.eye(4))
    if landmarks:
        m.add_observations(0, m.add_landmarks(0, rng.normal(size=(20, 3))), np.arange(20))
    return m


def test_maps_in_which_nothing_could_be_recognised(refused, maps, tmp_path):
    for name, m in (
        ("empty", Map()),
        ("bare", one_keyframe(landmarks=False)),
        ("flow", one_keyframe(width=0)),
    ):
        save_map(tmp_path / f"{name}.odomap", m, EYE, settings={"sensors": "mono"})
    assert "empty.odomap: the map has no landmarks" in refused(maps[0], "empty.odomap")
    assert "bare.odomap: the map has no landmarks" in refused("bare.odomap", maps[0])
    said = refused(maps[0], "flow.odomap")
    assert "flow.odomap: none of its landmarks has a descriptor" in said


def pair(baseline=0.1, camera=CAMERA):
    right = np.eye(4)
    right[0, 3] = baseline
    mounts = CameraMount("left", camera), CameraMount("right", camera, SE3(right))
    return Rig(cameras=mounts)


def eye(**fields):
    return Rig(cameras=(CameraMount("eye", replace(CAMERA, **fields)),))


@pytest.mark.parametrize(
    ("rig", "sensors", "said"),
    [
        (pair(), "stereo", "was made with a stereo pair, {0} with one camera"),
        (
            eye(intrinsics=(250.0, 251.0, 199.5, 149.5)),
            "mono",
            "another rig than {0}: camera eye: fy is 250 there, 251 here",
        ),
        (eye(resolution=(640, 300)), "mono", "camera eye: width is 400 there, 640 here"),
        (eye(distortion=(0.1, 0.0, 0.0, 0.0)), "mono", "camera eye: distortion is"),
        (
            eye(model="kannala_brandt", distortion=(0.1, 0.0, 0.0, 0.0)),
            "mono",
            "camera eye: the model is pinhole there, kannala_brandt here",
        ),
    ],
)
def test_maps_of_other_cameras_are_refused_and_it_is_said_why(
    refused, maps, tmp_path, rig, sensors, said
):
    other = tmp_path / "other.odomap"
    save_map(other, load_map(maps[1]), rig, settings={"sensors": sensors})
    error = refused(maps[0], other)
    assert f"{other}: was made with" in error
    assert said.format(maps[0]) in error
    assert "only maps of the same cameras can be merged" in error


def test_pairs_differ_by_their_baseline_and_cameras_by_having_depth(refused, maps, tmp_path):
    m = load_map(maps[1])
    depth = replace(EYE, depth=DepthMount("eye", 1000.0))
    for name, rig, sensors in (
        ("near", pair(0.1), "stereo"),
        ("far", pair(0.12), "stereo"),
        ("depth", depth, "rgbd"),
    ):
        save_map(tmp_path / f"{name}.odomap", m, rig, settings={"sensors": sensors})
    assert "the baseline is 0.1 m there, 0.12 m here" in refused("near.odomap", "far.odomap")
    assert "was made with a camera with depth" in refused("near.odomap", "depth.odomap")


def test_a_map_that_does_not_say_its_cameras_needs_them_given(refused, cli, maps, tmp_path):
    silent = tmp_path / "silent.odomap"
    save_map(silent, load_map(maps[1]))
    assert "silent.odomap: does not say which cameras" in refused(maps[0], silent)
    write_rig(tmp_path / "rig.yaml", EYE)
    code, out, _ = cli(maps[0], silent, "--rig", "rig.yaml", "--out", "both.odomap", "--quiet")
    assert code == 0
    assert "places in common" in out
    with pytest.raises(InputError, match="does not say which cameras"):
        merge_maps(Map(), Map())


# ---- from images ----

FRAMES, SHARED = 48, 12


def test_a_merged_map_is_localised_in_and_goes_on(tmp_path, monkeypatch):
    """The two halves of a recording, mapped apart: the merged map knows all of it."""
    world = World.make(
        kind="room", seed=3, frames=FRAMES, rate_hz=12.0, resolution=(400, 250), speed=0.9
    )
    config, frames = chosen_config("stereo"), [world.frame(n) for n in range(FRAMES)]
    half = FRAMES // 2
    for name, part in (
        ("first", frames[: half + SHARED // 2]),
        ("second", frames[half - SHARED // 2 :]),
    ):
        slam = Slam(world.rig, config)
        for frame in part:
            slam.track(frame)
        made = slam.finish().map
        save_map(tmp_path / f"{name}.odomap", made, world.rig, settings=map_settings(config))
    both, told, errors = tmp_path / "both.odomap", [], []
    ends = tmp_path / "first.odomap", tmp_path / "second.odomap"
    with monkeypatch.context() as patched:
        patched.setattr("odomap.merge._adjust", lambda *_: None)
        errors.append(apart(keyframe_trajectory(merge_maps(*ends).map), world.truth))
    merged = merge_maps(*ends, both, progress=lambda *step: told.append(step[2]))
    errors.append(apart(keyframe_trajectory(merged.map), world.truth))
    assert "adjusting" in told
    before, after = (np.sqrt(np.mean(error**2)) for error in errors)
    assert after < 0.9 * before
    assert merged.num_places >= 2
    assert merged.sensors == "stereo"
    assert merged.scale == 1.0
    assert errors[-1].max() < 0.03
    for is_mapping in (False, True):
        slam = Slam(world.rig, config, map=load_map(both), is_mapping=is_mapping)
        estimates = [slam.track(frame) for frame in (*frames[1:8:2], *frames[-9::2])]
        placed = Trajectory(
            [e.stamp_ns for e in estimates],
            np.array([e.T_world_body.matrix for e in estimates]),
        )
        assert all(e.status.value in ("tracking", "recovered") for e in estimates)
        assert apart(placed, world.truth).max() < 0.03


def apart(path, truth):
    """Return how far (n,) a path that begins at the first true pose is from the truth."""
    row = np.searchsorted(truth.stamps_ns, path.stamps_ns)
    true = np.linalg.inv(truth.Ts_world_body[0]) @ truth.Ts_world_body[row]
    return np.linalg.norm(path.Ts_world_body[:, :3, 3] - true[:, :3, 3], axis=1)
