"""Benchmarks on simulated worlds and made-up problems; nothing is timed here."""

import numpy as np
import pytest

from odomap.backend.bundle import solve_bundle
from odomap.backend.motion import solve_motion
from odomap.geometry.lie import se3_exp
from odomap.simulation.world import World


def test_bars_of_consistency(load):
    consistency = load("consistency")
    good = consistency.Row("room", 0, 100, 3.0, 0.4, 0, 1.2, 0.9, 1.5)

    def missed(**changes):
        return consistency.below_bars([good, consistency.Row(**(vars(good) | changes))])

    assert missed() == []
    assert "0.510 %" in missed(percent=0.51)[0]
    assert "2 frames lost" in missed(lost=2)[0]
    assert "2.10" in missed(nees=3.0)[0]
    assert missed(nees=float("nan"))
    assert missed(percent=float("inf"))


def test_half_a_world_is_not_kept(load, monkeypatch, tmp_path):
    consistency = load("consistency")
    job = consistency.Job("room", 0, 2, ("noise=0",), str(tmp_path), ())

    def interrupted(world, folder):
        folder.mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(consistency, "export_euroc", interrupted)
    with pytest.raises(KeyboardInterrupt):
        consistency.open_world(job)
    assert [path.suffix for path in tmp_path.iterdir()] == [".part"]


def test_growth_is_that_after_warm_up(load):
    memory = load("memory")
    samples = [(n, 100.0 + max(0, 500 - n) * 0.1 + 0.002 * n) for n in range(25, 3001, 25)]
    assert memory.growth(samples, 500) == pytest.approx(2.0)
    assert memory.growth(samples, 10**6) == pytest.approx(2.0)


def test_to_and_fro_is_a_source_of_any_length(load):
    memory = load("memory")
    world = World.make(kind="room", seed=1, frames=3, resolution=(64, 48))
    frames = list(memory.ToAndFro(world, 8))
    order = [0, 1, 2, 1, 0, 1, 2, 1]
    assert len(frames) == 8
    for frame, place in zip(frames, order, strict=True):
        np.testing.assert_array_equal(frame.images[0], world.frame(place).images[0])
    assert (np.diff([frame.stamp_ns for frame in frames]) == 50_000_000).all()


def test_timed_problems_are_those_of_odometry(load):
    windows = load("windows")
    bundle = windows.window_problem()
    assert 1000 < len(bundle.pose) < 10_000
    assert np.bincount(bundle.point).mean() > 3
    solution = solve_bundle(bundle)
    assert solution.cost_after < 0.5 * solution.cost_before
    assert solution.variance_factor == pytest.approx(1.0, abs=0.25)
    T, T_camera_body, baseline, sightings = windows.motion_problem()
    start = T @ se3_exp(np.full(6, 0.01))
    found = solve_motion(start, T_camera_body, baseline, sightings)
    assert found.converged
    np.testing.assert_allclose(found.T_world_body, T, atol=0.01)
