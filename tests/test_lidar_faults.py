"""Whatever befalls a 3D LiDAR: the pose is right, or it is said that it is not known, and why.

Faults of a recording are disturbances of a simulated street. What a pose claims is held against the
truth: four standard deviations, and some centimetres.
"""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError
from odomap.geometry.lie import se3_inverse, se3_log, so3_exp
from odomap.maps.atlas import Atlas
from odomap.maps.edges import GAP
from odomap.maps.estimate import Status
from odomap.sources import disturb
from odomap.sources.wrappers import Changed
from odomap.system.slam import Slam
from sweepruns import LEAST, PLACED, Kept, errors, judge, played

TILTED = so3_exp(np.array([0.3, -0.2, 0.7]))


def repeated(source, chosen):
    """Give the sweep of the frame before again: a driver that hands a buffer over twice."""

    def change(frame):
        if frame.id not in chosen:
            return frame
        return replace(frame, cloud=source.frame(frame.id - 1).cloud)

    return Changed(source, "repeated", change)


NOTHING = {
    "empty": lambda s: disturb.lose_sweeps(s, range(25, 29), "empty"),
    "all NaN": lambda s: disturb.lose_sweeps(s, range(25, 29), "nan"),
    "all zero": lambda s: disturb.lose_sweeps(s, range(25, 29), "zero"),
    "one point": lambda s: disturb.lose_sweeps(s, range(25, 29), "one"),
}
FAULTS = NOTHING | {
    "none": lambda s: s,
    "zeros as no-return": lambda s: disturb.with_misses(s, share=0.4),
    "NaN as no-return": lambda s: disturb.with_misses(s, share=0.4, value=np.nan),
    "a sweep twice": lambda s: repeated(s, {25, 30, 35}),
    "five dropped": lambda s: disturb.drop(s, range(25, 30)),
    "turned": lambda s: disturb.turn_lidar(s, TILTED, told=True),
    "upside down": lambda s: disturb.turn_lidar(s, so3_exp(np.array([np.pi, 0, 0])), told=True),
    "stamps go back": lambda s: disturb.set_back(s, range(25, 60, 7), by_s=0.45),
    "the clock goes back": lambda s: disturb.set_back(s, range(25, 60), by_s=3.0),
    "no times": disturb.without_columns,
    "too many beams": lambda s: disturb.miscount_beams(s, 64),
    "no motion in them": disturb.compensate,
    "no motion in them, but times": lambda s: disturb.compensate(s, keep_times=True),
    "times twice as long": lambda s: disturb.misscale_times(s, 2.0),
}


@pytest.fixture(scope="module")
def street():
    return Kept("street", 16, 60, 2)


@pytest.fixture(scope="module")
def long_street():
    return Kept("street", 16, 120, 2)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_pose_is_right_or_not_claimed(street, fault):
    source = FAULTS[fault](street)
    made = list(source)
    estimates, _, result = played(made, source.rig)
    true = street.truth.Ts_world_body[[frame.id for frame in made]]
    off = judge(estimates, true)
    assert np.linalg.norm(off[-1, :3]) < 0.5
    assert all(e.status in PLACED for e in estimates[40:])
    lost = {e.frame_id: e.reason for e in estimates if e.status not in PLACED}
    if fault in NOTHING:
        assert set(lost) == set(range(25, 29))
        assert all("points returned from within range, 100 needed" in r for r in lost.values())
    elif fault == "a sweep twice":
        assert set(lost) == {25, 30, 35}
        assert all("the sweep is the one before" in reason for reason in lost.values())
    else:
        assert lost == {}
    # Each sweep with a pose has its row, with its stamp, and no keyframe is lost.
    stamps = sorted({e.stamp_ns for e in estimates if e.status in PLACED})
    assert result.trajectory.stamps_ns.tolist() == stamps
    assert result.map.num_keyframes > 12
    assert len(Atlas(result.map).pieces) == 1


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda s: disturb.misscale_times(s, 1e3), "lie 99.9 s apart, and a turn takes 0.1 s"),
        (
            lambda s: disturb.misscale_times(s, 1e-3),
            "all around lie 9.99e-05 s apart.*seconds",
        ),
        (
            lambda s: disturb.miscount_beams(s, 8),
            "is of beam 16, .* says that there are 8",
        ),
    ],
)
def test_what_the_rig_or_the_reader_has_wrong_is_told_and_nothing_lost(street, fault, words):
    made = list(street)[:20]
    source = fault(street)
    rig = source.rig
    with pytest.raises(CalibrationError, match=f"lidar 'top'.*{words}") as told:
        Slam(rig).track(source.frame(0))
    assert "\n" not in str(told.value)
    system = Slam(street.rig)
    _ = [system.track(frame) for frame in made]
    if rig is street.rig:
        with pytest.raises(CalibrationError):
            system.track(source.frame(20))
    assert system.finish().map.num_keyframes > 4


def test_a_mount_that_is_not_told_tilts_the_map_and_nothing_else(street):
    source = disturb.turn_lidar(street, TILTED)
    estimates, *_ = played(source, source.rig)
    T = np.eye(4)
    T[:3, :3] = TILTED
    true = street.truth.Ts_world_body
    off = judge(estimates, se3_inverse(T) @ se3_inverse(true[0]) @ true @ T)
    assert np.linalg.norm(off[-1, :3]) < 0.5
    assert np.linalg.norm(errors(estimates, true)[-1, :3]) > 5.0


def test_cars_in_a_fifth_of_the_points_do_not_pull():
    source = Kept("street", 16, 60, 3, more="&moving_objects=60")
    estimates, *_ = played(source, source.rig)
    assert all(e.status is Status.TRACKING for e in estimates)
    off = judge(estimates, source.truth.Ts_world_body)
    assert np.linalg.norm(off[-1, :3]) < 0.4


# ---- carried elsewhere ----


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
    made, true = carried(long_street, range(100), range(20, 70), dark=dark)
    estimates, system, _ = played(made, long_street.rig)
    judge(estimates, true)
    found = next(e.frame_id for e in estimates[100:] if e.status is Status.RECOVERED)
    assert 100 + dark <= found < 100 + dark + 8
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
