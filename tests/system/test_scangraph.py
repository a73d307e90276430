"""Which loops are believed: the graph of keyframes that two submaps each have."""

import numpy as np
import pytest

from odomap.geometry.planar import (
    compose_planar,
    from_plane,
    lift_covariance,
    lift_information,
)
from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.scanconfig import ScanClosingConfig
from odomap.system.scangraph import read_graph
from odomap.system.submaps import SUBMAP

SUBMAP_SCANS, STEP, SIGMA = 10, 0.25, np.array([0.004, 0.004, 0.001])
LOOP_SIGMA = np.array([0.003, 0.003, 0.001])


def driven(seed, count=60):
    """Return a map of a straight way, two submaps to each keyframe, and how far off its end is."""
    rng, map = np.random.default_rng(seed), Map()
    x, drifted, starts = np.zeros(3), [], []
    for k in range(count):
        sure = lift_covariance(np.diag((SIGMA**2) * max(k, 1e-9)))
        map.add_keyframe(Keyframe(map.new_keyframe_id(), 10**8 * k), from_plane(x), covariance=sure)
        drifted.append(x)
        if k % SUBMAP_SCANS == 0:
            starts.append(k)
        # Both say the one measurement of the keyframe, to the last bit.
        for anchor in (a for a in starts[-2:] if a != k):
            z = relative(drifted[anchor], x)
            unsure = np.diag(SIGMA**2 * (k - anchor)) * 2.0
            map.add_edge(anchor, k, from_plane(z), lift_information(np.linalg.inv(unsure)), SUBMAP)
        x = compose_planar(x, np.array([STEP, 0.0, 0.0]) + SIGMA * rng.normal(size=3))
    true_end = np.array([STEP * (count - 1), 0.0, 0.0])
    return map, true_end, np.hypot(*(drifted[-1] - true_end)[:2])


def relative(a, b):
    c, s = np.cos(a[2]), np.sin(a[2])
    d = b - a
    return np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], d[2]])


def tie(map, k, x, anchor=0):
    information = lift_information(np.diag(LOOP_SIGMA**-2.0))
    map.add_edge(anchor, k, from_plane(x), information, LOOP)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("off", [1.0, 3.0], ids=["as sure as it says", "a submap has bent"])
def test_a_single_true_loop_is_believed(seed, off):
    """What the doubled edges leave is nothing at all; that does not make the loop false."""
    map, true_end, drift = driven(seed)
    last = 59
    rng = np.random.default_rng([seed, 1])
    tie(map, last, true_end + off * LOOP_SIGMA * rng.choice([-1.0, 1.0], 3))
    solved = read_graph(map, set()).solve(ScanClosingConfig(), decides=True)
    assert not len(solved.false)
    end = solved.Ts_world_body[last][:2, 3]
    assert np.hypot(*(end - true_end[:2])) < max(0.5 * drift, 3.0 * off * LOOP_SIGMA[0])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("num_true", [0, 1, 4])
def test_a_false_loop_is_not_whether_there_are_true_ones_or_not(seed, num_true):
    map, true_end, _ = driven(seed)
    rng = np.random.default_rng([seed, 2])
    for n in range(num_true):
        tie(map, 59 - n, true_end - (STEP * n, 0, 0) + LOOP_SIGMA * rng.normal(size=3))
    tie(map, 50, true_end - (STEP * 9, 0, 0) + np.array([1.5, 0.7, 0.2]))
    solved = read_graph(map, set()).solve(ScanClosingConfig(), decides=True)
    np.testing.assert_array_equal(solved.false, [[50, 0]])
