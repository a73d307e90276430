"""A map file is the map to the last bit, and whole or not there."""

import signal
import subprocess
import sys
import threading
import time
import zipfile

import numpy as np
import pytest
from hypothesis import settings
from hypothesis.stateful import precondition, rule

import odomap
from maps.test_map_properties import MapMachine, random_pose
from mapworlds import Walk, features, rich_map, same_map
from odomap.errors import InputError, OutputError
from odomap.files.mapfile import MapFile, load_map, read_map_rig, save_map
from odomap.maps import copying
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map


def test_a_map_with_everything_comes_back_to_the_last_bit(tmp_path):
    m = rich_map()
    save_map(tmp_path / "a.odomap", m)
    again = load_map(tmp_path / "a.odomap")
    same_map(m, again)
    save_map(tmp_path / "b.odomap", again)
    assert (tmp_path / "a.odomap").read_bytes() == (tmp_path / "b.odomap").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.odomap", "b.odomap"]
    assert again.resolve([9, 15, 21, 1]).tolist() == m.resolve([9, 15, 21, 1]).tolist()
    assert again.new_keyframe_id() == 9
    assert again.T_world_body(0).tolist() == m.T_world_body(0).tolist()
    again.keyframe(4).features.keypoints[0] = 0  # may be written, and holds no more than its own
    assert again.keyframe(4).features.keypoints.flags.owndata


@pytest.mark.parametrize("seed", range(12))
def test_a_loaded_map_goes_on_as_the_saved_one(tmp_path, seed):
    stays, reloads = Walk(seed), Walk(seed)
    for lap in range(3):
        stays.go(25)
        reloads.go(25)
        save_map(tmp_path / f"{lap}.odomap", reloads.map)
        reloads.map = load_map(tmp_path / f"{lap}.odomap")
    for walk in (stays, reloads):
        walk.go(25)
        walk.agrees_with_the_model()
        walk.both_views_tell_the_same()
    same_map(stays.map, reloads.map)


def test_an_empty_map_and_one_keyframe(tmp_path):
    m = Map()
    for _ in range(2):
        save_map(tmp_path / "m.odomap", m)
        again = load_map(tmp_path / "m.odomap")
        same_map(m, again)
        k = again.new_keyframe_id()
        again.add_keyframe(Keyframe(k, 5), np.eye(4))
        m = again


class ReloadingMachine(MapMachine):
    """The interleavings of the map, with the map saved and loaded at any moment between."""

    folder = None

    @precondition(lambda self: self.model.order)
    @rule()
    def reload(self):
        save_map(self.folder / "map.odomap", self.map)
        self.map = load_map(self.folder / "map.odomap")


def test_a_map_may_be_reloaded_between_any_two_changes(tmp_path):
    from hypothesis.stateful import run_state_machine_as_test

    machine = type("Machine", (ReloadingMachine,), {"folder": tmp_path})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=12, stateful_step_count=30, deadline=None, derandomize=True, database=None
        ),
    )


@pytest.mark.parametrize("kind", ["stereo", "mono", "mono,depth"])
def test_maps_of_odometry(tmp_path, kind):
    source = odomap.open(f"sim:room?seed=1&frames=25&resolution=320x200&sensors={kind}")
    vo = {
        "stereo": lambda: odomap.StereoVO(source.rig),
        "mono": lambda: odomap.MonocularVO(source.rig.cameras[0].camera),
        "mono,depth": lambda: odomap.RgbdVO(source.rig),
    }[kind]()
    for frame in source:
        vo.track(frame)
    m = vo.finish().map
    assert m.num_landmarks > 50
    save_map(tmp_path / "a.odomap", m, source.rig, settings={"preset": kind, "window": 10})
    again = load_map(tmp_path / "a.odomap")
    same_map(m, again)
    with MapFile(tmp_path / "a.odomap") as file:
        assert file.settings == {"preset": kind, "window": 10}
        save_map(tmp_path / "b.odomap", again, file.rig, settings=file.settings)
    assert (tmp_path / "a.odomap").read_bytes() == (tmp_path / "b.odomap").read_bytes()
    rig = read_map_rig(tmp_path / "a.odomap")
    for mount, given in zip(rig.cameras, source.rig.cameras, strict=True):
        np.testing.assert_array_equal(mount.T_body_camera.matrix, given.T_body_camera.matrix)


def slam_map(keyframes, count):
    """A map as SLAM leaves it: every keyframe with features, and landmarks that look like them."""
    rng = np.random.default_rng(0)
    m = Map()
    for n in range(keyframes):
        seen = features(rng, count, 32)
        m.add_keyframe(
            Keyframe(m.new_keyframe_id(), 50_000_000 * n, features=seen), random_pose(rng)
        )
        at = np.flatnonzero(np.isfinite(seen.depth))[: count // 4]
        points = seen.bearings[at] * seen.depth[at, None]
        ids = m.add_landmarks(n, points, seen.descriptors[at])
        m.add_observations(n, ids, at)
        older = m.landmark_ids[-count : -len(at)][: count - len(at)]
        m.add_observations(n, older, np.setdiff1d(np.arange(count), at)[: len(older)])
        m.count_expected(np.r_[ids, older])
        m.count_seen(ids)
        m.set_descriptors(ids[:3], seen.descriptors[:3])
        m.fuse_landmarks(older[:2], ids[: len(older[:2])])
    m.cull_keyframes([2, 5, 9])
    return m


def test_a_map_of_slam_with_features_on_every_keyframe(tmp_path):
    m = slam_map(40, 300)
    file = tmp_path / "a.odomap"
    save_map(file, m)
    again = load_map(file)
    same_map(m, again)
    save_map(tmp_path / "b.odomap", again)
    assert file.read_bytes() == (tmp_path / "b.odomap").read_bytes()
    assert file.stat().st_size < 37 * 300 * 73 + 110 * m.num_landmarks + 20 * m.num_observations
    ids, mount = m.landmark_ids, np.eye(4)
    for before, after in zip(
        vars(m.views_of(ids, mount)).values(), vars(again.views_of(ids, mount)).values()
    ):
        np.testing.assert_array_equal(before, after)
    assert m.views_of(ids, mount).level.max() == 7
    with MapFile(file) as opened:
        np.testing.assert_array_equal(opened.features(7).level, m.keyframe(7).features.level)


def test_what_is_saved_beside_a_mapper_is_of_one_moment(tmp_path, monkeypatch):
    monkeypatch.setattr(copying, "STEP", 4096)
    m, errors, stop = slam_map(12, 80), [], threading.Event()

    def work():
        rng = np.random.default_rng(1)
        try:
            while not stop.is_set():
                with m.lock:  # a landmark, its observation and its counts come together
                    k = m.new_keyframe_id()
                    m.add_keyframe(Keyframe(k, k, features=features(rng, 4, 32)), random_pose(rng))
                    ids = m.add_landmarks(k, rng.normal(size=(4, 3)))
                    m.add_observations(k, ids, np.arange(4))
                    m.count_expected(ids)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    sizes = []
    for _ in range(6):
        save_map(tmp_path / "m.odomap", m)
        again = load_map(tmp_path / "m.odomap")
        for k in again.keyframe_ids[again.keyframe_ids >= 12].tolist():
            ids, keypoints = again.observations_of(k)
            assert keypoints.tolist() == [0, 1, 2, 3]
            assert again.expected(ids).tolist() == [1, 1, 1, 1]
        sizes.append(again.num_keyframes)
    stop.set()
    thread.join()
    assert not errors
    assert sizes == sorted(sizes)
    assert sizes[-1] > sizes[0]


def test_opening_reads_little_and_features_come_alone(tmp_path):
    m = rich_map(keyframes=9)
    save_map(tmp_path / "m.odomap", m)
    with MapFile(tmp_path / "m.odomap") as file:
        assert file.counts == {
            "keyframes": 7,
            "stubs": 2,
            "landmarks": m.num_landmarks,
            "observations": m.num_observations,
            "edges": 9,
        }
        assert file.edge_kinds == ("odometry", "loop")
        assert file.rig is None
        assert file.arrays["states/scales"].shape == (9,)
        for k in (4, 5, 8):
            alone, whole = file.features(k), m.keyframe(k).features
            for name in vars(whole):
                np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name))
        for k in (-1, 0, 1, 2, 99):  # never there, culled, retired, without features, never there
            assert file.features(k) is None
        with pytest.raises(InputError, match="there is no such array"):
            file.array("states/colours")


def test_numpy_and_zipfile_read_it_too(tmp_path):
    m = rich_map()
    save_map(tmp_path / "m.odomap", m)
    with zipfile.ZipFile(tmp_path / "m.odomap") as archive:
        assert archive.testzip() is None
        assert archive.namelist()[-1] == "manifest.json"
    with np.load(tmp_path / "m.odomap", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["states/Ts_world_body"], m.states.Ts_world_body)
        assert arrays["landmarks/p_anchor"].shape == (m.num_landmarks, 3)


def with_a_nan_edge(m):
    m.add_edge(4, 5, np.eye(4), np.full((6, 6), np.nan), "loop")


def with_a_nan_state(m):
    m.states.Ts_world_body[4, 0, 3] = np.nan


def with_a_submap(m):
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 1, submap=[1]), np.eye(4))


def with_wrong_scan(m):
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 1, scan=np.zeros(3, np.float32)), np.eye(4))


def with_an_unknown_keypoint(m):
    m.add_observations(4, m.landmark_ids[:1], [24])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (with_a_nan_edge, "edges/information: an entry is not finite"),
        (with_a_nan_state, "states: the pose 4 is not finite"),
        (with_a_submap, "submaps are not kept"),
        (with_wrong_scan, "scan/ranges is <f4"),
        (with_an_unknown_keypoint, "keyframe 4 has 24 features"),
    ],
)
def test_what_could_not_be_loaded_is_not_saved(tmp_path, spoil, message):
    m = rich_map()
    save_map(tmp_path / "m.odomap", m)
    before = (tmp_path / "m.odomap").read_bytes()
    spoil(m)
    with pytest.raises(OutputError, match=rf"m\.odomap: the map cannot be saved: .*{message}"):
        save_map(tmp_path / "m.odomap", m)
    assert [p.name for p in tmp_path.iterdir()] == ["m.odomap"]
    assert (tmp_path / "m.odomap").read_bytes() == before


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError, match="the folder does not exist"):
        save_map(tmp_path / "none" / "m.odomap", rich_map())


SAVER = """
from odomap.files.mapfile import load_map, save_map
maps = [load_map(f"{folder}/{{seed}}.odomap") for seed in (1, 2)]
print("ready", flush=True)
while True:
    for m in maps:
        save_map("{folder}/m.odomap", m)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_kill_9_during_a_save_leaves_a_whole_file(tmp_path):
    wholes, rng = [], np.random.default_rng(0)
    for seed, m in ((1, rich_map(1, 40)), (2, slam_map(30, 500))):
        save_map(tmp_path / f"{seed}.odomap", m)
        wholes.append((tmp_path / f"{seed}.odomap").read_bytes())
    file = tmp_path / "m.odomap"
    file.write_bytes(wholes[0])
    halves = 0
    for attempt in range(4):
        code = SAVER.format(folder=tmp_path)
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        assert process.stdout.readline() == b"ready\n"
        while not any(p.name.endswith(f".{process.pid}.part") for p in tmp_path.iterdir()):
            time.sleep(0.001)
        if attempt % 2:  # anywhere; else as soon as a save is seen to go on
            time.sleep(rng.uniform(0.0, 0.1))
        process.kill()
        process.wait()
        process.stdout.close()
        assert file.read_bytes() in wholes
        load_map(file)
        halves += any(p.name.endswith(f".{process.pid}.part") for p in tmp_path.iterdir())
    assert halves > 0  # it was hit in the middle at least once
