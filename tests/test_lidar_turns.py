"""A body that does not go on as before is followed, whatever lays the sweeps down."""

import numpy as np
import pytest

from odomap.sources.disturb import there_and_back
from sweepruns import PLACED, Kept, judge, tracked

FRONT_ENDS = "points", "loam", "lego"


@pytest.fixture(scope="module", params=[(1, 16), (4, 32)])
def turning(request):
    """A drive there and back at 15 m/s, turned round within one sweep."""
    seed, beams = request.param
    return there_and_back(Kept("street", beams, 50, seed))


@pytest.mark.parametrize("front_end", FRONT_ENDS)
def test_one_that_turns_round_at_once_is_followed(turning, front_end):
    """Its speed errs by 30 m/s for a sweep, and the guess by 3 m."""
    true = turning.truth.Ts_world_body
    estimates, _ = tracked(turning, turning.rig, front_end, closing=False)
    assert all(e.status in PLACED for e in estimates)
    off = judge(estimates[:25], true[:25])
    # A stamp is not in the middle of a sweep, and over the first one back nobody knows the twist.
    off = judge(estimates[27:], true[27:], first=true[0])
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.2
