"""Saved maps used again, from end to end: frames are placed where they were, and maps grow."""

import json

import cv2
import numpy as np
import pytest

from mapworlds import same_map
from odomap.cli import main
from odomap.errors import InputError
from odomap.evaluation.metrics import ate
from odomap.files.mapfile import load_map, save_map
from odomap.files.trajectories import read_tum
from odomap.files.vocabulary import Vocabulary
from odomap.localize import continue_map, localize
from odomap.run import chosen_config
from odomap.savedmap import map_settings
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World
from odomap.sources.open import open as open_source
from odomap.system.slam import Slam
from odomap.vision.orb import OrbConfig, extract

FRAMES, MAPPED = 20, 12
OVERRIDES = (("orb.count", "600"), ("threads.mapping_delay", "1"))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Return a room seen by a stereo pair, as a EuRoC folder."""
    folder = tmp_path_factory.mktemp("recordings") / "room"
    world = World.make(kind="room", seed=3, frames=FRAMES, rate_hz=12.0, resolution=(400, 250))
    export_euroc(world, folder)
    return folder


@pytest.fixture(scope="module")
def config(recording):
    return chosen_config("stereo", None, OVERRIDES)


@pytest.fixture(scope="module")
def mapped(recording, config, tmp_path_factory):
    """Return the file of a map made of the first frames, and their path."""
    source = open_source(recording)
    slam = Slam(source.rig, config)
    for frame in source:
        slam.track(frame)
        if frame.id == MAPPED - 1:
            break
    file = tmp_path_factory.mktemp("maps") / "map.odomap"
    result = slam.finish()
    save_map(file, result.map, source.rig, settings=map_settings(config))
    return file, result.trajectory


def apart(a, b):
    """Return the largest distance of two paths at the stamps they share, not aligned."""
    shared, i, j = np.intersect1d(a.stamps_ns, b.stamps_ns, return_indices=True)
    assert len(shared)
    return np.linalg.norm(a.Ts_world_body[i, :3, 3] - b.Ts_world_body[j, :3, 3], axis=1).max()


class Late:
    """A recording from a frame on."""

    def __init__(self, source, first):
        self._source, self._first = source, first
        self.name, self.rig, self.truth, self.skipped = source.name, source.rig, source.truth, []

    def __len__(self):
        return len(self._source) - self._first

    def __iter__(self):
        return (self._source.frame(n) for n in range(self._first, len(self._source)))


def test_frames_are_placed_in_the_world_of_the_map(recording, config, mapped, tmp_path):
    file, path = mapped
    before = file.read_bytes()
    source = Late(open_source(recording), 5)
    result = localize(file, source, tmp_path, config=config, rhythm="inline")
    assert not result.failure
    assert result.metrics["localised"] == len(result.trajectory) >= MAPPED - 5
    assert result.metrics["lost"] == len(source) - result.metrics["localised"]
    assert apart(result.trajectory, path) < 0.01
    assert file.read_bytes() == before
    loaded = load_map(file)
    assert result.map.keyframe_ids.tolist() == loaded.keyframe_ids.tolist()
    np.testing.assert_array_equal(
        result.map.points_world(loaded.landmark_ids), loaded.points_world(loaded.landmark_ids)
    )
    there = {p.name for p in tmp_path.iterdir() if p.suffix in (".tum", ".json", ".odomap")}
    assert there == {"trajectory.tum", "trajectory_live.tum", "metrics.json"}
    assert apart(read_tum(tmp_path / "trajectory.tum"), result.trajectory) < 1e-6


@pytest.mark.usefixtures("no_report")
def test_a_map_goes_on_and_is_saved_as_it_is_then(recording, config, mapped, tmp_path):
    file, path = mapped
    source = open_source(recording)
    result = continue_map(file, Late(source, 5), tmp_path, config=config, rhythm="inline")
    assert not result.failure
    assert len(result.trajectory) == FRAMES - 5
    assert result.trajectory.stamps_ns[0] == source.frame(5).stamp_ns  # of this recording alone
    assert apart(result.trajectory, path) < 0.02
    assert ate(result.trajectory, source.truth).rmse < 0.02
    old, new = load_map(file), load_map(tmp_path / "map.odomap")
    # This part of the room was seen before: what is there is used, and nothing is added.
    assert set(new.keyframe_ids) == set(old.keyframe_ids)
    same_map(new, result.map)
    # What was saved goes on, too.
    again = localize(tmp_path, Late(source, FRAMES - 6), config=config, rhythm="inline")
    assert again.metrics["localised"] == 6


@pytest.mark.usefixtures("no_report")
def test_same_input_same_bytes(recording, config, mapped, tmp_path):
    source = Late(open_source(recording), 8)
    for name, rhythm in (("a", "inline"), ("b", "lockstep")):
        folder = tmp_path / name
        continue_map(mapped[0], source, folder, config=config, rhythm=rhythm, max_frames=10)
    for name in ("trajectory.tum", "trajectory_live.tum", "map.odomap"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.usefixtures("no_report")
def test_a_room_that_is_not_in_the_map(config, mapped, tmp_path, capsys):
    world = World.make(kind="room", seed=8, frames=5, rate_hz=12.0, resolution=(400, 250))
    export_euroc(world, tmp_path / "other")
    words = [str(mapped[0]), str(tmp_path / "other"), "--out", str(tmp_path / "out"), "--quiet"]
    assert main(["localize", *words, "--orb.count", "600"]) == 1
    out, err = capsys.readouterr()
    assert "5: 0 localised, 5 lost" in out
    assert "none of 5 frames could be localised: " in err
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["localised"] == 0
    assert metrics["failure"]
    assert read_empty(tmp_path / "out" / "trajectory.tum")
    # Nor does it go on from nowhere: the map stays what it was.
    assert main(["continue", *words, "--orb.count", "600"]) == 1
    old, new = load_map(mapped[0]), load_map(tmp_path / "out" / "map.odomap")
    assert new.keyframe_ids.tolist() == old.keyframe_ids.tolist()


def read_empty(file):
    """Return whether a file holds no pose."""
    try:
        return not len(read_tum(file))
    except InputError:
        return True


def test_the_command_line(recording, mapped, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = [str(mapped[0]), str(recording), "--quiet", "--orb.count", "600", "--max-frames", "4"]
    assert main(["localize", *words]) == 0
    out, _ = capsys.readouterr()
    assert "4: 4 localised, 0 lost" in out
    folder = tmp_path / "runs" / "room_localized"
    config = (folder / "config.yaml").read_text()
    assert f"map: {mapped[0]}" in config
    assert "is_mapping: false" in config
    assert f"odomap localize {mapped[0]}" in (folder / "report.html").read_text()
    assert main(["continue", *words]) == 0
    assert (tmp_path / "runs" / "room_continued" / "map.odomap").exists()
    # Again with the settings of the run, as the report says.
    assert main(["localize", *words, "--config", str(folder / "config.yaml")]) == 0


@pytest.mark.usefixtures("no_report")
def test_another_vocabulary_is_said_and_its_words_are_made_anew(
    recording, mapped, tmp_path, capsys
):
    seen = (recording / "mav0" / "cam0" / "data").glob("*.png")
    few = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(seen)[::4]]
    found = [extract(image, OrbConfig(count=300)).descriptors for image in few]
    words = tmp_path / "own.odomap-vocabulary"
    Vocabulary.train(found, branching=6, depth=3).save(words)
    call = ["localize", str(mapped[0]), str(recording), "--out", str(tmp_path / "out"), "--quiet"]
    call += ["--max-frames", "4", "--orb.count", "600", "--places.vocabulary", str(words)]
    assert main(call) == 0
    out, err = capsys.readouterr()
    assert "4: 4 localised" in out
    assert "was made with the vocabulary of odomap: its places are indexed anew with" in err
    assert "own.odomap-vocabulary" in err
    words.write_bytes(words.read_bytes()[:-50])
    assert main(call) == 2
    assert "own.odomap-vocabulary: " in capsys.readouterr().err
