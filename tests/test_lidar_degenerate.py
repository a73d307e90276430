"""Where surfaces say little, a 3D LiDAR goes on as it did, and says how unsure it is."""

import re
from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.lie import se3_inverse, se3_log
from odomap.lidar.deskew import deskew
from odomap.maps.estimate import Status
from odomap.sources.wrappers import Changed
from sweepruns import Kept, judge, sigmas, tracked

SOLID = "16&pattern=solid_state"


@pytest.mark.parametrize(
    ("front_end", "seed", "beams", "speed"),
    [
        ("points", 0, 16, 7.5), ("points", 1, 32, 15), ("points", 4, 16, 3), ("loam", 6, 16, 7.5),
        ("lego", 7, 16, 10), ("lego", 8, SOLID, 7.5), ("loam", 9, 64, 5),
    ],
)  # fmt: skip
def test_along_a_tunnel_nothing_is_known_if_it_was_not_known_before(front_end, seed, beams, speed):
    source = Kept("tunnel", beams, 50, seed, more=f"&speed={speed}")
    estimates, _ = tracked(source, source.rig, front_end)
    off = judge(estimates, source.truth.Ts_world_body)
    assert all(e.status is Status.TRACKING for e in estimates)
    told = ["do not fix translation along (1.00, " in e.reason for e in estimates[1:]]
    assert np.mean(told) > 0.9
    sigma = sigmas(estimates)
    assert (sigma[5:, 0] > 20.0 * sigma[5:, 1]).all()
    assert (off[5:, 0] ** 2 / sigma[5:, 0] ** 2).mean() < 4.0
    assert np.abs(off[:, 3:]).max() < 0.03


@pytest.mark.parametrize(("seed", "front_end"), [(5, "loam"), (6, "lego")])
def test_few_points_of_a_solid_state_lidar_fix_a_street(seed, front_end):
    source = Kept("street", SOLID, 40, seed)
    estimates, _ = tracked(source, source.rig, front_end)
    off = judge(estimates, source.truth.Ts_world_body)
    assert all(e.status is Status.TRACKING and not e.reason for e in estimates[4:])
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.15


def with_pillars(source, last):
    """Show pillars on both sides until a frame: as one enters a tunnel."""
    rng = np.random.default_rng(5)
    Ts = source.truth.Ts_world_body
    at = np.repeat([-7.0, -4.0, 0.0, 3.0, 8.0, 14.0, 23.0, 33.0], 250)
    beside = rng.uniform(2.5, 4.5, len(at)) * rng.choice([-1.0, 1.0], len(at))
    wall = np.column_stack([at, beside, rng.uniform(-1.5, 2.5, len(at))])
    wall = wall @ Ts[0, :3, :3].T + Ts[0, :3, 3]

    def change(frame):
        if frame.id > last:
            return frame
        T, sweep = Ts[frame.id], frame.cloud
        twist = 10.0 * se3_log(se3_inverse(T) @ Ts[frame.id + 1])
        times = rng.uniform(0.0, 0.1, len(wall))
        seen = deskew((wall - T[:3, 3]) @ T[:3, :3], times, -twist)
        columns = {
            "points": seen + rng.normal(0, 0.01, seen.shape), "times": times,
            "intensities": np.ones(len(wall), np.float32), "beams": np.zeros(len(wall), np.int16),
        }  # fmt: skip
        joined = {n: np.concatenate([getattr(sweep, n), c]) for n, c in columns.items()}
        return replace(frame, cloud=replace(sweep, **joined))

    return Changed(source, "pillars", change)


@pytest.mark.parametrize(
    ("front_end", "seed", "speed"),
    [("points", 0, 2), ("points", 1, 4), ("loam", 2, 4), ("lego", 1, 4)],
)
def test_in_a_tunnel_it_goes_on_as_it_came_in_and_the_covariance_grows(front_end, seed, speed):
    source = Kept("tunnel", 16, 80, seed, more=f"&speed={speed}")
    entered = with_pillars(source, 20)
    estimates, system = tracked(entered, source.rig, front_end)
    result = system.finish()
    off, sigma = judge(estimates, source.truth.Ts_world_body), sigmas(estimates)
    assert all(e.status is Status.TRACKING for e in estimates)
    assert all(e.reason == "" for e in estimates[2:18])
    assert all("do not fix translation" in e.reason for e in estimates[25:])
    assert sigma[18, 0] < 0.2
    assert sigma[60, 0] > 20.0 * sigma[18, 0]
    way = np.linalg.norm(
        source.truth.Ts_world_body[79, :3, 3] - source.truth.Ts_world_body[20, :3, 3]
    )
    assert abs(off[79, 0]) < 0.2 * way
    assert not [loop for loop in result.loops if loop.is_accepted]  # any place is as good


@pytest.mark.parametrize(
    ("front_end", "beams", "seed"),
    [("points", 64, 1), ("points", 16, 5), ("points", 32, 6), ("loam", 32, 5), ("lego", 16, 6)],
)
def test_in_a_field_three_ways_to_move_are_not_known(front_end, beams, seed):
    source = Kept("field", beams, 24, seed)
    estimates, _ = tracked(source, source.rig, front_end)
    judge(estimates, source.truth.Ts_world_body)
    assert all(e.status is Status.TRACKING for e in estimates)
    said = estimates[20].reason
    assert said.count("translation along") == 2
    assert re.search(r"rotation about \(-?0.0\d, -?0.0\d, 1.00\)", said)
    sigma = sigmas(estimates)[20]
    assert sigma[[0, 1]].min() > 5.0
    assert sigma[5] > 0.5
    assert sigma[2] < 0.5
    assert sigma[[3, 4]].max() < 0.1


def test_rings_too_far_apart_to_see_a_field_claim_nothing():
    source = Kept("field", 4, 30, 1)
    estimates, _ = tracked(source, source.rig, "points")
    judge(estimates, source.truth.Ts_world_body)
    lost = [e for e in estimates[1:] if e.status is Status.LOST]
    assert len(lost) > 20
    assert all("lie on what is known" in e.reason or "anywhere" in e.reason for e in lost)
