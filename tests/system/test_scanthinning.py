"""Thinning maps of scans: many rounds of one room are no larger than few, and as good."""

from dataclasses import replace

import numpy as np
import pytest

from laserworlds import RIG, around, frames, in_first
from lidar.rooms import OUTLINE, ROOM
from odomap.files.mapfile import load_map, save_map
from odomap.geometry.planar import between_planar, from_plane, lift_information, to_plane
from odomap.maps.edges import FOLDED, LOOP, EdgeTable
from odomap.system.config import preset
from odomap.system.edgefolding import folded_ties
from odomap.system.scanconfig import ScanThinningConfig, SubmapConfig
from odomap.system.slam import Slam
from odomap.system.submaps import SUBMAP

THIN = replace(preset("lidar2d"), submaps=SubmapConfig(scans=12))
WHOLE = replace(THIN, scan_thinning=ScanThinningConfig(enabled=False))
ROUNDS, EACH = 5, 60
MOVED = (OUTLINE, np.array([[-2.5, 1.4], [-1.5, 1.4], [-1.5, 2.2], [-2.5, 2.2]], float))


def played(made, config=THIN, rhythm="inline"):
    """Return a system, and how many keyframes it had after each round."""
    system, counts = Slam(RIG, config, rhythm), []
    for n, frame in enumerate(made, 1):
        system.track(frame)
        if n % EACH == 0:
            counts.append(system.map.num_keyframes)
    return system, counts


def errors(result, path):
    found = to_plane(result.trajectory.Ts_world_body)
    return np.linalg.norm(found[:, :2] - in_first(path)[:, :2], axis=1)


@pytest.fixture(scope="module")
def path():
    return around(ROUNDS * EACH, rounds=ROUNDS)


@pytest.fixture(scope="module")
def made(path):
    return frames(path, seed=3)


@pytest.fixture(scope="module")
def thin(made):
    system, counts = played(made)
    return system, counts, system.finish()


@pytest.fixture(scope="module")
def whole(made):
    system, counts = played(made, WHOLE)
    return system, counts, system.finish()


def test_a_map_grows_with_the_space_and_not_with_time(thin, whole):
    (system, counts, result), (_, of_all, _) = thin, whole
    assert of_all[-1] > 2.2 * of_all[1]
    assert counts[-1] <= 1.3 * counts[1]
    assert result.mapping["submaps"] == len(system.submaps.finished) + len(system.submaps.active)
    edges = result.map.edges()
    assert len(edges.kind) < 6 * counts[-1]
    assert np.isin(np.r_[edges.i, edges.j], result.map.keyframe_ids).mean() > 0.98


def test_the_path_is_as_right_as_with_all_of_it(path, thin, whole):
    there, without = errors(thin[2], path), errors(whole[2], path)
    assert there.max() < 0.06
    assert there.mean() < without.mean() + 0.003
    assert len(thin[2].trajectory) == len(whole[2].trajectory) == len(path)
    sure, of_all = (r.trajectory.covariances[:, 0, 0].mean() for r in (thin[2], whole[2]))
    assert 0.5 * of_all < sure < 4.0 * of_all


def test_frames_hang_from_keyframes_close_by(thin):
    map = thin[2].map
    culled = np.setdiff1d(np.arange(map.keyframe_ids.max()), map.keyframe_ids)
    assert len(culled) > 50
    holders = [map.parent(k) for k in culled.tolist()]
    apart = map.Ts_world_body(culled)[:, :3, 3] - map.Ts_world_body(holders)[:, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() < 1.0


def test_what_is_left_is_whole_and_goes_on_from_a_file(thin, tmp_path):
    system, counts, result = thin
    kinds = result.map.edges().kind
    assert FOLDED in kinds
    anchors = {s.anchor_id for s in [*system.submaps.finished, *system.submaps.active]}
    edges = result.map.edges()
    rows = [row for row, kind in enumerate(kinds) if kind == SUBMAP]
    assert set(edges.i[rows].tolist()) <= anchors
    save_map(tmp_path / "map.odomap", result.map, RIG)
    again = Slam(RIG, THIN, map=load_map(tmp_path / "map.odomap"))
    more = around(2 * EACH, rounds=2)
    for frame in frames(more, seed=8):
        again.track(frame)
    end = again.finish()
    assert errors(end, more).max() < 0.08
    assert end.map.num_keyframes < 1.3 * counts[-1]


def test_it_is_the_same_on_every_run_in_lockstep(made, path):
    ends = []
    for _ in range(2):
        system, counts = played(made, rhythm="lockstep")
        ends.append(system.finish())
    assert counts[-1] <= 1.3 * counts[1]
    one, other = (end.trajectory.Ts_world_body.tobytes() for end in ends)
    assert one == other
    assert errors(ends[0], path).max() < 0.06


def test_a_room_that_was_changed_is_mapped_again(path):
    """Scans that old submaps do not show stay, until there are enough that do."""
    before, after = (frames(path[: 3 * EACH], seed=5, walls=w) for w in (ROOM, MOVED))
    shift = before[-1].stamp_ns
    later = [replace(f, id=f.id + 3 * EACH, stamp_ns=f.stamp_ns + shift) for f in after]
    system, counts = played([*before, *later])
    assert counts[2] <= 1.3 * counts[1]
    assert counts[4] > counts[2] + 10
    assert system.finish().map.num_keyframes < 2.5 * counts[1]


@pytest.mark.parametrize("is_tied", [True, False])
def test_only_what_would_fall_apart_is_tied(is_tied):
    """0 - 1 - 2 - 3, of which the middle goes; another edge from 0 to 3, or none."""
    count = 4 if is_tied else 3
    x = np.array([[0, 0, 0], [1, 0, 0.1], [2, 0.1, 0.2], [3, 0.3, 0.3]])
    i, j = np.array([0, 1, 2, 0])[:count], np.array([1, 2, 3, 3])[:count]
    between = np.array([between_planar(x[a], x[b]) for a, b in zip(i, j)])
    edges = EdgeTable(
        i,
        j,
        from_plane(between),
        np.ones(count),
        lift_information(np.tile(np.diag([4.0, 4.0, 9.0]), (count, 1, 1))),
        (SUBMAP, SUBMAP, LOOP, FOLDED)[:count],
    )
    tied = folded_ties(edges, np.arange(4), from_plane(x), np.array([1, 2]), "SE2")
    if is_tied:
        assert tied.kind == ()
        return
    assert (tied.i.tolist(), tied.j.tolist(), tied.kind) == ([0], [3], (FOLDED,))
    np.testing.assert_allclose(to_plane(tied.Ts_i_j[0]), x[3], atol=1e-6)
    assert 1.0 < 4.0 / tied.information[0, 0, 0] < 4.0
