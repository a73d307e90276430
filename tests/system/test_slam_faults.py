"""Whatever befalls a camera: the pose is right, or the status says that it is not known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from faultworlds import FIRST, Recordings, faults_of, judge
from odomap.geometry.lie import se3_exp
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Status
from odomap.system.odometry import MonocularVO, RgbdVO, StereoVO
from odomap.system.slam import Slam

SYSTEMS = {
    "Slam stereo": ("stereo", Slam),
    "Slam mono": ("mono", Slam),
    "Slam rgbd": ("rgbd", Slam),
    "StereoVO": ("stereo", StereoVO),
    "MonocularVO": ("mono", lambda rig: MonocularVO(rig.cameras[0].camera)),
    "RgbdVO": ("rgbd", RgbdVO),
}
"""What is tested: the sensors it looks at, and how it is made from a rig that carries just them."""
OBJECTS = ["object crossing", "object lingering", "object coming along"]
FLOW = ["frozen for long", "over-exposed", "blur"]
TOLD = {
    "Slam stereo": [f for f in faults_of("stereo") if f not in OBJECTS],
    "Slam mono": [
        *("over-exposed", "frozen for long", "every third dropped", "hand over the lens"),
        "pure rotation",
    ],
    "Slam rgbd": [
        *("over-exposed", "every third dropped", "hand over the lens", "blur"),
    ],
    "StereoVO": FLOW,
    "MonocularVO": FLOW,
    "RgbdVO": FLOW,
}
"""The faults that tell something of each; `benchmarks/faults.py` has all for all."""

OUTVOTED = "a few points on the board pull the pose along, or tracking leaps back to what was known"


def cases():
    for name, faults in TOLD.items():
        for fault in faults:
            yield pytest.param(name, fault, id=f"{name}: {fault}")


@pytest.fixture(scope="module")
def recordings():
    return Recordings()


@pytest.fixture(scope="module")
def run(recordings):
    """What came of each system under each fault, run once."""

    @cache
    def results(name, fault):
        sensors, make = SYSTEMS[name]
        source = recordings.disturbed(sensors, fault)
        system = make(source.rig)
        estimates = [system.track(frame) for frame in source]
        return source, estimates, system.finish()

    return results


@pytest.mark.parametrize(("name", "fault"), list(cases()))
def test_a_pose_is_right_or_not_claimed(run, name, fault):
    source, estimates, result = run(name, fault)
    judgement = judge(source, estimates, is_metric=result.is_metric)
    assert judgement.wrong == []
    assert judgement.is_tracking
    assert np.isfinite(result.trajectory.Ts_world_body).all()
    assert np.isfinite(result.trajectory.covariances).all()


@pytest.fixture(scope="module")
def plainer():
    """A room in which the board stands out more: in some rooms a pose survives it by luck."""
    return Recordings(seed=5)


def boards():
    for sensors in ("stereo", "rgbd"):
        for fault in OBJECTS:
            marks = []
            if sensors == "rgbd" and fault != "object coming along":
                # A matter of single landmarks: on another processor one of them may go well.
                marks = [pytest.mark.xfail(reason=OUTVOTED, strict=False)]
            yield pytest.param(sensors, fault, marks=marks)


@pytest.mark.parametrize(("sensors", "fault"), list(boards()))
def test_a_thing_that_moves_is_not_taken_for_the_world(plainer, sensors, fault):
    source = plainer.disturbed(sensors, fault)
    system = Slam(source.rig)
    estimates = [system.track(frame) for frame in source]
    assert judge(source, estimates).wrong == []


def test_a_new_start_is_not_tied_to_what_was_before_by_chance(plainer):
    """A hand hides the lens until tracking starts anew, half a metre and 27 degrees off."""
    source = plainer.disturbed("stereo", "hand over the lens")
    system = Slam(source.rig)
    estimates = [system.track(frame) for frame in source]
    assert judge(source, estimates).wrong == []
    assert Status.INITIALIZING in [e.status for e in estimates[22:28]]


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_cannot_be_seen_is_said_and_left_again(run, name):
    _, estimates, _ = run(name, "over-exposed")
    lost = [e for e in estimates if e.status is Status.LOST]
    assert [e.frame_id for e in lost] == [18, 19, 20, 21]
    assert all("nearly uniform" in e.reason for e in lost)
    assert estimates[22].status is Status.RECOVERED


@pytest.mark.parametrize("name", ["Slam stereo", "Slam mono", "StereoVO", "RgbdVO"])
def test_a_frozen_image_is_said_to_be_frozen(run, name):
    _, estimates, _ = run(name, "frozen for long")
    lost = [e for e in estimates if e.status is Status.LOST]
    assert [e.frame_id for e in lost] == list(range(18, 27))
    assert all("frozen" in e.reason for e in lost)


@pytest.mark.parametrize("fault", ["right missing", "right black", "right frozen"])
def test_a_pair_goes_on_with_one_camera_on_what_it_knows(run, fault):
    _, estimates, _ = run("Slam stereo", fault)
    assert {e.status for e in estimates} == {Status.TRACKING}
    if fault == "right missing":
        assert not any(e.is_keyframe for e in estimates[20:])
        assert any("right image is missing" in e.reason for e in estimates[20:])


# ---- the judge ----


@pytest.fixture(scope="module")
def good(run):
    source, estimates, _ = run("Slam stereo", "none")
    return source, estimates


def changed(estimates, frame, **fields):
    return [replace(e, **fields) if e.frame_id == frame else e for e in estimates]


def moved(e, twist):
    return SE3(e.T_world_body.matrix @ se3_exp(np.array(twist, float)))


def test_the_judge_sees_nothing_where_nothing_is(good):
    judgement = judge(*good)
    assert judgement.wrong == []
    assert judgement.num_lost == judgement.num_leaps == 0
    assert judgement.largest_m < 0.05


@pytest.mark.parametrize("twist", [[0, 0.2, 0, 0, 0, 0], [0, 0, 0, 0, 0.06, 0]])
def test_the_judge_sees_a_wrong_pose(good, twist):
    source, estimates = good
    wrong = changed(estimates, 25, T_world_body=moved(estimates[25], twist))
    assert [line for line in judge(source, wrong).wrong if "off by" in line and "25" in line]
    # One that says so is not believed, and what it says is not held against it.
    said = changed(wrong, 25, status=Status.LOST, reason="dark")
    assert judge(source, said).wrong == []
    assert judge(source, said).num_lost == 1


def test_the_judge_sees_a_leap_that_covariances_hide(good):
    source, estimates = good
    T = moved(estimates[25], [0.9, 0, 0, 0, 0, 0])
    leap = changed(estimates, 25, T_world_body=T, covariance=np.eye(6))
    judgement = judge(source, leap)
    assert judgement.num_leaps == 2  # there and back
    assert all("leaps" in line for line in judgement.wrong)
    recovered = changed(leap, 25, status=Status.RECOVERED)
    assert judge(source, recovered).num_leaps == 1


def test_the_judge_sees_what_is_no_estimate(good):
    source, estimates = good
    tilted = np.array(estimates[20].covariance)
    tilted[0, 1] += 1.0
    for fields, what in (
        ({"covariance": np.full((6, 6), np.nan)}, "not finite"),
        ({"covariance": tilted}, "not symmetric"),
        ({"covariance": -np.eye(6)}, "negative"),
        ({"status": Status.LOST, "reason": ""}, "no reason"),
    ):
        judgement = judge(source, changed(estimates, 20, **fields))
        assert any(what in line and "frame 20" in line for line in judgement.wrong)


def test_no_fault_begins_before_it_may(recordings):
    """The frames before it are what poses are aligned on."""
    for sensors in ("stereo", "rgbd"):
        plain = list(recordings.disturbed(sensors, "none"))
        for fault in faults_of(sensors):
            if fault == "pure rotation":
                continue
            for frame in recordings.disturbed(sensors, fault):
                if frame.id >= FIRST:
                    break
                for ours, theirs in zip(frame.images, plain[frame.id].images, strict=True):
                    if "exposure" not in fault:
                        np.testing.assert_array_equal(ours, theirs)
