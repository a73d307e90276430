"""Whatever befalls a 3D LiDAR: the pose is right, or it is said that it is not known, and why.

Faults of a recording are disturbances of a simulated street. What a pose claims is held against the
truth: four standard deviations, and some centimetres.
"""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError
from odomap.geometry.lie import se3_inverse, so3_exp
from odomap.maps.atlas import Atlas
from odomap.maps.estimate import Status
from odomap.sources import disturb
from odomap.sources.wrappers import Changed
from odomap.system.slam import Slam
from sweepruns import PLACED, Kept, errors, judge, played

TILTED = so3_exp(np.array([0.3, -0.2, 0.7]))


def repeated(source, chosen):
    """Give the sweep of the frame before again: a driver that hands a buffer over twice."""

    def change(frame):
        if frame.id not in chosen:
            return frame
        return replace(frame, cloud=source.frame(frame.id - 1).cloud)

    return Changed(source, "repeated", change)


NOTHING = {
    "empty": lambda s: disturb.lose_sweeps(s, range(25, 29), "empty"),
    "all NaN": lambda s: disturb.lose_sweeps(s, range(25, 29), "nan"),
    "all zero": lambda s: disturb.lose_sweeps(s, range(25, 29), "zero"),
    "one point": lambda s: disturb.lose_sweeps(s, range(25, 29), "one"),
}
FAULTS = NOTHING | {
    "none": lambda s: s,
    "zeros as no-return": lambda s: disturb.with_misses(s, share=0.4),
    "NaN as no-return": lambda s: disturb.with_misses(s, share=0.4, value=np.nan),
    "a sweep twice": lambda s: repeated(s, {25, 30, 35}),
    "five dropped": lambda s: disturb.drop(s, range(25, 30)),
    "turned": lambda s: disturb.turn_lidar(s, TILTED, told=True),
    "upside down": lambda s: disturb.turn_lidar(s, so3_exp(np.array([np.pi, 0, 0])), told=True),
    "stamps go back": lambda s: disturb.set_back(s, range(25, 60, 7), by_s=0.45),
    "the clock goes back": lambda s: disturb.set_back(s, range(25, 60), by_s=3.0),
    "no times": disturb.without_columns,
    "too many beams": lambda s: disturb.miscount_beams(s, 64),
    "no motion in them": disturb.compensate,
    "no motion in them, but times": lambda s: disturb.compensate(s, keep_times=True),
    "times twice as long": lambda s: disturb.misscale_times(s, 2.0),
}


@pytest.fixture(scope="module")
def street():
    return Kept("street", 16, 60, 2)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_pose_is_right_or_not_claimed(street, fault):
    source = FAULTS[fault](street)
    made = list(source)
    estimates, _, result = played(made, source.rig)
    true = street.truth.Ts_world_body[[frame.id for frame in made]]
    off = judge(estimates, true)
    assert np.linalg.norm(off[-1, :3]) < 0.5
    assert all(e.status in PLACED for e in estimates[40:])
    lost = {e.frame_id: e.reason for e in estimates if e.status not in PLACED}
    if fault in NOTHING:
        assert set(lost) == set(range(25, 29))
        assert all("points returned from within range, 100 needed" in r for r in lost.values())
    elif fault == "a sweep twice":
        assert set(lost) == {25, 30, 35}
        assert all("the sweep is the one before" in reason for reason in lost.values())
    else:
        assert lost == {}
    # Each sweep with a pose has its row, with its stamp, and no keyframe is lost.
    stamps = sorted({e.stamp_ns for e in estimates if e.status in PLACED})
    assert result.trajectory.stamps_ns.tolist() == stamps
    assert result.map.num_keyframes > 12
    assert len(Atlas(result.map).pieces) == 1


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda s: disturb.misscale_times(s, 1e3), "lie 99.9 s apart, and a turn takes 0.1 s"),
        (
            lambda s: disturb.misscale_times(s, 1e-3),
            "all around lie 9.99e-05 s apart.*seconds",
        ),
        (
            lambda s: disturb.miscount_beams(s, 8),
            "is of beam 16, .* says that there are 8",
        ),
    ],
)
def test_what_the_rig_or_the_reader_has_wrong_is_told_and_nothing_lost(street, fault, words):
    made = list(street)[:20]
    source = fault(street)
    rig = source.rig
    with pytest.raises(CalibrationError, match=f"lidar 'top'.*{words}") as told:
        Slam(rig).track(source.frame(0))
    assert "\n" not in str(told.value)
    system = Slam(street.rig)
    _ = [system.track(frame) for frame in made]
    if rig is street.rig:
        with pytest.raises(CalibrationError):
            system.track(source.frame(20))
    assert system.finish().map.num_keyframes > 4


def test_a_mount_that_is_not_told_tilts_the_map_and_nothing_else(street):
    source = disturb.turn_lidar(street, TILTED)
    estimates, *_ = played(source, source.rig)
    T = np.eye(4)
    T[:3, :3] = TILTED
    true = street.truth.Ts_world_body
    off = judge(estimates, se3_inverse(T) @ se3_inverse(true[0]) @ true @ T)
    assert np.linalg.norm(off[-1, :3]) < 0.5
    assert np.linalg.norm(errors(estimates, true)[-1, :3]) > 5.0


def test_cars_in_a_fifth_of_the_points_do_not_pull():
    source = Kept("street", 16, 60, 3, more="&moving_objects=60")
    estimates, *_ = played(source, source.rig)
    assert all(e.status is Status.TRACKING for e in estimates)
    off = judge(estimates, source.truth.Ts_world_body)
    assert np.linalg.norm(off[-1, :3]) < 0.4
