"""Closing loops with a laser: a path that drifted is straightened by what old submaps show."""

from dataclasses import replace

import numpy as np

from laserworlds import RIG, around, frames, in_first
from odomap.geometry.planar import to_plane
from odomap.maps.edges import LOOP
from odomap.system.config import preset
from odomap.system.scanconfig import ScanClosingConfig, SubmapConfig
from odomap.system.slam import Slam

SHORT = replace(preset("lidar2d"), submaps=SubmapConfig(scans=12))


def run(made, config=SHORT, rhythm="inline"):
    system = Slam(RIG, config, rhythm)
    for frame in made:
        system.track(frame)
    return system.finish()


def errors(result, path):
    found = to_plane(result.trajectory.Ts_world_body)
    return np.linalg.norm(found[:, :2] - in_first(path)[:, :2], axis=1)


def test_a_second_round_is_tied_to_the_first_and_the_path_is_nearer_the_truth():
    path = around(300, rounds=2)
    made = frames(path, seed=2)
    closed = run(made)
    off = replace(SHORT, scan_closing=ScanClosingConfig(enabled=False))
    drifted = run(made, off)
    assert LOOP not in drifted.map.edges().kind
    assert sum(kind == LOOP for kind in closed.map.edges().kind) > 5
    assert any(loop.is_accepted for loop in closed.loops)
    assert errors(closed, path)[150:].mean() <= errors(drifted, path)[150:].mean() + 0.002
    assert errors(closed, path).max() < 0.06


def test_the_same_bytes_on_every_run_and_in_any_rhythm_the_same_loops_are_found():
    path = around(160, rounds=2)
    made = frames(path, seed=4)
    first, again = run(made), run(made)
    assert first.trajectory.Ts_world_body.tobytes() == again.trajectory.Ts_world_body.tobytes()
    beside, twice = run(made, rhythm="lockstep"), run(made, rhythm="lockstep")
    assert beside.trajectory.Ts_world_body.tobytes() == twice.trajectory.Ts_world_body.tobytes()
    assert errors(beside, path).max() < 0.06


def test_of_a_place_that_is_not_there_it_is_said_why():
    path = around(200, rounds=2)
    strict = replace(SHORT, scan_closing=ScanClosingConfig(score=1.0))
    result = run(frames(path), strict)
    refused = [loop.reason for loop in result.loops if not loop.is_accepted]
    assert refused
    assert all("nowhere within" in reason and "100% of the scan" in reason for reason in refused)
    assert LOOP not in result.map.edges().kind
