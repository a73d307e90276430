"""Disturbances of 3D LiDARs do what they say, nest, and leave the rest alone."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.lie import so3_exp
from odomap.lidar.sweeps import points_of
from odomap.sensors.sweep import Sweep
from odomap.sources import disturb
from odomap.sources.simulated import SimulatedSource
from odomap.sources.source import Source

NAME = "sim:street?sensors=lidar3d&seed=2&frames=12&beams=16&columns=200"


@pytest.fixture(scope="module")
def street() -> SimulatedSource:
    return SimulatedSource(NAME)


def sweeps(source: Source) -> list[Sweep]:
    found = [frame.cloud for frame in source]
    assert all(sweep is not None for sweep in found)
    return found  # type: ignore[return-value]


def same(a: Sweep, b: Sweep) -> bool:
    return [x.tobytes() for x in a.arrays()] == [x.tobytes() for x in b.arrays()]


def in_world(source: SimulatedSource, sweep: Sweep, seconds: float) -> np.ndarray:
    """Return the points of a sweep in the world, by the exact motion from some seconds on."""
    assert sweep.times is not None
    Ts = source.world.path.at(seconds + sweep.times).Ts_world_body  # type: ignore[union-attr]
    return np.einsum("nij,nj->ni", Ts[:, :3, :3], sweep.points) + Ts[:, :3, 3]


@pytest.mark.parametrize(
    ("how", "count"), [("empty", 0), ("one", 1), ("nan", None), ("zero", None)]
)
def test_sweeps_that_say_nothing(street: SimulatedSource, how: str, count: int | None) -> None:
    lost = sweeps(disturb.lose_sweeps(street, [3], how))  # type: ignore[arg-type]
    for k, (sweep, plain) in enumerate(zip(lost, sweeps(street), strict=True)):
        if k != 3:
            assert same(sweep, plain)
            continue
        assert len(sweep) == (len(plain) if count is None else count)
        usable = points_of(sweep, street.rig.lidars[0])
        assert len(usable) == (1 if how == "one" else 0)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_misses_stand_between_what_returned(street: SimulatedSource, value: float) -> None:
    padded = disturb.with_misses(street, share=0.4, value=value, seed=1)
    for sweep, plain in zip(sweeps(padded), sweeps(street), strict=True):
        assert len(plain) / len(sweep) == pytest.approx(0.6, abs=0.01)
        assert sweep.times is not None
        assert (np.diff(sweep.times) >= 0).all()
        usable = points_of(sweep, street.rig.lidars[0])
        np.testing.assert_array_equal(usable.points, plain.points)
        np.testing.assert_array_equal(usable.beams, plain.beams)
    assert same(padded.frame(4).cloud, padded.frame(4).cloud)  # type: ignore[attr-defined]


def test_a_turned_mount_the_rig_knows_of_changes_nothing(street: SimulatedSource) -> None:
    R = so3_exp(np.array([0.2, -0.1, 1.3]))
    told, untold = (disturb.turn_lidar(street, R, told=told) for told in (True, False))
    plain = points_of(sweeps(street)[5], street.rig.lidars[0]).points
    known = points_of(sweeps(told)[5], told.rig.lidars[0]).points
    np.testing.assert_allclose(known, plain, atol=1e-9)
    assert untold.rig == street.rig
    wrong = points_of(sweeps(untold)[5], untold.rig.lidars[0]).points
    assert np.abs(wrong - plain).max() > 5.0


def test_what_is_said_beside_the_points(street: SimulatedSource) -> None:
    plain = sweeps(street)[2]
    assert plain.times is not None
    slow = sweeps(disturb.misscale_times(street, 1e3))[2]
    np.testing.assert_array_equal(slow.times, 1e3 * plain.times)
    np.testing.assert_array_equal(slow.points, plain.points)
    bare = sweeps(disturb.without_columns(street, ("times", "beams", "intensities")))[2]
    assert repr(bare) == f"Sweep({len(plain)} points)"
    untimed = sweeps(disturb.without_columns(street))[2]
    assert same(replace(untimed, times=plain.times), plain)
    wrong = disturb.miscount_beams(street, 32)
    assert wrong.rig.lidars[0].beams == 32
    assert street.rig.lidars[0].beams == 16
    assert same(sweeps(wrong)[2], plain)


def test_compensated_points_are_where_they_were_at_the_stamp(street: SimulatedSource) -> None:
    assert street.truth is not None
    made, kept = (disturb.compensate(street, keep_times=keep) for keep in (False, True))
    for k in (0, 6, 11):
        plain, sweep = street.frame(k).cloud, made.frame(k).cloud  # type: ignore[attr-defined]
        assert plain is not None
        exact = in_world(street, plain, k / 10)
        T = street.truth.Ts_world_body[k]
        raw = plain.points @ T[:3, :3].T + T[:3, 3]
        off = np.linalg.norm(sweep.points @ T[:3, :3].T + T[:3, 3] - exact, axis=1)
        assert np.median(off) < 0.01
        assert np.median(np.linalg.norm(raw - exact, axis=1)) > 0.2
        assert sweep.times is None
        twice = kept.frame(k).cloud  # type: ignore[attr-defined]
        np.testing.assert_array_equal(twice.times, plain.times)
        np.testing.assert_array_equal(twice.points, sweep.points)
    assert made.rig.lidars[0].sweep == "none"
    assert kept.rig == street.rig


def test_backwards_points_come_before_the_stamp(street: SimulatedSource) -> None:
    back = disturb.reverse(street)
    assert back.truth is not None
    assert back.rig.lidars[0].sweep == "counter_clockwise"
    for k in (0, 5):
        sweep, plain = back.frame(k).cloud, street.frame(11 - k).cloud  # type: ignore[attr-defined]
        assert sweep.times is not None
        assert (np.diff(sweep.times) >= 0).all()
        assert sweep.times.max() <= 0
        # An instant t of the film backwards is first + last - t of the world.
        assert back.truth.stamps_ns[k] == back.stamps_ns[k]  # type: ignore[attr-defined]
        played = (back.stamps_ns[k] - street.stamps_ns[0]) * 1e-9 + sweep.times  # type: ignore[attr-defined]
        Ts = street.world.path.at(1.1 - played).Ts_world_body  # type: ignore[union-attr]
        placed = np.einsum("nij,nj->ni", Ts[:, :3, :3], sweep.points) + Ts[:, :3, 3]
        exact = in_world(street, plain, (11 - k) / 10)
        np.testing.assert_allclose(placed[::-1], exact, atol=1e-6)


def test_there_and_back_mirrors_the_way_back_alone(street: SimulatedSource) -> None:
    played = disturb.there_and_back(street)
    times = [sweep.times for sweep in sweeps(played)]
    plain = sweeps(street)
    for k in range(12):
        assert times[k] is not None
        forth = k < 6
        assert (times[k].min() >= 0) if forth else (times[k].max() <= 0)  # type: ignore[union-attr]
        order = 2 * k if forth else 23 - 2 * k
        assert len(times[k]) == len(plain[order])  # type: ignore[arg-type]
    # Across the stamp the speed is that of the drive: two steps of the world in two of the film.
    assert played.truth is not None
    steps = np.linalg.norm(np.diff(played.truth.positions, axis=0), axis=1)
    seconds = np.diff(played.truth.stamps_ns) * 1e-9
    assert (steps / seconds)[0] == pytest.approx(7.5, rel=0.5)


def test_the_general_ones_keep_sweeps(street: SimulatedSource) -> None:
    nested = disturb.set_back(disturb.drop(disturb.duplicate(street, [2]), range(4, 9)), [10])
    frames = list(nested)
    assert [f.id for f in frames] == [0, 1, 2, 2, 3, 9, 10, 11]
    assert frames[3].cloud is frames[2].cloud
    assert frames[3].stamp_ns > frames[2].stamp_ns
    assert frames[6].stamp_ns < frames[5].stamp_ns


def test_what_cannot_be_disturbed_says_so(street: SimulatedSource) -> None:
    laser = SimulatedSource("sim:hall?sensors=laser&frames=2&beams=31")
    for call, words in (
        (lambda: disturb.lose_sweeps(laser, [0]), "lose_sweeps needs a rig with a 3D LiDAR"),
        (lambda: disturb.lose_sweeps(street, [0], "some"), "how 'some' is none of"),  # type: ignore[arg-type]
        (lambda: disturb.with_misses(street, share=1.0), "share 1.0 must be from 0 to below 1"),
        (lambda: disturb.turn_lidar(street, 2 * np.eye(3)), "must be a rotation"),
        (lambda: disturb.miscount_beams(street, -1), "beams -1 must be"),
        (lambda: disturb.misscale_times(street, np.inf), "factor inf must be finite"),
        (lambda: disturb.without_columns(street, ["time"]), "'time' is none of times"),
    ):
        with pytest.raises(InputError, match=words):
            call()
    blind = disturb.drop(street, [])
    blind.truth = None
    with pytest.raises(InputError, match="compensate needs a source with truth"):
        disturb.compensate(blind)
