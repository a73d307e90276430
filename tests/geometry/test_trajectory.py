import pickle

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry import lie
from odomap.geometry.pose import SE3, Sim3
from odomap.geometry.trajectory import Trajectory
from reference import associate


def path(n=20, step_ns=50_000_000, seed=1, covariances=False):
    rng = np.random.default_rng(seed)
    poses, pose = [], SE3.identity()
    for _ in range(n):
        poses.append(pose)
        pose = pose @ SE3.exp([0.1, 0.0, 0.0, *(0.1 * rng.normal(size=3))])
    made = Trajectory.of_poses(1_403_636_579_763_555_584 + step_ns * np.arange(n), poses)
    if not covariances:
        return made
    spread = np.tile(np.diag(np.arange(1.0, 7.0)), (n, 1, 1)) * np.arange(1, n + 1)[:, None, None]
    return Trajectory(made.stamps_ns, made.Ts_world_body, spread)


def test_what_it_says_of_itself():
    p = path()
    assert len(p) == 20
    assert p.path_length == pytest.approx(
        np.linalg.norm(np.diff(p.positions, axis=0), axis=1).sum()
    )
    assert p.duration_s == pytest.approx(0.95)
    assert p == Trajectory(p.stamps_ns, p.Ts_world_body)
    assert p != path(seed=2)
    assert p != path(covariances=True)
    again = pickle.loads(pickle.dumps(path(covariances=True)))
    assert again == path(covariances=True)
    assert not again.Ts_world_body.flags.writeable
    assert "20 poses, 0.950 s" in repr(p)
    assert p.pose(3) == SE3(p.Ts_world_body[3])
    with pytest.raises(ValueError, match="read-only"):
        p.stamps_ns[0] = 0
    with pytest.raises(ValueError, match="read-only"):
        p.Ts_world_body[0, 0, 0] = 0


def test_an_empty_path_is_a_path():
    empty = Trajectory(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)))
    assert (len(empty), empty.path_length, empty.duration_s) == (0, 0.0, 0.0)
    assert len(empty.between(0, 10)) == 0
    assert len(empty.resample(10.0)) == 0
    assert len(empty.associate(path())[0]) == 0
    assert len(path().associate(empty)[0]) == 0
    assert len(path().interpolate(np.empty(0, dtype=np.int64))) == 0
    with pytest.raises(InputError, match="empty"):
        empty.interpolate([1])


def test_interpolation_follows_the_geodesic():
    p = path()
    same = p.interpolate(p.stamps_ns)
    np.testing.assert_allclose(same.Ts_world_body, p.Ts_world_body, rtol=0, atol=1e-14)
    quarter = p.interpolate(p.stamps_ns[:-1] + 12_500_000)
    for i in (0, 7, 18):
        step = (p.pose(i).inverse() @ p.pose(i + 1)).log()
        expected = p.pose(i) @ SE3.exp(0.25 * step)
        np.testing.assert_allclose(quarter.Ts_world_body[i], expected.matrix, atol=1e-14)


def test_constant_twist_is_reproduced_exactly():
    xi = np.array([1.0, 0.2, -0.1, 0.3, -0.5, 0.8])
    coarse = Trajectory(1000 * np.arange(5), lie.se3_exp(np.arange(5)[:, None] * 0.5 * xi))
    fine = coarse.interpolate(np.arange(0, 4001, 10))
    expected = lie.se3_exp(np.arange(0, 4001, 10)[:, None] * 0.5e-3 * xi)
    np.testing.assert_allclose(fine.Ts_world_body, expected, rtol=0, atol=1e-13)


def test_covariances_are_blended():
    p = path(covariances=True)
    middle = p.interpolate(p.stamps_ns[:1] + 25_000_000)
    np.testing.assert_allclose(middle.covariances[0], 1.5 * p.covariances[0])


def test_interpolation_does_not_extrapolate():
    p = path()
    with pytest.raises(InputError, match="outside"):
        p.interpolate([p.stamps_ns[-1] + 1])
    with pytest.raises(InputError, match="outside"):
        p.interpolate([p.stamps_ns[0] - 1])


def stamped(stamps):
    stamps = np.unique(np.asarray(stamps, dtype=np.int64))
    return Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))


@pytest.mark.parametrize("seed", range(12))
def test_association_is_the_benchmarks_rule(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 80, 2)
    start = 1_403_636_579_763_555_584
    # Stamps on a coarse lattice make ties; they must fall as in the benchmark.
    unit = 1_000_000 if seed % 2 else 10_000_000
    ours = stamped(start + unit * rng.integers(0, 100, n))
    theirs = stamped(start + unit * rng.integers(0, 100, m))
    a, b = ours.associate(theirs, 0.02)
    expected = associate(ours.stamps_ns, theirs.stamps_ns, 20_000_000)
    assert list(zip(a.tolist(), b.tolist(), strict=True)) == expected
    assert np.all(np.diff(a) > 0)
    assert len(np.unique(b)) == len(b)


def test_association_limit_is_inclusive():
    a, b = stamped([0, 10**9]).associate(stamped([20_000_000, 10**9 + 20_000_001]), 0.02)
    assert (a.tolist(), b.tolist()) == ([0], [0])
    with pytest.raises(InputError, match="max_dt_s"):
        stamped([0]).associate(stamped([0]), -1.0)


def test_resampling_ticks_do_not_drift():
    p = path(100, 33_333_333)
    r = p.resample(30.0)
    offsets = r.stamps_ns - p.stamps_ns[0]
    assert offsets.tolist() == [round(i * 1e9 / 30.0) for i in range(len(r))]
    assert p.stamps_ns[-1] - r.stamps_ns[-1] < 1e9 / 30.0
    with pytest.raises(InputError, match="rate_hz"):
        p.resample(0.0)


def test_transformed_by_motions_and_similarities():
    p = path(covariances=True)
    T = SE3.exp([1.0, 2.0, 3.0, 0.3, 0.4, 0.5])
    moved = p.transformed(T)
    np.testing.assert_allclose(moved.Ts_world_body, T.matrix @ p.Ts_world_body, atol=1e-14)
    np.testing.assert_array_equal(moved.covariances, p.covariances)
    back = moved.transformed(T.inverse())
    np.testing.assert_allclose(back.Ts_world_body, p.Ts_world_body, atol=1e-14)
    S = Sim3.from_parts(2.0, T.R, T.t)
    scaled = p.transformed(S)
    np.testing.assert_allclose(scaled.positions, S @ p.positions, atol=1e-13)
    np.testing.assert_allclose(scaled.Ts_world_body[:, :3, :3], T.R @ p.Ts_world_body[:, :3, :3])
    assert scaled.path_length == pytest.approx(2 * p.path_length)
    np.testing.assert_allclose(np.diagonal(scaled.covariances[0]), [4, 8, 12, 4, 5, 6])


def test_between_includes_both_ends():
    p = path()
    cut = p.between(int(p.stamps_ns[3]), int(p.stamps_ns[6]))
    assert cut == p.rows([3, 4, 5, 6])


@pytest.mark.parametrize(
    ("stamps", "Ts", "words"),
    [
        ([0, 0], np.tile(np.eye(4), (2, 1, 1)), "row 1 does not increase"),
        ([5, 1], np.tile(np.eye(4), (2, 1, 1)), "row 1 does not increase"),
        ([0.0, 1.0], np.tile(np.eye(4), (2, 1, 1)), "integer nanoseconds"),
        ([[0]], np.eye(4), "shape"),
        ([0, 1], np.eye(4), r"give \(2, 4, 4\)"),
        ([0], np.full((1, 4, 4), np.nan), "row 0 has NaN"),
        ([0], 2.0 * np.eye(4)[None], "last rows"),
        ([0], np.diag([1.0, 1.0, 1.1, 1.0])[None], "row 0 is not a rotation"),
        ([0], np.diag([1.0, 1.0, -1.0, 1.0])[None], "row 0 is not a rotation"),
    ],
)
def test_wrong_input_is_named(stamps, Ts, words):
    with pytest.raises(InputError, match=words):
        Trajectory(np.asarray(stamps), Ts)
    with pytest.raises(InputError, match="covariances"):
        Trajectory(np.array([0]), np.eye(4)[None], np.zeros((2, 6, 6)))
