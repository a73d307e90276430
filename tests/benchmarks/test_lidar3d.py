"""Benchmarks of 3D LiDARs: what they hold against the truth and the peer; nothing is timed here."""

import ast
import dataclasses
import sys
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.geometry.trajectory import Trajectory
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep
from odomap.simulation.sweepspec import SweepSpec
from odomap.sources.open import open as open_source

TWIST = np.array([8.0, 0.0, 0.1, 0.0, 0.0, 0.4])
PERIOD = 0.1
FAKE = """
class KISSConfig:
    class data: deskew, max_range = True, 0.0
    class mapping: voxel_size = None
class KissICP:
    def __init__(self, config):
        self.last_pose, self.config = __import__("numpy").eye(4), config
    def register_frame(self, points, times):
        {body}
        self.last_pose[0, 3] += points[:, 0].mean() + 100 * times.sum()
"""


@pytest.fixture
def odometry(load):
    return load("lidar3d_odometry")


@pytest.fixture
def runs(load):
    return load("lidar3d_runs")


def a_drive(count=150, twist=TWIST):
    """Return a drive at a constant motion."""
    Ts = np.array([se3_exp(k * PERIOD * twist) for k in range(count)])
    return Trajectory((np.arange(count) * PERIOD * 1e9).astype(np.int64), Ts)


# ---- odometry ----


@pytest.mark.parametrize("seconds", [-0.05, 0.0, 0.03, 0.1])
def test_where_a_body_is_between_stamps(odometry, seconds):
    truth = a_drive(5)
    moved = odometry.moved(truth, np.full(5, seconds))
    expected = [se3_exp((k * PERIOD + seconds) * TWIST) for k in range(5)]
    np.testing.assert_allclose(moved.Ts_world_body, expected, atol=1e-9)


def test_only_a_peer_is_judged_at_the_moment_that_suits_it(odometry):
    straight, turning = a_drive(70, TWIST * [1, 0, 0, 0, 0, 0]), a_drive(70)
    Ts = [*straight.Ts_world_body, *(straight.Ts_world_body[-1] @ turning.Ts_world_body[1:])]
    truth = Trajectory((np.arange(139) * PERIOD * 1e9).astype(np.int64), np.array(Ts))
    spans = np.tile([0.0, PERIOD], (len(truth), 1))
    at_the_end = odometry.moved(truth, spans[:, 1])

    def found(who, is_compensated):
        way = odometry.Way(who, is_compensated)
        return odometry.found(at_the_end, truth, spans, way, np.full((9, 2), 5.0), 0)

    assert found("KISS-ICP", True).ate_m < 1e-9
    assert found("KISS-ICP", True).deg_per_m < 1e-9
    assert found("points", False).ate_m < 1e-9
    assert found("points", True).ate_m > 0.05
    spans[:] = 0.0  # the truth is not known in between
    assert found("KISS-ICP", True).ate_m > 0.05


def test_figures_are_those_of_a_path_that_is_off_by_a_known_share(odometry):
    truth = a_drive(200, np.array([8.0, 0, 0, 0, 0, 0]))
    off = a_drive(200, np.array([8.08, 0, 0, 0, 0, 1e-4]))
    way = odometry.Way("points", True)
    ms = np.outer([900.0, 900.0, 1.0, 2.0, 9.0], [1.0, 0.5])
    found = odometry.found(off, truth, np.zeros((200, 2)), way, ms, 3)
    assert found.percent == pytest.approx(1.0, rel=0.05)
    assert 8.0 * found.deg_per_m == pytest.approx(np.degrees(1e-4), rel=0.02)
    assert found.per10_m == pytest.approx(0.1, rel=0.05)
    assert (found.ms, found.cpu_ms, found.lost) == (2.0, 1.0, 3)
    first = [Trajectory(t.stamps_ns[:20], t.Ts_world_body[:20]) for t in (off, truth)]
    short = odometry.found(*first, np.zeros((20, 2)), way, ms, 0)
    assert np.isnan(short.percent)
    assert np.isfinite(short.per10_m)


def fake_peer(tmp_path, monkeypatch, body="pass"):
    """Have this Python do for one with KISS-ICP."""
    package = tmp_path / "kiss_icp"
    package.mkdir()
    (package / "__init__.py").write_text("")
    for name in ("config", "kiss_icp"):
        (package / f"{name}.py").write_text(FAKE.format(body=body))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


@pytest.mark.parametrize("is_compensated", [False, True])
def test_sweeps_arrive_at_the_peer_as_they_are(odometry, tmp_path, monkeypatch, is_compensated):
    fake_peer(tmp_path, monkeypatch)
    truth = a_drive(4)
    said = []
    monkeypatch.setattr(odometry, "found", lambda path, *rest: said.append((path, *rest)))
    rng = np.random.default_rng(0)
    clouds = [rng.normal(5.0, 1.0, (n, 3)) for n in (7, 2000, 1, 300)]
    times = [rng.uniform(0, 1e-3, len(c)) for c in clouds]
    with ExitStack() as stack:
        way = odometry.Way("KISS-ICP", is_compensated)
        peer = odometry.Kiss(sys.executable, LidarMount("top"), way, stack)
        for stamp, cloud, when in zip(truth.stamps_ns.tolist(), clouds, times):
            peer.tell(SimpleNamespace(stamp_ns=stamp, cloud=Sweep(cloud, when)))
        peer.end(truth, np.zeros((4, 2)))
    ((path, _, _, _, ms, lost),) = said
    steps = [c[:, 0].mean() + is_compensated * 100 * t.sum() for c, t in zip(clouds, times)]
    np.testing.assert_allclose(path.Ts_world_body[:, 0, 3], np.cumsum(steps))
    np.testing.assert_array_equal(path.stamps_ns, truth.stamps_ns)
    assert (ms.shape, lost) == ((4, 2), 0)


def test_a_peer_that_fails_is_told_of(odometry, tmp_path, monkeypatch):
    fake_peer(tmp_path, monkeypatch, 'raise ValueError("no such thing")')
    with ExitStack() as stack:
        peer = odometry.Kiss(
            sys.executable, LidarMount("top"), odometry.Way("KISS-ICP", True), stack
        )
        sweep = SimpleNamespace(stamp_ns=0, cloud=Sweep(np.full((10, 3), 5.0)))
        tell_all = [peer.tell] * 5000  # the pipe holds some that nobody reads
        with pytest.raises(SystemExit, match="KISS-ICP failed: ValueError: no such thing"):
            any(tell(sweep) for tell in tell_all)


def test_the_peer_does_not_import_odomap(folder):
    tree = ast.parse((folder / "lidar3d_peer.py").read_text("utf-8"))
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert not any(name.split(".")[0] == "odomap" for name in names)


def test_all_follow_the_same_drive(odometry, tmp_path, monkeypatch):
    fake_peer(tmp_path, monkeypatch)
    source = open_source("sim:street?sensors=lidar3d&frames=5&beams=16&columns=300&range_m=60")
    ways = [odometry.Way("KISS-ICP", True), odometry.Way("points", True)]
    for is_recorded in (True, False):
        told = odometry.followed(source, ways, sys.executable, is_recorded)
        assert list(told) == ways
        assert told[ways[1]].lost == 0
        assert told[ways[1]].ate_m < 0.05


# ---- the bars ----


@pytest.fixture
def bench(load):
    module = load("lidar3d")
    return module, module.Bench(SimpleNamespace(json=None, front_ends=["points"]))


@pytest.mark.parametrize(
    ("who", "changes", "says"),
    [
        ("points", {}, None),
        ("points", {"ate_m": 0.11}, "0.1100 m of ATE, KISS-ICP 0.1000"),
        ("points", {"per10_m": 0.31}, "m over 10 m"),
        ("points", {"ms": 34.0}, "0.34 of KISS-ICP's time"),
        ("points", {"lost": 1}, "1 sweeps lost"),
        ("loam", {"ate_m": 0.14, "per10_m": 0.44}, None),
        ("lego", {"ate_m": 0.16}, "m of ATE"),
        ("loam", {"ate_m": float("nan")}, "m of ATE"),
    ],
)
def test_what_counts_as_missed_beside_the_peer(bench, who, changes, says):
    module, kept = bench
    peer = module.Found(0.1, 0.3, 0.1, np.nan, np.nan, 100.0, 150.0, 90.0, 0)
    ours = dataclasses.replace(peer, ms=33.0)
    module.below_kiss(kept, module.Way(who, True), dataclasses.replace(ours, **changes), peer)
    assert len(kept.missed) == (says is not None)
    assert says is None or says in kept.missed[0]


def test_time_is_held_against_who_does_the_same(bench):
    module, _ = bench
    assert [module.alike(module.Way("points", is_done)) for is_done in (False, True)] == list(
        module.KISS
    )


def test_the_best_of_a_peer_is_that_of_each_figure(bench):
    module, _ = bench
    a = module.Found(0.1, 0.3, 0.1, 1.0, 0.01, 100.0, 150.0, 90.0, 0)
    b = dataclasses.replace(a, ate_m=0.2, per10_m=0.1, ms=90.0)
    assert module.over([a, b], np.min) == dataclasses.replace(a, per10_m=0.1, ms=90.0)
    assert module.over([a, b, b], np.median) == b


# ---- runs ----


class Noting:
    """A front-end that notes what it is told."""

    def __init__(self):
        self.known = []

    def clear(self):
        self.known.clear()

    def insert(self, *sweep):
        self.known.append(sweep[0])


def test_odometry_knows_the_last_sweeps_alone(runs):
    inner = Noting()
    front_end = runs.LastSweeps(inner, 3)
    for k in range(6):
        front_end.insert(k, np.eye(4), np.zeros(6))
        assert inner.known == list(range(max(0, k - 2), k + 1))
    front_end.clear()
    front_end.insert(9, np.eye(4), np.zeros(6))
    assert inner.known == [9]


def test_how_far_the_end_is_from_the_way_there(runs):
    there = a_drive(9).Ts_world_body
    between = se3_exp(0.5 * PERIOD * TWIST)
    shifted = np.array(between)
    shifted[:3, 3] += [0.3, 0.0, 0.4]
    for last, expected in ((between, 0.0), (shifted, 0.5)):
        path = Trajectory(np.arange(10), np.concatenate([there, last[None]]))
        assert runs.apart(path) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_planes_are_as_thick_as_sweeps_lie_apart(runs, seed):
    """Leaves, which no sweep shows as a plane, do not count."""
    rng = np.random.default_rng(seed)
    map, sigma, apart = Map(), 0.01, 0.08 * np.array([1.0, -1.0, 1.0, -1.0])
    for k in range(4):
        floor = np.column_stack([rng.uniform(-10, 10, (9000, 2)), rng.normal(0.5, sigma, 9000)])
        sides = rng.uniform([-4, 1], [4, 5], (900, 2))
        ahead = np.column_stack([rng.normal(15.5 + apart[k], sigma, 900), sides])
        leaves = rng.uniform([-8, -8, 2], [8, 8, 18], (20000, 3))
        T = se3_exp(np.array([0.7 * k, 0.1, 0, 0, 0, 0.1 * k]))
        seen = np.concatenate([floor, ahead, leaves]) - T[:3, 3]
        cloud = np.column_stack([seen @ T[:3, :3], np.zeros(len(seen))]).astype(np.float32)
        keyframe = Keyframe(map.new_keyframe_id(), k, cloud=cloud)
        map.add_keyframe(keyframe, T)
    whole, across = runs.thickness(map)
    assert whole == pytest.approx(1e3 * sigma, rel=0.1)
    assert across == pytest.approx(80.6, rel=0.1)


def test_motion_is_judged_step_by_step_and_as_a_whole(runs):
    truth = a_drive(30)
    longer = a_drive(30, TWIST * [1.01, 0, 1.01, 0, 0, 1])
    step, whole = runs.motion(longer, truth)
    assert step == pytest.approx(1.0, rel=0.01)
    assert whole == pytest.approx(1.0, rel=0.01)
    moved = Trajectory(truth.stamps_ns, se3_inverse(truth.Ts_world_body[4]) @ truth.Ts_world_body)
    np.testing.assert_allclose(runs.motion(moved, truth), 0.0, atol=1e-6)


def test_why_sweeps_were_lost_is_said_once(runs):
    reasons = {4: "only 20 % lie", 5: "only 13 % lie", 9: "no sweep"}
    assert runs.said(SimpleNamespace(reasons=reasons)) == [
        "2 from 4 on: only 20 % lie",
        "1 from 9 on: no sweep",
    ]


def test_a_street_is_mapped_thinner_with_deskewing(runs):
    world = "sim:street?sensors=lidar3d&frames=40&beams=24&columns=600&range_m=60&speed=12&seed=3"
    got = runs.deskewed(world)
    assert got.with_mm < got.without_mm
    assert got.across_with_mm < 0.7 * got.across_without_mm
    assert got.motion_percent < 1.0
    assert got.length_percent < 0.2


# ---- labels ----


def test_labels_of_a_street_are_judged(load):
    labels = load("lidar3d_labels")
    spec = SweepSpec(seed=2, frames=8, beams=32, columns=900)
    for name in ("loam", "lego"):
        got = labels.labelled(name, spec, [2, 7])
        assert min(got.edges, got.planes) > 0.95
        assert got.num_edges > 200
        assert np.isnan(got.ground) == (name == "loam")


def test_labels_that_are_wrong_are_found_out(load, monkeypatch):
    labels = load("lidar3d_labels")

    class Wrong:
        def prepare(self, sweep):
            rng = np.random.default_rng(0)
            marks = rng.choice([labels.EDGE, labels.PLANE], len(sweep))
            return SimpleNamespace(marks=marks, ground=rng.random(len(sweep)) < 0.5)

    monkeypatch.setitem(labels.MAKERS, "lego", Wrong)
    got = labels.labelled("lego", SweepSpec(seed=2, frames=3, beams=16, columns=600), [2])
    assert got.edges < 0.3
    assert 0.3 < got.planes < 0.95
    assert got.ground < 0.8
    assert got.ground_found == pytest.approx(0.5, abs=0.05)


# ---- memory ----


def test_what_grows_from_the_second_round_on_is_told(bench, load, capsys):
    module, kept = bench
    small = load("laser2d_runs").Held(10, 0, 10, 1.0, 5.0, 100.0, 0, 0.01, 1.0, 5.0)
    large = dataclasses.replace(small, keyframes=100, file_mb=10.0)
    module.tell_growth(kept, [small, large, large], module.GROWING)
    assert not kept.missed
    larger = dataclasses.replace(large, file_mb=13.1, lost=2)
    module.tell_growth(kept, [small, large, larger], module.GROWING)
    assert kept.missed == ["memory: 1.31 times the file_mb, at most 1.3", "memory: 2 scans lost"]
    assert len(kept.numbers["memory"]) == 3
    assert "13.10" in capsys.readouterr().out


def test_a_room_is_gone_round(load, runs):
    laser2d_runs = load("laser2d_runs")
    world = "sim:room?sensors=lidar3d&beams=16&columns=240&rate_hz=2.5&rounds=2"
    first, second = laser2d_runs._gone_round(world, 2, runs.config_of("points"), runs.nees)
    assert (first.lost, second.lost, first.submaps) == (0, 0, 0)
    assert 5 < first.keyframes <= second.keyframes <= 2.2 * first.keyframes
    assert 0 < first.file_mb < second.file_mb
    assert second.ate_m < 0.1
