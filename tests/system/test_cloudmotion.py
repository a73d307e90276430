"""How unsure steps, and all of them together, are along what surfaces say nothing of."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.frontend import SweepMatch
from odomap.system.cloudconfig import CloudTrackingConfig
from odomap.system.cloudmotion import CloudMotion

CONFIG = CloudTrackingConfig()
STEP = 0.1
SURE = np.diag([0.01] * 3 + [0.002] * 3) ** 2


def match_at(T, information):
    return SweepMatch(T, information, 800, 1000, 0.02, True)


def drive(rng, tunnel, steps, motion, fixed=False):
    """Drive with unsteady speed, straight on: known at first, in a tunnel then; errors (N,)."""
    known = np.linalg.inv(SURE)
    blind = known.copy()
    blind[0] = blind[:, 0] = 0.0
    x, v, ns, drifted, off, sigma = 0.0, 7.0, 0, 0.0, [], []
    motion.begin(np.eye(4), ns)
    for n in range(steps):
        v += CONFIG.acceleration * STEP * rng.normal()
        x, ns = x + v * STEP, ns + 10**8
        seconds = motion.seconds_to(ns)
        is_blind = tunnel[0] <= n < tunnel[1]
        T = motion.predicted(seconds)
        if not is_blind:
            T = se3_exp(np.array([x, 0, 0, 0, 0, 0]))
            if not fixed and n >= tunnel[1]:  # on a map that has drifted on the way
                T[0, 3] += drifted
        match = match_at(T, blind if is_blind else known)
        covariance = motion.go(match, motion.twist_to(T, seconds), seconds, ns, False, fixed)
        drifted = T[0, 3] - x
        off.append(drifted)
        sigma.append(np.sqrt(covariance[0, 0]))
    return np.array(off), np.array(sigma)


def test_along_a_tunnel_errors_are_as_large_as_they_are_said_to_be():
    squares = []
    for seed in range(150):
        motion = CloudMotion(CONFIG)
        off, sigma = drive(np.random.default_rng(seed), (5, 60), 60, motion)
        squares.append((off[5:] / sigma[5:]) ** 2)
        assert sigma[4] < 0.1
        assert (np.diff(sigma[5:]) > 0.0).all()
        motion.hang()
    assert 0.5 < np.mean(squares) < 2.0
    assert 0.5 < np.mean(squares, axis=0)[-1] < 2.0


def test_keyframes_add_up_to_what_the_whole_way_is_unsure_by():
    whole, parts = CloudMotion(CONFIG), CloudMotion(CONFIG)
    sums, known = np.zeros((6, 6)), np.linalg.inv(SURE)
    blind = known.copy()
    blind[0] = blind[:, 0] = 0.0
    for motion in (whole, parts):
        motion.begin(np.eye(4), 0)
        for n in range(40):
            ns = 10**8 * (n + 1)
            T = motion.predicted(STEP) if n else se3_exp(np.array([0.7, 0, 0, 0, 0, 0]))
            match = match_at(T, blind if n > 3 else known)
            motion.go(match, motion.twist_to(T, STEP), STEP, ns, False, False)
            if motion is parts and n % 5 == 4:
                sums += parts.since
                parts.hang()
    assert sums[0, 0] == pytest.approx(whole.since[0, 0], rel=0.02)


def test_on_a_map_that_is_as_it_is_an_end_of_the_tunnel_makes_sure_again():
    motion = CloudMotion(CONFIG)
    _, sigma = drive(np.random.default_rng(1), (5, 30), 40, motion, fixed=True)
    assert sigma[29] > 1.0
    assert sigma[39] < 0.1
    motion = CloudMotion(CONFIG)
    _, sigma = drive(np.random.default_rng(1), (5, 30), 40, motion)
    assert sigma[39] > 1.0


def test_clocks_that_jump_back_do_not_stop_or_hurry_it():
    motion, T = CloudMotion(CONFIG), np.eye(4)
    motion.begin(T, 10**9)
    step, known = se3_exp(np.array([0.8, 0, 0, 0, 0, 0.02])), np.linalg.inv(SURE)
    stamps = [1.1, 1.2, 0.75, 1.4, 1.5, 0.2, 0.3, 0.4, 0.5]
    for n, stamp in enumerate(stamps):
        seconds = motion.seconds_to(round(stamp * 1e9))
        assert seconds == pytest.approx(STEP)
        off = se3_log(se3_inverse(motion.predicted(seconds)) @ T @ step)
        assert n == 0 or np.abs(off).max() < 1e-9
        T = T @ step
        twist = motion.twist_to(T, seconds)
        motion.go(match_at(T, known), twist, seconds, round(stamp * 1e9), False, False)


def test_much_less_on_the_map_is_another_place_unless_it_lies_where_it_should():
    motion, T = CloudMotion(CONFIG), np.eye(4)
    motion.begin(T, 0)
    step, known = se3_exp(np.array([0.8, 0, 0, 0, 0, 0.02])), np.linalg.inv(SURE)
    for n in range(1, 12):
        T = T @ step
        match = match_at(T, known)
        assert motion.doubt(match, STEP) == ""
        motion.go(match, motion.twist_to(T, STEP), STEP, 10**8 * n, False, False)
    there = SweepMatch(T @ step, known, 300, 1000, 0.02, True)
    assert motion.doubt(there, STEP) == ""
    aside = T @ step @ se3_exp(np.array([0.2, 0, 0, 0, 0, 0]))
    off = SweepMatch(aside, known, 300, 1000, 0.02, True)
    assert "30% of 1000 points lie on what is known, 80% did before" in motion.doubt(off, STEP)
    restless = SweepMatch(T @ step, known, 300, 1000, 0.02, False)
    assert "carried off?" in motion.doubt(restless, STEP)
    assert not motion.is_anywhere(0.9)
    assert motion.is_anywhere(1.1)


@pytest.mark.parametrize("stays", [0.03, 0.1, 0.3])
def test_errors_of_sweeps_add_up_by_what_stays_of_them_in_the_map(stays):
    """m ← m + s w, x = m + (1 - s) w: the map's error, and a sweep's by itself."""
    config = replace(CONFIG, unsteady=1e-3, unsteady_rad=1e-4)
    squares, sigma, known = [], np.sqrt(np.diag(SURE)), np.linalg.inv(SURE)
    for seed in range(60):
        rng, motion = np.random.default_rng(seed), CloudMotion(config)
        motion.begin(np.eye(4), 0)
        m = sigma * rng.normal(size=6)  # of the first sweep, from which all is counted
        for n in range(1, 40):
            w = sigma * rng.normal(size=6)
            m = m + stays * w  # a body that stands still, and is placed where it is not
            error = m + (1.0 - stays) * w
            match = replace(match_at(se3_exp(error), known), stays=stays * np.eye(6))
            covariance = motion.go(match, np.zeros(6), STEP, 10**8 * n, False, False)
            squares.append(error @ np.linalg.solve(covariance, error) / 6.0)
        # How bodies can move says a little of where they are, which stays, too: 0.04 of an error.
        grown = np.diag(motion.since) / np.diag(SURE)
        assert np.allclose(grown[3:], 1.0 + 39 * stays**2, rtol=0.2)
        assert np.allclose(grown[:3], 1.0 + 39 * (stays + 0.04) ** 2, rtol=0.2)
    assert 0.7 < np.mean(squares) < 1.4
