import threading
from dataclasses import replace

import numpy as np
import pytest

from bundleworlds import LENSES, world
from odomap.backend.adjustment.adjust import Adjustment, AdjustmentConfig, adjust
from odomap.backend.adjustment.descent import Descent, state_of
from odomap.backend.adjustment.layout import lay_out
from odomap.backend.adjustment.reduced import Factored
from odomap.errors import ConfigError, InputError
from odomap.geometry.lie import se3_exp, se3_inverse, so3_log
from odomap.geometry.robust import LOSSES, Loss
from odomap.simulation.bundle import bundle_world

HOLD = AdjustmentConfig(gauge="hold")
EXACT = AdjustmentConfig(tolerance=1e-14)


def errors(solution, Ts, anchor=(0, 1)):
    """Return how far places (in baselines) and turns (rad) are off, in the axes of a view."""

    def relative(stack):
        out = stack @ se3_inverse(stack[anchor[0]])
        size = np.linalg.norm(out[anchor[1], :3, 3])
        return out[:, :3, :3], out[:, :3, 3] / size

    (R, t), (R_true, t_true) = relative(solution.Ts_camera_world), relative(Ts)
    turns = np.linalg.norm(so3_log(np.swapaxes(R, 1, 2) @ R_true), axis=1)
    return np.linalg.norm(t - t_true, axis=1).max(), turns.max()


@pytest.mark.parametrize("name", LENSES)
def test_without_noise_the_truth_is_found(name):
    problem, Ts, _, _ = world(name, sigma_px=0.0)
    solution = adjust(problem, EXACT)
    assert solution.cost_after < 1e-9 * solution.cost_before
    place, turn = errors(solution, Ts)
    assert place < 1e-6
    assert turn < 1e-7
    assert solution.converged


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("name", LENSES)
def test_a_free_lens_is_found(name, own):
    problem, _, _, theta = world(name, sigma_px=0.0, points=80, own=own, is_free_intrinsic=True)
    problem = replace(problem, intrinsics=problem.intrinsics * 1.01)
    solution = adjust(problem, AdjustmentConfig(tolerance=1e-14, iterations=200))
    assert solution.cost_after < 1e-10 * solution.cost_before
    # The numbers of these can stand in for each other, and so can those of views apart.
    if not own and name not in ("rational", "double_sphere"):
        np.testing.assert_allclose(solution.intrinsics[0], theta, rtol=2e-3, atol=2e-3)


def test_numbers_of_a_lens_can_be_held_one_by_one():
    problem, *_ = world("radtan", is_free_intrinsic=[[1, 1, 0, 0, 1, 1, 0, 0]])
    found = adjust(problem).intrinsics[0]
    held = np.array([2, 3, 6, 7])
    assert (found[held] == problem.intrinsics[0, held]).all()
    assert (np.delete(found, held) != np.delete(problem.intrinsics[0], held)).all()


def test_noise_leaves_its_own_cost():
    problem, *_ = world(views=10, points=200)
    solution = adjust(problem)
    surplus = 2 * problem.num_observations - 60 + 7 - 600
    assert solution.cost_after == pytest.approx(0.5 * surplus, rel=4 / np.sqrt(surplus))
    assert solution.variance_factor == pytest.approx(2 * solution.cost_after / surplus)
    assert 0.5 * solution.chi2.sum() == pytest.approx(solution.cost_after, rel=1e-12)


def test_motion_only_and_structure_only():
    problem, Ts, X, _ = world(off=0.05, sigma_px=0.0)
    motion = adjust(replace(problem, points_world=X, is_fixed_point=True), EXACT)
    np.testing.assert_allclose(motion.Ts_camera_world, Ts, atol=1e-7)
    np.testing.assert_array_equal(motion.points_world, X)
    structure = adjust(replace(problem, Ts_camera_world=Ts, is_fixed_view=True), EXACT)
    np.testing.assert_allclose(structure.points_world, X, atol=1e-7)
    np.testing.assert_array_equal(structure.Ts_camera_world, Ts)
    assert (motion.method, structure.method) == ("factored", "points")


def test_a_window_hangs_from_what_is_fixed():
    problem, Ts, X, _ = world(views=8, sigma_px=0.0)
    fixed = np.arange(8) < 2
    start = np.where(fixed[:, None, None], Ts, problem.Ts_camera_world)
    solution = adjust(replace(problem, Ts_camera_world=start, is_fixed_view=fixed), EXACT)
    np.testing.assert_array_equal(solution.Ts_camera_world[:2], Ts[:2])
    np.testing.assert_allclose(solution.Ts_camera_world, Ts, atol=1e-6)
    np.testing.assert_allclose(solution.points_world, X, atol=1e-6)


@pytest.mark.parametrize("name", ["pinhole", "bal"])
@pytest.mark.parametrize("own", [False, True])
def test_conjugate_gradients_end_where_factors_end(name, own):
    problem, *_ = world(name, own=own, is_free_intrinsic=True, points=80)
    tight = {"tolerance": 1e-12, "inner_tolerance": 1e-6, "iterations": 300}
    costs = [
        adjust(problem, AdjustmentConfig(method, **tight)).cost_after
        for method in ("factored", "iterative")
    ]
    assert costs[1] == pytest.approx(costs[0], rel=1e-6)


def test_the_gauge_comes_back_and_costs_nothing():
    problem, *_ = world(off=0.05)
    free, held = adjust(problem), adjust(problem, HOLD)
    assert held.cost_after == free.cost_after
    np.testing.assert_array_equal(held.Ts_camera_world[0], problem.Ts_camera_world[0])
    again = adjust(held.problem, AdjustmentConfig(iterations=0))
    assert again.cost_before == pytest.approx(held.cost_after, rel=1e-9)
    centres = [se3_inverse(T)[:, :3, 3] for T in (held.Ts_camera_world, problem.Ts_camera_world)]
    far = np.argmax(np.linalg.norm(centres[1] - centres[1][0], axis=1))
    lengths = [np.linalg.norm(c[far] - c[0]) for c in centres]
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-12)


def test_the_frame_of_the_world_does_not_matter():
    problem, *_ = world()
    T = se3_exp(np.array([30.0, -20, 10, 0.4, 1.0, -0.3]))
    moved = replace(
        problem,
        Ts_camera_world=problem.Ts_camera_world @ se3_inverse(T),
        points_world=problem.points_world @ T[:3, :3].T + T[:3, 3],
    )
    a, b = adjust(problem, EXACT), adjust(moved, EXACT)
    assert a.cost_after == pytest.approx(b.cost_after, rel=1e-9)


def with_outliers(share=0.05, seed=1):
    problem, Ts, _, _ = world(views=8, points=120)
    rng = np.random.default_rng(seed)
    bad = rng.uniform(size=problem.num_observations) < share
    pixels = problem.pixels + bad[:, None] * rng.uniform(40, 120, problem.pixels.shape)
    return replace(problem, pixels=pixels), Ts, bad


@pytest.mark.parametrize("name", [n for n in LOSSES if n not in ("quadratic", "truncated")])
def test_robust_losses_see_past_outliers(name):
    problem, Ts, _ = with_outliers()
    plain, robust = adjust(problem), adjust(problem, loss=Loss(name))
    assert errors(robust, Ts)[1] < 0.3 * errors(plain, Ts)[1]
    assert robust.cost_after < robust.cost_before


@pytest.mark.parametrize("name", ["quadratic", "huber", "cauchy"])
def test_the_end_is_where_the_robust_cost_is_level(name):
    problem, *_ = with_outliers()
    loss = Loss(name)
    found = adjust(problem, AdjustmentConfig(tolerance=1e-13, iterations=300), loss=loss).problem

    def level(at):
        layout = lay_out(at)
        descent = Descent(state_of(at, layout), layout, loss, Factored(layout, at.lens))
        return np.abs(descent.linearise(0.0).a).max()

    assert level(found) < 1e-4 * level(problem)


def test_outliers_are_named_and_left_out():
    problem, Ts, bad = with_outliers()
    solution = adjust(problem, AdjustmentConfig(gate=4.0), loss=Loss("huber"))
    np.testing.assert_array_equal(solution.is_outlier[bad], True)
    assert np.count_nonzero(solution.is_outlier & ~bad) < 0.01 * len(bad)
    assert (solution.chi2[bad] > 16).all()
    clean = adjust(replace(problem, weights=np.where(bad, 0.0, problem.weights)))
    assert errors(solution, Ts)[1] < 1.2 * errors(clean, Ts)[1]


def test_the_same_input_gives_the_same_bytes():
    problem, *_ = world("kannala_brandt", is_free_intrinsic=True)
    a, b = adjust(problem), adjust(problem)
    assert a.Ts_camera_world.tobytes() == b.Ts_camera_world.tobytes()
    assert a.points_world.tobytes() == b.points_world.tobytes()


def test_a_stop_ends_it_with_what_there_is():
    problem, *_ = world(off=0.05)
    flag = threading.Event()
    records = []

    def note(record):
        records.append(record)
        if record.iteration == 1:
            flag.set()

    solution = adjust(problem, EXACT, stop=flag, progress=note)
    assert solution.reason == "stopped on request"
    assert not solution.converged
    assert solution.iterations == 1
    assert solution.cost_after < solution.cost_before
    assert [r.iteration for r in records] == [0, 1]
    assert solution.history == tuple(records)


def test_what_is_not_seen_stays_and_is_named():
    problem, *_ = world()
    lonely = replace(
        problem,
        Ts_camera_world=np.concatenate([problem.Ts_camera_world, np.eye(4)[None]]),
        points_world=np.concatenate([problem.points_world, [[7.0, 8.0, 9.0]]]),
        lens=np.zeros(7, np.int64),
        is_fixed_view=False,
        is_fixed_point=False,
    )
    solution = adjust(lonely)
    assert solution.blind_views.tolist() == [6]
    assert solution.unseen_points.tolist() == [50]
    np.testing.assert_array_equal(solution.Ts_camera_world[6], np.eye(4))
    np.testing.assert_array_equal(solution.points_world[50], [7, 8, 9])
    assert solution.cost_after == adjust(problem).cost_after


def test_points_seen_once_or_from_behind_do_no_harm():
    problem, _, _, _ = world()
    once = (problem.point != 0) | (problem.view == 0)
    kept = replace(
        problem,
        **{name: getattr(problem, name)[once] for name in ("view", "point", "pixels", "weights")},
    )
    points = kept.points_world.copy()
    points[5] = [0.0, 0.0, -40.0]  # behind the first views
    solution = adjust(replace(kept, points_world=points))
    assert np.isfinite(solution.points_world).all()
    assert np.isfinite(solution.cost_after)
    assert solution.converged
    rest = kept.point != 5
    assert solution.chi2[rest].mean() < 2.0
    assert solution.chi2[kept.point == 0] == pytest.approx(0.0, abs=1e-6)


def test_two_parts_are_told():
    problem, *_ = world()
    views, points = problem.num_views, problem.num_points
    two = Adjustment(
        np.concatenate([problem.Ts_camera_world] * 2),
        np.concatenate([problem.points_world] * 2),
        np.concatenate([problem.view, problem.view + views]),
        np.concatenate([problem.point, problem.point + points]),
        np.concatenate([problem.pixels] * 2),
        problem.intrinsics,
        weights=np.concatenate([problem.weights] * 2),
    )
    solution = adjust(two, HOLD)
    assert solution.num_parts == 2
    assert solution.cost_after == pytest.approx(2 * adjust(problem).cost_after, rel=1e-6)
    np.testing.assert_array_equal(solution.Ts_camera_world[views], two.Ts_camera_world[views])


def test_a_hopeless_start_is_told_and_nothing_is_lost():
    problem, *_ = world()
    rng = np.random.default_rng(5)
    wild = replace(problem, points_world=1e3 * rng.normal(size=problem.points_world.shape))
    solution = adjust(wild, AdjustmentConfig(iterations=30))
    assert np.isfinite(solution.Ts_camera_world).all()
    assert np.isfinite(solution.points_world).all()
    assert solution.reason
    far = replace(problem, pixels=problem.pixels * 1e200)
    solution = adjust(far)
    assert solution.reason == "the cost is not finite at the start"
    np.testing.assert_array_equal(solution.points_world, problem.points_world)


def test_without_a_step_nothing_changes():
    problem, *_ = world()
    solution = adjust(problem, AdjustmentConfig(iterations=0))
    np.testing.assert_array_equal(solution.points_world, problem.points_world)
    np.testing.assert_array_equal(solution.Ts_camera_world, problem.Ts_camera_world)
    assert solution.reason == "0 iterations were spent"


def test_what_cannot_be_solved_is_refused():
    problem, *_ = world()
    with pytest.raises(InputError, match="every view, point and lens that is seen is held"):
        adjust(replace(problem, is_fixed_view=True, is_fixed_point=True))
    few = replace(
        problem,
        **{name: getattr(problem, name)[:20] for name in ("view", "point", "pixels", "weights")},
    )
    with pytest.raises(InputError, match="40 numbers were seen, 66 are unknown"):
        adjust(few)
    with pytest.raises(InputError, match="row 0 has numbers that no pinhole lens has"):
        adjust(replace(problem, intrinsics=-problem.intrinsics))
    with pytest.raises(ConfigError, match="gauge: 'fixed' is unknown"):
        AdjustmentConfig(gauge="fixed")
    with pytest.raises(ConfigError, match="method: 'dense' is unknown"):
        AdjustmentConfig("dense")
    with pytest.raises(ConfigError, match="damping"):
        AdjustmentConfig(damping=0.0)


def test_a_problem_checks_what_it_is_given():
    problem, *_ = world()
    good = {name: getattr(problem, name) for name in ("view", "point", "pixels")}

    def refused(match, **changes):
        with pytest.raises(InputError, match=match):
            replace(problem, **changes)

    empty = {"view": [], "point": [], "pixels": [], "weights": 1.0}
    refused("0 observations: nothing to do", **empty)
    refused("view: row 0 is 6, of 6 there are", view=good["view"] * 0 + 6)
    refused("point: row 3 is -1", point=np.where(np.arange(len(good["point"])) == 3, -1, 0))
    refused("view: has shape .* of float64", view=good["view"] * 1.0)
    pixels = good["pixels"].copy()
    pixels[7] = np.nan
    refused("pixels: row 7 holds a value that is not finite", pixels=pixels)
    refused(r"Ts_camera_world\[2\] is not a rotation", Ts_camera_world=stretched(problem, 2))
    refused("weights: a standard deviation is not negative", weights=-1.0)
    refused(r"weights: has shape \(2,\)", weights=[1.0, 2.0])
    refused("did you mean 'pinhole'", model="pinhol")
    refused("2 names for 1 lenses", model=("pinhole", "pinhole"))
    refused("say which of 2", intrinsics=np.ones((2, 4)), lens=None, is_free_intrinsic=False)


def stretched(problem, k):
    Ts = problem.Ts_camera_world.copy()
    Ts[k, :3, :3] *= 1.1
    return Ts


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("iterations", 2.5),
        ("rounds", "3"),
        ("inner_iterations", None),
        ("gate", "wide"),
        ("tolerance", None),
    ],
)
def test_a_setting_of_another_kind_is_refused(name, value):
    with pytest.raises(ConfigError, match=rf"{name}: {value!r} must be a (whole )?number"):
        AdjustmentConfig(**{name: value})


def test_a_loss_by_its_name_is_refused():
    problem, *_ = world()
    with pytest.raises(InputError, match=r"loss: 'huber' is none: give one such as Loss"):
        adjust(problem, loss="huber")


def test_the_last_row_of_a_transform_is_checked():
    problem, *_ = world()
    Ts = problem.Ts_camera_world.copy()
    Ts[3, 3] = 7.0
    with pytest.raises(InputError, match=r"Ts_camera_world\[3\]: its last row is not 0 0 0 1"):
        replace(problem, Ts_camera_world=Ts)


def mirrored(problem, share):
    """Return a problem with the first part of its points behind the views that first saw them."""
    centres = se3_inverse(problem.Ts_camera_world)[:, :3, 3]
    first = np.zeros(problem.num_points, np.int64)
    first[problem.point[::-1]] = problem.view[::-1]
    count = int(share * problem.num_points)
    points = problem.points_world.copy()
    points[:count] = 2.0 * centres[first[:count]] - points[:count]
    return replace(problem, points_world=points)


@pytest.mark.parametrize("gate", [0.0, 5.0])
def test_nothing_in_sight_is_no_success(gate):
    problem = bundle_world(60, 400).problem
    for blind in (replace(problem, points_world=problem.points_world * 0), mirrored(problem, 1)):
        solution = adjust(blind, AdjustmentConfig(gate=gate))
        assert (solution.converged, solution.reason) == (False, "nothing is in sight")
        assert np.isinf(solution.chi2).all()
        assert solution.variance_factor == 1.0
        np.testing.assert_array_equal(solution.points_world, blind.points_world)
    # what has no weight is nothing, either
    weights = np.where(problem.point < 200, 0.0, problem.weights)
    half = replace(mirrored(replace(problem, weights=weights), 1), weights=weights)
    assert adjust(half).reason == "nothing is in sight"


def test_what_is_out_of_sight_does_not_make_the_rest_look_better():
    problem = bundle_world(60, 400).problem
    whole, half = adjust(problem), adjust(mirrored(problem, 0.5))
    assert 0.4 < np.isinf(half.chi2).mean() < 0.6
    assert whole.variance_factor == pytest.approx(1.0, abs=0.06)
    assert half.variance_factor == pytest.approx(1.0, abs=0.1)
    weights = np.where(problem.point < 200, 0.0, problem.weights)
    light = adjust(replace(problem, weights=weights))
    assert light.variance_factor == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("turns", ["together", "apart"])
@pytest.mark.parametrize("share", [0.02, 0.14, 0.3])
def test_gross_errors_are_found_by_a_gate(share, turns):
    truth = bundle_world(60, 400)
    rng = np.random.default_rng(9)
    bad = rng.uniform(size=truth.problem.num_observations) < share
    angle = np.where(turns == "apart", rng.uniform(0, 2 * np.pi, len(bad)), 0.25 * np.pi)
    moved = bad[:, None] * 200.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pixels = truth.problem.pixels + moved
    solution = adjust(replace(truth.problem, pixels=pixels), AdjustmentConfig(gate=5))
    hits = np.count_nonzero(solution.is_outlier & bad)
    assert solution.converged
    assert hits > 0.95 * np.count_nonzero(bad)
    assert hits > 0.95 * np.count_nonzero(solution.is_outlier)
    assert solution.variance_factor == pytest.approx(1.0, abs=0.1)
    assert solution.history[0].cost == pytest.approx(solution.cost_before)
    assert [r.iteration for r in solution.history] == list(range(solution.iterations + 1))


@pytest.mark.parametrize("gate", [0.001, 1e-9])
def test_a_gate_that_leaves_too_few_keeps_what_there_is(gate):
    problem, *_ = world(points=60)
    solution = adjust(problem, AdjustmentConfig(gate=gate))
    assert not solution.converged
    assert "within the gate" in solution.reason
    assert np.isfinite(solution.points_world).all()
    assert solution.cost_after < 0.5 * solution.cost_before


def test_a_stop_ends_a_gated_adjustment_too():
    problem, *_ = with_outliers()
    flag = threading.Event()

    def note(record):
        if record.iteration == 1:
            flag.set()

    solution = adjust(problem, AdjustmentConfig(gate=4.0), stop=flag, progress=note)
    assert solution.reason == "stopped on request"
    assert not solution.converged
    assert solution.iterations == 1
    assert np.isfinite(solution.points_world).all()


def test_measured_depths_say_how_large_the_world_is():
    problem, Ts, X, _ = world("pinhole", views=6, points=80, sigma_px=0.3, seed=3)
    depths = np.einsum("nj,nj->n", Ts[problem.view, 2, :3], X[problem.point])
    depths += Ts[problem.view, 2, 3]
    rng = np.random.default_rng(3)
    measured = 1.0 / depths + rng.normal(0.0, 1e-3, len(depths))
    measured[rng.random(len(depths)) < 0.3] = np.nan
    grown = Ts.copy()
    grown[:, :3, 3] *= 1.1
    fixed = np.arange(6) == 0
    grown[0] = Ts[0]
    start = replace(
        problem,
        Ts_camera_world=grown,
        is_fixed_view=fixed,
        inverse_depths=measured,
        depth_weights=1e3,
    )
    hold = AdjustmentConfig(gauge="hold")
    found = adjust(start, hold)
    assert found.converged
    assert 0.8 < found.variance_factor < 1.2
    assert np.abs(found.Ts_camera_world - Ts).max() < 0.02
    nothing = replace(start, inverse_depths=None, depth_weights=None)
    unknown = adjust(nothing, hold)
    assert np.abs(unknown.Ts_camera_world - Ts).max() > 0.1  # without depth the size stays


def test_depths_that_cannot_be_are_refused():
    problem, *_ = world("pinhole")
    with pytest.raises(InputError, match="inverse_depths: one is infinite"):
        replace(problem, inverse_depths=np.inf)
    with pytest.raises(InputError, match="depth_weights: a standard deviation"):
        replace(problem, inverse_depths=0.1, depth_weights=-1.0)
    with pytest.raises(InputError, match="inverse_depths: has shape"):
        replace(problem, inverse_depths=np.zeros(3))
