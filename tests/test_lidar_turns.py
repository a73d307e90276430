"""A body that does not go on as before: it turns round at once, or is somewhere else.

Whatever lays the sweeps down (`system/cloudlaying`): the pose is right, or it is said that it is
not known.
"""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.lie import se3_inverse
from odomap.maps.atlas import Atlas
from odomap.maps.estimate import Status
from odomap.sources.disturb import there_and_back
from odomap.system.config import preset
from odomap.system.slam import Slam
from sweepruns import PLACED, Kept, errors, judge

FRONT_ENDS = "points", "loam", "lego"


def tracked(frames, rig, front_end, closing=True):
    """Return estimates and the system."""
    config = preset("lidar")
    config = replace(
        config,
        cloud_tracking=replace(config.cloud_tracking, front_end=front_end),
        cloud_closing=replace(config.cloud_closing, enabled=closing),
    )
    system = Slam(rig, config)
    return [system.track(frame) for frame in frames], system


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


@pytest.fixture(scope="module")
def street():
    return Kept("street", 16, 120, 5)


def joined(source, *parts):
    """Return frames as if the body was carried from one part to the next, and true poses."""
    rows = [k for part in parts for k in part]
    made = [source.frame(k) for k in rows]
    made = [replace(f, id=n, stamp_ns=10**8 * (n + 1)) for n, f in enumerate(made)]
    return made, source.truth.Ts_world_body[rows]


@pytest.mark.parametrize("front_end", FRONT_ENDS[1:])
def test_features_do_not_hide_that_it_was_carried_to_where_it_was(street, front_end):
    made, true = joined(street, range(90), range(20, 50))
    estimates, system = tracked(made, street.rig, front_end)
    assert estimates[90].status is Status.LOST
    assert "carried off?" in estimates[90].reason
    judge(estimates, true)
    found = next(e.frame_id for e in estimates[90:] if e.status is Status.RECOVERED)
    assert found < 96
    assert all(e.status in PLACED for e in estimates[found:])
    assert np.linalg.norm(errors(estimates, true)[found + 2 :, :3], axis=1).max() < 0.4
    assert len(Atlas(system.map).pieces) == 1


@pytest.mark.parametrize("front_end", FRONT_ENDS[1:])
def test_features_do_not_hide_that_it_was_carried_to_where_it_never_was(street, front_end):
    made, true = joined(street, range(40), range(70, 110))
    estimates, system = tracked(made, street.rig, front_end)
    begun = next(e.frame_id for e in estimates if e.status is Status.INITIALIZING)
    assert 43 < begun < 53
    assert all(e.status is Status.LOST for e in estimates[40:begun])
    piece = [e.T_world_body.matrix for e in estimates[begun + 2 :]]
    moved = se3_inverse(piece[0]) @ np.array(piece)
    truly = se3_inverse(true[begun + 2]) @ true[begun + 2 :]
    assert np.linalg.norm(moved[:, :3, 3] - truly[:, :3, 3], axis=1).max() < 0.4
    assert len(Atlas(system.map).pieces) == 2
