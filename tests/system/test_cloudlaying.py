"""A sweep is laid down where it fits, also where a body does not go on as before."""

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.frontend import SweepMatch
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep
from odomap.system.cloudconfig import CloudTrackingConfig
from odomap.system.cloudlaying import CloudLayer
from odomap.system.cloudmotion import CloudMotion
from odomap.system.cloudview import CloudViewer

CONFIG = CloudTrackingConfig()
STEP = np.array([1.2, 0, 0, 0, 0, 0.01])
SURE = np.diag([1e4] * 3 + [1e6] * 3)


def yard(rng, count=9000):
    """Points on the ground, on walls and on posts of a yard of 40 m."""
    at = rng.uniform(-20, 20, (count, 3))
    at[:, 2] = rng.uniform(-1.8, 4, count)
    kind = rng.integers(0, 4, count)
    at[kind == 0, 2] = -1.8
    at[kind == 1, 0] = 20.0 * np.sign(at[kind == 1, 0])
    at[kind == 2, 1] = 20.0 * np.sign(at[kind == 2, 1])
    posts = rng.uniform(-15, 15, (25, 2))
    side = rng.uniform(-0.4, 0.4, (count, 2))
    side[:, 0] = np.where(rng.random(count) < 0.5, np.sign(side[:, 0]) * 0.4, side[:, 0])
    boxes = posts[rng.integers(0, 25, count)] + side
    at[kind == 3, :2] = boxes[kind == 3]
    return at


class Stubborn:
    """A front-end that finds what it is told: how well, and how far from the guess at most."""

    def __init__(self):
        self.T, self.reach, self.asked = np.eye(4), np.inf, 0

    def prepare(self, sweep):
        return sweep

    def match(self, prepared, T_map_body, twist, again=False):
        self.asked += 1
        off = np.linalg.norm(se3_log(se3_inverse(T_map_body) @ self.T)[:3])
        if off < self.reach:
            return SweepMatch(self.T, SURE, 900, 1000, 0.02, True)
        return SweepMatch(T_map_body, SURE, 600, 1000, 0.03, True)


@pytest.fixture
def yard_drive():
    """A layer that followed ten sweeps, and what makes the next ones."""
    rng, front_end = np.random.default_rng(0), Stubborn()
    world, motion = yard(rng), CloudMotion(CONFIG)
    viewer = CloudViewer(LidarMount("top"), front_end, CONFIG)
    layer, count = CloudLayer(front_end, motion, CONFIG), 0

    def seen(T, places=world, times=None):
        nonlocal count
        count += 1
        at = (places - T[:3, 3]) @ T[:3, :3] + rng.normal(0, 0.01, places.shape)
        return viewer.view(Frame(count, count * 10**8, cloud=Sweep(at, times)))

    T = se3_exp(-8 * STEP)
    front_end.T = T
    motion.begin(T, 0)
    for _ in range(10):
        T = T @ se3_exp(STEP)
        front_end.T, view = T, seen(T)
        laid = layer.lay(view, 0.1)
        assert laid.wrong == ""
        motion.go(laid.match, laid.twist, 0.1, view.frame.stamp_ns, False, False)
        layer.note(view)
    return layer, front_end, T, seen, rng


def off(laid, T):
    return np.abs(se3_log(se3_inverse(T) @ laid.match.T_map_body))


@pytest.mark.parametrize(("times", "rounds"), [(None, 1), (np.zeros(9000), CONFIG.rounds)])
def test_as_usual_nothing_else_is_asked(yard_drive, times, rounds):
    """Where no times say how the motion bends a sweep, not even a second round."""
    layer, front_end, T, seen, _ = yard_drive
    front_end.T, front_end.asked = T @ se3_exp(STEP), 0
    laid = layer.lay(seen(front_end.T, times=times), 0.1)
    assert front_end.asked == rounds
    assert off(laid, front_end.T).max() < 1e-9


@pytest.mark.parametrize("factor", [0.0, -1.0, -2.0])
def test_one_that_stands_or_turns_round_is_found_by_the_sweep_before(yard_drive, factor):
    layer, front_end, T, seen, _ = yard_drive
    front_end.T, front_end.reach = T @ se3_exp(factor * STEP), 0.2
    laid = layer.lay(seen(front_end.T), 0.1)
    assert laid.wrong == ""
    assert off(laid, front_end.T).max() < 1e-9
    assert np.abs(laid.twist - factor * 10 * STEP).max() < 1e-6


def test_if_the_map_lets_it_slip_the_sweep_before_is_believed(yard_drive):
    layer, front_end, T, seen, _ = yard_drive
    true = T @ se3_exp(-STEP)
    front_end.T = T @ se3_exp(1.8 * STEP)  # wherever it is asked from
    laid = layer.lay(seen(true), 0.1)
    assert laid.wrong == ""
    assert 1e-9 < off(laid, true)[:3].max() < 0.05


def test_what_fits_as_well_there_is_left_there(yard_drive):
    """The map says that it went farther than usual, and so says the sweep before."""
    layer, front_end, T, seen, _ = yard_drive
    front_end.T = T @ se3_exp(1.5 * STEP)
    laid = layer.lay(seen(front_end.T), 0.1)
    assert laid.wrong == ""
    assert off(laid, front_end.T).max() < 1e-9


def test_a_place_like_none_before_is_told_to_be(yard_drive):
    layer, front_end, T, seen, rng = yard_drive
    front_end.T, front_end.reach = T, 0.0
    elsewhere = yard(rng) * [0.6, 0.4, 1.0] + [3.0, 5.0, 0.4]
    laid = layer.lay(seen(T, elsewhere), 0.1)
    assert "points lie on the sweep before" in laid.wrong
    assert "carried off?" in laid.wrong
