"""Whatever befalls a 2D laser: the pose is right, or it is said that it is not known, and why.

Faults of a recording are disturbances of a simulated hall. What a pose claims is held against the
truth: four standard deviations, and some centimetres.
"""

from dataclasses import replace

import numpy as np
import pytest

from laserworlds import RIG, around, carried, frames, in_first
from lidar.rooms import ROOM
from odomap.cli import main
from odomap.errors import CalibrationError
from odomap.files.mapfile import load_map
from odomap.files.trajectories import read_tum
from odomap.geometry.planar import IN_PLANE, between_planar, from_plane, to_plane
from odomap.lidar.scans import Beams
from odomap.maps.atlas import Atlas
from odomap.maps.edges import GAP, ODOMETRY
from odomap.maps.estimate import Status
from odomap.sensors.rig import LidarMount
from odomap.sensors.sync import format_stamp
from odomap.sources import disturb
from odomap.sources.simulated import SimulatedSource
from odomap.sources.wrappers import Changed
from odomap.system.config import preset
from odomap.system.scanrecognition import ScanFinder
from odomap.system.slam import Slam

PLACED = (Status.TRACKING, Status.RECOVERED)
FIRST = 60
"""No fault begins before this scan."""
LEAST = np.array([0.06, 0.06, 0.015])
"""How far off a pose may be in any case, metres and radians."""


def repeated(source, chosen):
    """Give the scan of the frame before again: a driver that hands a buffer over twice."""

    def change(frame):
        if frame.id not in chosen:
            return frame
        return replace(frame, scan=source.frame(frame.id - 1).scan)

    return Changed(source, "repeated", change)


FAULTS = {
    "none": lambda s: s,
    "empty scans": lambda s: disturb.lose_scans(s, range(60, 64), "empty"),
    "all NaN": lambda s: disturb.lose_scans(s, range(60, 64), "nan"),
    "out of range": lambda s: disturb.lose_scans(s, range(60, 64), "inf"),
    "one beam": lambda s: disturb.lose_scans(s, range(60, 64), "one"),
    "a scan twice": lambda s: repeated(s, {60, 70, 80}),
    "five dropped": lambda s: disturb.drop(s, range(60, 65)),
    "upside down": lambda s: disturb.mirror_laser(s, told=True),
    "turned": lambda s: disturb.turn_laser(s, 0.7, told=True),
    "stamps go back": lambda s: disturb.set_back(s, range(60, 120, 7), by_s=0.45),
    "people": lambda s: disturb.walkers(s, range(60, 150), share=0.2),
    "wheels spin": lambda s: disturb.slip(s, range(60, 75), factor=3.0),
    "wheels blocked": lambda s: disturb.slip(s, range(60, 75), factor=0.0),
}


@pytest.fixture(scope="module")
def hall():
    return SimulatedSource("sim:hall?sensors=laser&seed=2&frames=160&beams=181")


def without_wheels(source):
    return Changed(source, "no wheels", lambda frame: replace(frame, odometry=None))


def off(estimate, truth):
    """Return by how much (3,) an estimate is off a true pose (3,), in the body."""
    return between_planar(to_plane(estimate.T_world_body.matrix), truth)


def judge(estimates, truth, least=LEAST):
    """Check what is claimed, (N,) estimates against (N, 3) poses from the first on."""
    for e, x in zip(estimates, truth, strict=True):
        assert np.isfinite(e.covariance).all()
        assert np.linalg.eigvalsh(e.covariance).min() >= -1e-12
        assert e.status in PLACED or e.reason
        if e.status in PLACED:
            sigma = np.sqrt(np.diag(e.covariance)[IN_PLANE])
            assert (np.abs(off(e, x)) < least + 4.0 * sigma).all(), (e.frame_id, off(e, x), sigma)


def played(source, config=None):
    """Return estimates, the truth of each from the first on, the system and its result."""
    system = Slam(source.rig, preset("lidar2d") if config is None else config)
    made = list(source)
    estimates = [system.track(frame) for frame in made]
    true = to_plane(source.truth.Ts_world_body)
    kept = [frame.id for frame in made]
    return estimates, in_first(true[kept]), system, system.finish()


@pytest.mark.parametrize("wheels", [True, False])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_pose_is_right_or_not_claimed(hall, fault, wheels):
    if not wheels and fault.startswith("wheels"):
        pytest.skip("there are none")
    source = FAULTS[fault](hall)
    source = source if wheels else without_wheels(source)
    estimates, truth, _, result = played(source)
    # Without wheels a scan that comes again says that nothing moved, which is a step off.
    judge(estimates, truth, LEAST + (0.04 if fault == "a scan twice" else 0.0))
    assert all(e.status in PLACED for e in estimates[-60:])
    lost = [e for e in estimates if e.status not in PLACED]
    if wheels:
        assert lost == []
    elif fault in ("empty scans", "all NaN", "out of range", "one beam"):
        assert {e.frame_id for e in lost} >= set(range(60, 64))
        assert all("beams" in e.reason for e in lost[:4])
    # Each scan with a pose has its row, with its stamp, and no keyframe is lost.
    stamps = sorted(e.stamp_ns for e in estimates if e.status in PLACED)
    assert result.trajectory.stamps_ns.tolist() == stamps
    assert result.map.num_keyframes > 25
    assert Atlas(result.map).pieces[0].first_id == 0
    assert len(Atlas(result.map).pieces) == 1


@pytest.mark.parametrize(
    ("mount", "words"),
    [
        (disturb.mirror_laser, "sees every turn the other way round than the wheels.*angles of a"),
        (lambda s: disturb.turn_laser(s, 0.7), r"mounted turned by 40°: say so in T_body_lidar"),
        (lambda s: disturb.turn_laser(s, -0.4), r"mounted turned by -23°"),
        (
            lambda s: disturb.widen(s, 0.67),
            "turns 0.[56]. times as large.*field of view is another",
        ),
    ],
)
def test_a_mount_that_the_wheels_contradict_is_told_with_the_mend(hall, mount, words):
    source = mount(hall)
    system = Slam(source.rig)
    with pytest.raises(CalibrationError, match=f"laser 'laser' .*{words}") as told:
        _ = [system.track(frame) for frame in source]
    assert "\n" not in str(told.value)
    assert system.map.num_keyframes > 5  # what there is by then is not lost


def test_without_wheels_a_mirrored_laser_makes_a_mirrored_map(hall):
    source = without_wheels(disturb.mirror_laser(hall))
    system = Slam(source.rig)
    estimates = [system.track(frame) for frame in source]
    mirrored = in_first(to_plane(hall.truth.Ts_world_body)) * (1.0, -1.0, -1.0)
    # The laser stands ahead of the body, and neither mirrors that.
    assert all(e.status is Status.TRACKING for e in estimates)
    assert np.abs(off(estimates[-1], mirrored[-1])[:2]).max() < 0.06


def test_slightly_wrong_angles_bend_the_path_and_not_the_statuses(hall):
    estimates, truth, *_ = played(disturb.widen(hall, 1.03))
    assert all(e.status in PLACED for e in estimates)
    assert np.abs(off(estimates[-1], truth[-1])[:2]).max() < 0.5


def test_angles_in_degrees_are_refused():
    with pytest.raises(CalibrationError, match="more than a turn: give them in radians"):
        LidarMount("laser", angles=(-90.0, 90.0, 181))
    with pytest.raises(CalibrationError, match="must be first, last, and how many"):
        LidarMount("laser", angles=(np.nan, 1.0, 181))


def test_another_number_of_beams_is_told():
    made = frames(around(40))
    short = [replace(frame, scan=frame.scan[:180]) for frame in made]
    with pytest.raises(CalibrationError, match="180 beams where the rig says 271: mend its angles"):
        Slam(RIG).track(short[0])
    system = Slam(RIG)
    estimates = [system.track(frame) for frame in [*made[:20], short[20], *made[21:]]]
    assert "a scan of 180 beams where the rig says 271" in estimates[20].reason
    assert all(e.status is Status.TRACKING for e in estimates)


# ---- where walls say little ----


@pytest.mark.parametrize("seed", range(3))
def test_along_a_corridor_covariances_hold_the_error_and_the_rest_is_known(seed):
    source = SimulatedSource(f"sim:corridor?sensors=laser&seed={seed}&frames=240&beams=181")
    estimates, truth, *_ = played(source)
    judge(estimates, truth)
    errors = np.array([off(e, x) for e, x in zip(estimates, truth, strict=True)])
    sigma = np.sqrt([np.diag(e.covariance)[IN_PLANE] for e in estimates])
    assert np.abs(errors[:, 1]).max() < 0.04
    assert np.abs(errors[:, 2]).max() < 0.01
    assert sigma[-1, 0] > 5.0 * sigma[-1, 1]
    assert np.mean((errors[30:, 0] / sigma[30:, 0]) ** 2) < 4.0


def test_in_a_field_the_wheels_say_where_it_is_and_the_covariance_how_well():
    source = SimulatedSource("sim:field?sensors=laser&seed=1&frames=150&beams=181")
    estimates, truth, *_ = played(source)
    begun = next(n for n, e in enumerate(estimates) if e.status is Status.TRACKING)
    assert begun < 10
    assert all("0 of 181 beams came back within reach" in e.reason for e in estimates[begun + 1 :])
    moved = [between_planar(truth[begun], x) for x in truth[begun:]]
    judge(estimates[begun:], moved)
    sigma = [np.sqrt(np.trace(e.covariance[:2, :2])) for e in estimates[begun:]]
    assert sigma[-1] > 3.0 * sigma[20]


def test_after_a_field_new_ground_is_mapped_where_the_wheels_say(hall):
    source = disturb.lose_scans(hall, range(30, 110), "inf")
    estimates, truth, _, result = played(source)
    judge(estimates, truth)
    assert all(e.status in PLACED for e in estimates)
    assert any(e.is_keyframe for e in estimates[110:])
    assert GAP not in result.map.edges().kind


# ---- carried elsewhere ----


@pytest.fixture(scope="module")
def building():
    return SimulatedSource("sim:building?sensors=laser&seed=1&beams=180&rounds=1.2")


def errors(result, true):
    """Return how far off (N,) the final poses are, and which frames they are of."""
    rows = result.trajectory.stamps_ns // 100_000_000 - 1
    found = to_plane(result.trajectory.Ts_world_body)
    return np.linalg.norm(found[:, :2] - in_first(true)[rows, :2], axis=1), rows


@pytest.mark.parametrize(("odometry", "dark"), [(True, 0), (False, 10)])
def test_a_kidnapped_laser_is_recognised_where_the_map_knows_the_place(building, odometry, dark):
    parts = range(500), range(200, 300)
    made, true = carried(building, *parts, odometry=odometry, dark=dark)
    system = Slam(building.rig)
    estimates = [system.track(frame) for frame in made]
    found = [e.frame_id for e in estimates[500:] if e.reason == "found again in the map"]
    assert found
    assert found[0] < 500 + dark + 30
    assert all(e.status in PLACED for e in estimates[found[0] :])
    off_m, rows = errors(system.finish(), true)
    assert off_m[rows >= found[0]].max() < 0.06
    assert GAP not in system.map.edges().kind


def test_what_is_nowhere_becomes_a_piece_that_is_joined_when_it_is_recognised(building):
    parts = range(250), range(900, 1360)
    made, true = carried(building, *parts, dark=10, odometry=False)
    system = Slam(building.rig)
    estimates = [system.track(frame) for frame in made]
    begun = [e.frame_id for e in estimates if e.status is Status.INITIALIZING]
    assert len(begun) == 1
    assert 250 < begun[0] < 320
    assert "started anew" in estimates[begun[0]].reason
    result = system.finish()
    assert [loop.merges for loop in result.loops if loop.is_accepted].count(True) == 1
    assert len(Atlas(result.map).pieces) == 1
    assert list(result.map.edges().kind).count(GAP) == 1
    off_m, rows = errors(result, true)
    assert off_m[rows < 250].max() < 0.06
    assert off_m[rows >= begun[0]].max() < 0.3
    assert np.median(off_m[rows >= begun[0]]) < 0.05


A = np.array([[-3, -2], [3, -2], [3, -0.6], [3, 0.6], [3, 2], [-3, 2]], float)
TABLE = np.array([[-1.5, -1.2], [-0.7, -1.2], [-0.7, -0.5], [-1.5, -0.5]])


def lines(points, closed=True):
    """Return thin polygons along the sides of a polygon."""
    ends = np.roll(points, -1, axis=0) if closed else points[1:]
    return [np.array([a, b]) for a, b in zip(points, ends)]


def twins():
    """Return two rooms of one plan, the second turned, with a corridor between that is not."""
    walls = [w for w in lines(A) if not (w[:, 0] == 3).all() or abs(w[:, 1]).max() > 1.0]
    room = [*walls, TABLE]
    other = [np.array([14.0, 0.0]) - w for w in room]
    corridor = [np.array([[3, s * 0.6], [11, s * 0.6]]) for s in (-1, 1)]
    return (*room, *other, *corridor, np.array([[5, 0.6], [5, 0.4], [6.5, 0.4], [6.5, 0.6]]))


def test_one_of_two_rooms_of_one_plan_is_not_taken_for_the_other():
    way = np.column_stack([np.linspace(-1.0, 15.0, 160), np.zeros(160), np.zeros(160)])
    system = Slam(RIG)
    estimates = [system.track(frame) for frame in frames(way, walls=twins())]
    judge(estimates, in_first(way))
    submaps, beams = system.submaps, Beams(RIG.lidars[0])
    finder = ScanFinder(system.map, submaps.pieces, preset("lidar2d").scan_tracking)
    places = [*submaps.finished, *submaps.active]
    for x, heading in ((0.3, 0.2), (13.7, np.pi + 0.2)):
        place = np.array([[x, 0.3, heading]])
        scan = beams.points(frames(place, walls=twins())[0].scan)
        said = finder.anywhere(places, scan)
        assert isinstance(said, str)
        assert "it looks" in said
    place = np.array([[5.3, 0.1, 0.4]])
    submap, match = finder.anywhere(places, beams.points(frames(place, walls=twins())[0].scan))
    T = system.map.place(submap.anchor_id, from_plane(match.x_grid_body))
    assert np.abs(to_plane(T) - between_planar(way[0], place[0])).max() < 0.1


def test_a_place_that_nothing_else_ties_is_tied_by_the_wheels_and_said_to_be():
    far = tuple(np.array([20.0, 0.5]) - polygon for polygon in ROOM)
    path = np.column_stack([np.linspace(0, 20, 200), np.zeros(200), np.zeros(200)])
    made = frames(path, walls=(*ROOM, *far))
    for n in range(30, 170):
        made[n] = replace(made[n], scan=np.full(271, np.inf))
    system = Slam(RIG)
    estimates = [system.track(frame) for frame in made]
    judge(estimates, in_first(path))
    assert all(e.status in PLACED for e in estimates)
    assert any("mapped where odometry says" in e.reason for e in estimates)
    kinds = system.finish().map.edges().kind
    assert ODOMETRY in kinds
    assert GAP not in kinds


# ---- as a person meets them ----


def write_log(path, source, count=160):
    """Write scans and wheels as a CARMEN log."""
    lines = []
    for k in range(count):
        frame = source.frame(k)
        x, y, heading = to_plane(frame.odometry)
        laser = to_plane(frame.odometry @ source.rig.lidars[0].T_body_lidar.matrix)
        ranges = " ".join(f"{r:.3f}" for r in np.nan_to_num(frame.scan, nan=0.0, posinf=81.83))
        poses = " ".join(f"{v:.6f}" for v in (*laser, x, y, heading))
        stamp = format_stamp(frame.stamp_ns)
        lines.append(f"FLASER {len(frame.scan)} {ranges} {poses} {stamp} nohost {0.1 * k:.1f}\n")
    path.write_text("".join(lines))
    return path


@pytest.fixture(scope="module")
def half():
    """Return a hall seen by a laser with the angles that logs are taken to have."""
    return SimulatedSource("sim:hall?sensors=laser&seed=2&frames=160&beams=181&fov_deg=180")


def test_a_log_of_a_mirrored_laser_ends_with_one_line_and_keeps_what_there_is(
    half, tmp_path, capsys
):
    log, out = write_log(tmp_path / "m.clf", disturb.mirror_laser(half)), tmp_path / "out"
    assert main(["run", str(log), "--out", str(out), "--quiet"]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith(f"odomap: {log}: laser 'laser' sees every turn the other way round")
    assert said.endswith(f"what was tracked before is in {out}")
    assert len(read_tum(out / "trajectory.tum")) > 20
    assert load_map(out / "map.odomap").num_keyframes > 5
    assert (out / "grid.pgm").exists()


def test_a_log_cut_in_a_line_is_run_up_to_there(half, tmp_path):
    log, out = write_log(tmp_path / "cut.clf", half), tmp_path / "out"
    data = log.read_bytes()
    log.write_bytes(data[: int(0.9 * len(data))])
    assert main(["run", str(log), "--out", str(out), "--quiet"]) == 0
    path = read_tum(out / "trajectory.tum")
    assert 135 < len(path) < 146
    assert (out / "metrics.json").read_text().count("ends after") >= 1
