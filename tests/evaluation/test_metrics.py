import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.errors import InputError
from odomap.evaluation.metrics import ate, coverage, kitti_segments, rpe
from odomap.geometry.lie import se3_exp
from odomap.geometry.trajectory import Trajectory

SEEDS = st.integers(0, 2**32 - 1)


def path(seed: int = 0, n: int = 200, step_m: float = 0.1, dt_s: float = 0.05) -> Trajectory:
    """A smooth path: constant steps forward with slowly changing turns."""
    rng = np.random.default_rng(seed)
    Ts = np.tile(np.eye(4), (n, 1, 1))
    turn = np.zeros(3)
    for k in range(1, n):
        turn = 0.9 * turn + rng.normal(0, 0.01, 3)
        Ts[k] = Ts[k - 1] @ se3_exp(np.r_[step_m, 0, 0, turn])
    stamps = (np.arange(n) * round(dt_s * 1e9) + 1_403_636_579_763_555_584).astype(np.int64)
    return Trajectory(stamps, Ts)


def moved(trajectory: Trajectory, T: np.ndarray, scale: float = 1.0) -> Trajectory:
    Ts = trajectory.Ts_world_body.copy()
    Ts[:, :3, 3] *= scale
    return Trajectory(trajectory.stamps_ns, T @ Ts)


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_ate_does_not_see_the_world_frame(seed: int) -> None:
    truth = path(seed % 100)
    T = se3_exp(np.random.default_rng(seed).normal(0, 1, 6))
    result = ate(moved(truth, T), truth)
    assert result.rmse < 1e-9
    assert result.rot_rmse_deg < 1e-6
    assert result.matched == result.reference_poses == 200
    np.testing.assert_allclose(result.T_reference_estimate.matrix, np.linalg.inv(T), atol=1e-9)


def test_sim3_finds_the_scale_and_se3_does_not() -> None:
    truth = path()
    estimate = moved(truth, se3_exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])), scale=0.5)
    assert ate(estimate, truth, "sim3").scale == pytest.approx(2.0, abs=1e-9)
    assert ate(estimate, truth, "sim3").rmse < 1e-9
    assert ate(estimate, truth, "se3").rmse > 0.1
    assert rpe(estimate, truth, align="sim3").trans_rmse < 1e-9


def test_each_alignment_leaves_what_it_should() -> None:
    truth = path()
    yawed = moved(truth, se3_exp(np.array([1.0, 2, 3, 0, 0, 0.7])))
    assert ate(yawed, truth, "yaw").rmse < 1e-9
    assert ate(yawed, truth, "first").errors[0] < 1e-9
    assert ate(yawed, truth, "none").rmse > 1.0
    tilted = moved(truth, se3_exp(np.array([0, 0, 0, 0.3, 0, 0.0])))
    assert ate(tilted, truth, "yaw").rmse > 0.01
    shifted = moved(truth, se3_exp(np.array([0.0, 0.03, 0.04, 0, 0, 0])))
    none = ate(shifted, truth, "none")
    assert none.rmse == pytest.approx(0.05, abs=1e-12)
    assert (none.mean, none.median, none.max) == pytest.approx((0.05,) * 3)


def test_ate_of_known_errors() -> None:
    """Alternate ±e across the path: alignment cannot remove them."""
    n = 400
    Ts = np.tile(np.eye(4), (n, 1, 1))
    Ts[:, 0, 3] = np.arange(n)
    stamps = np.arange(n, dtype=np.int64) * 100_000_000
    truth = Trajectory(stamps, Ts)
    Ts = Ts.copy()
    Ts[:, 2, 3] = 0.1 * np.where(np.arange(n) % 2, 1, -1)
    Ts[:, 1, 3] = 0.1 * np.where(np.arange(n) // 2 % 2, 1, -1)
    result = ate(Trajectory(stamps, Ts), truth)
    assert result.rmse == pytest.approx(0.1 * np.sqrt(2), rel=1e-3)
    assert result.path_m == pytest.approx(n - 1)
    assert result.percent == pytest.approx(100 * result.rmse / (n - 1))
    assert result.coverage == 1.0


def test_coverage_counts_time_not_poses() -> None:
    truth = path(n=101)
    half = Trajectory(truth.stamps_ns[25:76], truth.Ts_world_body[25:76])
    assert coverage(half, truth) == pytest.approx(0.5)
    sparse = Trajectory(truth.stamps_ns[::20], truth.Ts_world_body[::20])
    assert coverage(sparse, truth) == 1.0
    assert ate(half, truth).as_dict()["coverage"] == 0.5


def test_rpe_sees_a_known_drift_per_second() -> None:
    truth = path(n=201, step_m=0.1, dt_s=0.05)
    stretched = Trajectory(truth.stamps_ns, truth.Ts_world_body.copy())
    drift = np.tile(np.eye(4), (201, 1, 1))
    straight = drift.copy()
    straight[:, 0, 3] = 0.1 * np.arange(201)
    drift[:, 0, 3] = 0.101 * np.arange(201)
    reference = Trajectory(stretched.stamps_ns, straight)
    estimate = Trajectory(stretched.stamps_ns, drift)
    assert rpe(estimate, reference, 1.0, "s").trans_rmse == pytest.approx(0.02, abs=1e-9)
    assert rpe(estimate, reference, 10, "f").trans_median == pytest.approx(0.01, abs=1e-9)
    assert rpe(estimate, reference, 1.0, "m").trans_rmse == pytest.approx(0.01, rel=0.11)
    assert rpe(estimate, reference, 1.0, "s").pairs == 201 - 20


def test_rpe_rotation_of_a_known_turn() -> None:
    n = 50
    stamps = np.arange(n, dtype=np.int64) * 1_000_000_000
    truth = Trajectory(stamps, np.tile(np.eye(4), (n, 1, 1)))
    turns = np.zeros((n, 6))
    turns[:, 5] = np.radians(0.5) * np.arange(n)
    result = rpe(Trajectory(stamps, se3_exp(turns)), truth, 2.0, "s")
    assert result.rot_rmse_deg == pytest.approx(1.0, abs=1e-9)
    assert result.rot_median_deg == pytest.approx(1.0, abs=1e-9)


def test_kitti_segments_of_a_known_scale_error() -> None:
    n = 1201
    Ts = np.tile(np.eye(4), (n, 1, 1))
    Ts[:, 0, 3] = np.arange(n)
    stamps = np.arange(n, dtype=np.int64) * 100_000_000
    longer = Ts.copy()
    longer[:, 0, 3] *= 1.01
    result = kitti_segments(Trajectory(stamps, longer), Trajectory(stamps, Ts))
    assert result.trans_pct == pytest.approx(1.0, abs=1e-9)
    assert result.rot_deg_per_m == pytest.approx(0.0, abs=1e-9)
    counts = {length: int((result.lengths_m == length).sum()) for length in (100, 800)}
    assert counts == {100: 111, 800: 41}
    assert result.segments == sum((1201 - 1 - length) // 10 + 1 for length in range(100, 900, 100))


def test_too_short_for_kitti() -> None:
    with pytest.raises(InputError, match="20 m is too short for KITTI"):
        kitti_segments(path(n=201), path(n=201))


def test_different_clocks_are_named() -> None:
    truth = path()
    other = Trajectory(truth.stamps_ns - 1_403_636_579_000_000_000, truth.Ts_world_body)
    with pytest.raises(InputError, match=r"no overlap in time: estimate spans 0\.76.*clocks\?"):
        ate(other, truth)


def test_two_matches_are_too_few() -> None:
    truth = path()
    short = Trajectory(truth.stamps_ns[:2], truth.Ts_world_body[:2])
    with pytest.raises(InputError, match="only 2 poses match"):
        ate(short, truth)
    assert coverage(short, truth) == pytest.approx(1 / 199)


def test_empty_and_delta_and_names_are_errors() -> None:
    truth = path()
    with pytest.raises(InputError, match="delta"):
        rpe(truth, truth, delta=0.0)
    with pytest.raises(InputError, match="no two poses are 100 s apart"):
        rpe(truth, truth, delta=100.0)
    with pytest.raises(InputError, match="alignment 'se4'"):
        ate(truth, truth, "se4")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="unit 'km'"):
        rpe(truth, truth, unit="km")  # type: ignore[arg-type]


def test_a_path_that_stands_still_has_no_percentage() -> None:
    n = 10
    still = Trajectory(np.arange(n, dtype=np.int64) * 10**8, np.tile(np.eye(4), (n, 1, 1)))
    result = ate(still, still, "none")
    assert result.rmse == 0.0
    assert np.isnan(result.percent)
