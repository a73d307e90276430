"""A body that was carried elsewhere: it is not tracked on where it was.

It is lost, and found in the map, or begins a piece of its own; the piece is joined when it comes to
what is known.
"""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.lie import se3_inverse, se3_log
from odomap.maps.atlas import Atlas
from odomap.maps.edges import GAP
from odomap.maps.estimate import Status
from odomap.sources import disturb
from sweepruns import LEAST, PLACED, Kept, errors, judge, played, tracked


@pytest.fixture(scope="module")
def long_street():
    return Kept("street", 16, 120, 2)


def carried(source, *parts, dark=0):
    """Return frames of a source in parts as if it was carried from one to the next; true poses.

    After each the LiDAR sees nothing for some sweeps.
    """
    made, true = [], []
    for part in parts:
        for n, k in enumerate(part):
            frame = source.frame(k)
            is_dark = part is not parts[0] and n < dark
            cloud = frame.cloud.only(np.arange(0)) if is_dark else frame.cloud
            stamp_ns = 100_000_000 * (len(made) + 1)
            made.append(replace(frame, id=len(made), stamp_ns=stamp_ns, cloud=cloud))
            true.append(source.truth.Ts_world_body[k])
    return made, np.array(true)


@pytest.mark.parametrize("dark", [0, 6, 30])
def test_carried_to_where_it_was_it_is_recognised(long_street, dark):
    made, true = carried(long_street, range(70), range(20, 60), dark=dark)
    estimates, system, _ = played(made, long_street.rig)
    judge(estimates, true)
    found = next(e.frame_id for e in estimates[70:] if e.status is Status.RECOVERED)
    assert 70 + dark <= found < 70 + dark + 8
    assert all(e.status in PLACED for e in estimates[found:])
    assert np.linalg.norm(errors(estimates, true)[found + 2 :, :3], axis=1).max() < 0.4
    assert GAP not in system.map.edges().kind


@pytest.mark.parametrize("dark", [0, 30])
def test_carried_to_where_it_never_was_it_begins_anew(long_street, dark):
    """Neither is it taken to be where it should have been, nor is what was mapped lost."""
    made, true = carried(long_street, range(40), range(70, 120), dark=dark)
    estimates, system, _ = played(made, long_street.rig)
    judge(estimates[:40], true[:40])
    begun = [e.frame_id for e in estimates if e.status is Status.INITIALIZING]
    assert len(begun) == 1
    assert 40 + dark < begun[0] < 40 + dark + 12
    assert all(e.status is Status.LOST for e in estimates[40 : begun[0]])
    assert "carried off" in estimates[begun[0] - 1].reason
    # Of the piece nobody knows where it is, but within it all is right.
    piece = estimates[begun[0] + 2 :]
    first = piece[0].T_world_body.matrix
    moved = [se3_inverse(first) @ e.T_world_body.matrix for e in piece]
    truly = se3_inverse(true[begun[0] + 2]) @ true[begun[0] + 2 :]
    off = [se3_log(se3_inverse(T) @ M)[:3] for T, M in zip(truly, moved, strict=True)]
    assert np.linalg.norm(off, axis=1).max() < 0.4
    assert len(Atlas(system.map).pieces) == 2


def test_the_piece_is_joined_when_it_comes_to_what_is_known(long_street):
    backwards = disturb.reverse(long_street)
    made, true = carried(long_street, range(60))
    for n in range(110):
        frame = backwards.frame(n)
        made.append(replace(frame, id=len(made), stamp_ns=100_000_000 * (len(made) + 1)))
        true = np.concatenate([true, backwards.truth.Ts_world_body[n : n + 1]])
    _, system, result = played(made, long_street.rig)
    assert any(loop.merges for loop in result.loops if loop.is_accepted)
    assert len(Atlas(system.map).pieces) == 1
    rows = result.trajectory.stamps_ns // 100_000_000 - 1
    first = se3_inverse(true[0]) @ true[rows]
    off = np.linalg.norm(result.trajectory.Ts_world_body[:, :3, 3] - first[:, :3, 3], axis=1)
    assert off[rows < 60].max() < 0.4
    assert off[rows > 75].max() < 0.8
    assert (rows > 75).sum() > 80


def test_in_a_map_it_is_placed_at_once_and_outside_it_is_not(long_street):
    _, system, _ = played([long_street.frame(k) for k in range(60)], long_street.rig)
    other = Kept("street", 32, 120, 2)
    made = [other.frame(k) for k in (*range(8, 20), *range(105, 112))]
    made = [replace(frame, id=n, stamp_ns=10**8 * (n + 1)) for n, frame in enumerate(made)]
    keyframes = system.map.num_keyframes
    estimates, _, result = played(made, other.rig, map=system.map, is_mapping=False)
    found = next(n for n, e in enumerate(estimates) if e.status is Status.TRACKING)
    assert found <= 3  # the motion over the first nobody knows
    assert all("not recognised" in e.reason for e in estimates[:found])
    assert all(e.status is Status.TRACKING for e in estimates[found:12])
    origin = se3_inverse(long_street.truth.Ts_world_body[0])
    true = origin @ other.truth.Ts_world_body[8:20]
    for e, T in zip(estimates[found:12], true[found:], strict=True):
        x = se3_log(se3_inverse(T) @ e.T_world_body.matrix)
        assert (np.abs(x) < LEAST + 4.0 * np.sqrt(np.diag(e.covariance))).all()
    assert all(e.status is Status.LOST for e in estimates[12:])
    assert result.map.num_keyframes == keyframes


@pytest.mark.parametrize("front_end", ["loam"])
def test_features_do_not_hide_that_it_was_carried_to_where_it_was(long_street, front_end):
    made, true = carried(long_street, range(70), range(20, 40))
    estimates, system = tracked(made, long_street.rig, front_end)
    assert estimates[70].status is Status.LOST
    assert "carried off?" in estimates[70].reason
    judge(estimates, true)
    found = next(e.frame_id for e in estimates[70:] if e.status is Status.RECOVERED)
    assert found < 76
    assert all(e.status in PLACED for e in estimates[found:])
    assert np.linalg.norm(errors(estimates, true)[found + 2 :, :3], axis=1).max() < 0.4
    assert len(Atlas(system.map).pieces) == 1


@pytest.mark.parametrize("front_end", ["lego"])
def test_features_do_not_hide_that_it_was_carried_to_where_it_never_was(long_street, front_end):
    made, true = carried(long_street, range(40), range(70, 100))
    estimates, system = tracked(made, long_street.rig, front_end)
    begun = next(e.frame_id for e in estimates if e.status is Status.INITIALIZING)
    assert 43 < begun < 53
    assert all(e.status is Status.LOST for e in estimates[40:begun])
    piece = [e.T_world_body.matrix for e in estimates[begun + 2 :]]
    moved = se3_inverse(piece[0]) @ np.array(piece)
    truly = se3_inverse(true[begun + 2]) @ true[begun + 2 :]
    assert np.linalg.norm(moved[:, :3, 3] - truly[:, :3, 3], axis=1).max() < 0.4
    assert len(Atlas(system.map).pieces) == 2
