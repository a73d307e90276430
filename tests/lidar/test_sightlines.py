"""What one sensor looked through contradicts what another saw there."""

import numpy as np
import pytest

from cloudworlds import Street
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.lidar.sightlines import Panorama


def wall(x, half=8.0, step=0.2):
    y, z = np.meshgrid(np.arange(-half, half, step), np.arange(-1.0, 3.0, step))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def test_a_wall_before_is_contradicted_behind_it_is_hidden_and_elsewhere_unknown():
    seen = Panorama(wall(10.0))
    part = wall(10.0, 3.0)
    same, before, behind = (seen.judge(f * part, np.eye(4)) for f in (1.0, 0.6, 1.5))
    assert (same.agree, same.against) == (1.0, 0.0)
    assert before.against > 0.95
    assert before.doubt > 0.95
    assert behind.agree == behind.against == 0.0
    away = seen.judge(wall(-10.0), np.eye(4))
    assert away.agree == away.against == 0.0
    assert away.doubt == 1.0  # nothing speaks for it


def test_points_are_moved_before_they_are_judged():
    seen = Panorama(wall(10.0))
    move = se3_exp(np.array([-4.0, 1.0, 0.0, 0.0, 0.0, 0.3]))
    assert seen.judge(wall(10.0, 3.0) @ se3_inverse(move)[:3, :3].T
                      + se3_inverse(move)[:3, 3], move).agree == 1.0  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_sweeps_of_one_place_do_not_contradict_each_other_and_those_of_two_do(seed):
    street = Street(seed)
    here, along = street.pose(20, -1.75), street.pose(27, 1.75, backwards=True)
    one, other = (street.cloud(T, n)[:, :3].astype(float) for n, T in enumerate((here, along)))
    T = se3_inverse(here) @ along
    both = Panorama(one).judge(other, T), Panorama(other).judge(one, se3_inverse(T))
    assert max(seen.doubt for seen in both) < 0.03
    assert min(seen.agree for seen in both) > 0.3
    elsewhere = street.cloud(street.pose(70, -1.75), 9)[:, :3].astype(float)
    high = elsewhere[elsewhere[:, 2] > 0.3]
    assert Panorama(one).judge(high, np.eye(4)).doubt > 0.1


def test_nothing_seen_says_nothing():
    nothing = Panorama(np.zeros((0, 3)))
    assert nothing.judge(wall(5.0), np.eye(4)).doubt == 1.0
    assert Panorama(wall(5.0)).judge(np.zeros((0, 3)), np.eye(4)).doubt == 1.0
