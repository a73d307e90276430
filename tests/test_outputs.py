"""What a run leaves in its folder: the map, its numbers, and what one failure keeps of the rest."""

import dataclasses
import json

import numpy as np
import pytest

import odomap.outputs
from odomap.errors import OutputError
from odomap.files.mapfile import load_map
from odomap.logbook import Logbook
from odomap.outputs import Outputs
from odomap.sources.open import open as open_source
from odomap.system.config import preset
from odomap.system.odometry import make_odometry

FILES = (
    "trajectory.tum",
    "trajectory_live.tum",
    "keyframes.tum",
    "map.odomap",
    "config.yaml",
    "metrics.json",
    "report.html",
)


@pytest.fixture(scope="module")
def tracked():
    """A source, what was found in it, and the logbook."""
    source = open_source("sim:room?seed=3&frames=6&resolution=400x250")
    system, book = make_odometry(source.rig, preset("stereo-flow"), "inline"), Logbook(len(source))
    book.map = system.map
    for frame in source:
        book.add(frame, system.track(frame), 0.01)
    return source, system.finish(), book


def numbers_of(result, book):
    metrics = book.numbers() | {"skipped": 0, "rhythm": "inline", "frames_dropped": 0}
    metrics |= {
        "path_m": float(result.trajectory.path_length),
        "loops_closed": None,
        "loops_rejected": 0,
        "compile_s": 0.0,
    }
    return metrics | {"ate": None, "keyframes": 1, "landmarks": result.map.num_landmarks}


def write(folder, tracked, result=None):
    source, found, book = tracked
    metrics = numbers_of(found, book)
    outputs = Outputs(folder, preset("stereo-flow"), {"data": source.name})
    outputs.write(source, result or found, book, metrics, [])
    return outputs, metrics


def test_the_map_is_written_after_the_paths(tmp_path, tracked):
    outputs, metrics = write(tmp_path, tracked)
    assert outputs.written == FILES
    file = tmp_path / "map.odomap"
    assert metrics["map_bytes"] == file.stat().st_size > 1000
    assert json.loads((tmp_path / "metrics.json").read_text())["map_bytes"] == metrics["map_bytes"]
    found, loaded = tracked[1].map, load_map(file)
    np.testing.assert_array_equal(loaded.keyframe_ids, found.keyframe_ids)
    ids = found.landmark_ids
    np.testing.assert_array_equal(loaded.points_world(ids), found.points_world(ids))


def test_a_map_that_cannot_be_written_keeps_nothing_else_from_being(tmp_path, tracked, monkeypatch):
    def refuse(path, *_, **__):
        raise OutputError(f"{path}: cannot be written: the disk is full")

    monkeypatch.setattr(odomap.outputs, "save_map", refuse)
    with pytest.raises(OutputError, match=r"map\.odomap.*disk is full; written: traj") as failed:
        write(tmp_path, tracked)
    others = [name for name in FILES if name != "map.odomap"]
    assert f"written: {', '.join(others)}" in str(failed.value)
    assert {path.name for path in tmp_path.iterdir()} == set(others)
    assert json.loads((tmp_path / "metrics.json").read_text())["map_bytes"] is None


def test_what_mapping_counts_is_told_where_it_counts(tmp_path, tracked):
    counted = dataclasses.replace(tracked[1], mapping={"landmarks_fused": np.int64(4)})
    write(tmp_path, tracked, counted)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["mapping"] == {"landmarks_fused": 4}
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "<td>landmarks fused</td>" in page
    write(tmp_path, tracked)
    assert json.loads((tmp_path / "metrics.json").read_text())["mapping"] is None
    assert "What mapping did" not in (tmp_path / "report.html").read_text("utf-8")


def test_the_report_shows_how_the_map_grew(tmp_path, tracked):
    write(tmp_path, tracked)
    page = (tmp_path / "report.html").read_text("utf-8")
    assert '<section id="map"' in page
    assert "How it grew" in page
    assert "Seen from above, along" in page
