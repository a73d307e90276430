"""One call from a recording to its results, as a program uses it."""

import json
import threading
import time

import numpy as np
import pytest

import odomap
from odomap.errors import CalibrationError, ConfigError, InputError, OutputError
from odomap.files.trajectories import read_tum
from odomap.geometry.pose import SE3
from odomap.logbook import Logbook, peak_memory_mb, spread
from odomap.maps.estimate import Estimate, Status
from odomap.outputs import as_json
from odomap.run import Interrupted, Progress, chosen_config, run
from odomap.sensors.frame import Frame
from odomap.sources.open import open as open_source
from odomap.sources.source import Skipped
from recordings import Rendered

WORLD = "sim:room?seed=3&frames=12&resolution=400x250"


class Stopping:
    """A source that presses Ctrl-C while it hands out a frame."""

    def __init__(self, source, after):
        self._source, self._after = source, after
        self.name, self.rig, self.truth = source.name, source.rig, source.truth
        self.skipped = []

    def __len__(self):
        return len(self._source)

    def __iter__(self):
        import signal

        for frame in self._source:
            if frame.id == self._after:
                signal.raise_signal(signal.SIGINT)
            yield frame


class Edited(Stopping):
    """A source whose frames go through a function; None leaves a frame out."""

    def __iter__(self):
        for frame in self._source:
            edited = self._after(frame)
            if edited is None:
                self.skipped.append(Skipped(frame.stamp_ns, f"{frame.id}.png", "truncated"))
            else:
                yield edited


@pytest.fixture(scope="module")
def world():
    return Rendered(WORLD)


@pytest.fixture(scope="module")
def result(world, tmp_path_factory):
    return run(world, tmp_path_factory.mktemp("out"))


def test_result_has_a_path_and_its_numbers(result, world):
    assert result.failure == ""
    assert len(result.trajectory) == len(result.trajectory_live) == 12
    assert len(result.estimates) == 12
    assert all(estimate.tracks is None for estimate in result.estimates)
    m = result.metrics
    assert (m["frames"], m["tracked"], m["lost"]) == (12, 12, 0)
    assert m["statuses"]["lost"] == 0
    assert m["keyframes"] >= 1
    assert m["landmarks"] > 50
    assert m["duration_s"] == pytest.approx(world.truth.duration_s, abs=1e-6)
    assert m["ate_rmse_m"] == pytest.approx(odomap.ate(result.trajectory, world.truth).rmse)
    assert m["ate_rmse_m"] < 0.01
    assert set(m["versions"]) >= {"odomap", "python", "numpy", "numba"}


def test_folder_holds_what_the_result_says(result):
    assert result.out is not None
    assert set(result.written) == {path.name for path in result.out.iterdir()}
    assert json.loads((result.out / "metrics.json").read_text())["frames"] == 12
    np.testing.assert_allclose(
        read_tum(result.out / "trajectory.tum").positions, result.trajectory.positions, atol=1e-9
    )
    html = (result.out / "report.html").read_text()
    assert "<svg" in html or "<img" in html


def test_without_a_folder_nothing_is_written(world, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = run(world, max_frames=3)
    assert found.metrics["frames"] == 3
    assert found.out is None
    assert found.written == ()
    assert list(tmp_path.iterdir()) == []


def test_progress_tells_stages_and_frames(world):
    told: list[Progress] = []
    run(world, max_frames=3, progress=told.append)
    stages = list(dict.fromkeys(p.stage for p in told))
    assert stages == ["compiling", "tracking"]
    tracking = [p for p in told if p.stage == "tracking"]
    assert [(p.done, p.total) for p in tracking] == [(1, 3), (2, 3), (3, 3)]
    assert all(p.estimate is not None for p in tracking)


def test_interrupt_ends_after_the_frame_at_hand_and_writes(world, tmp_path):
    with pytest.raises(Interrupted) as stop:
        run(Stopping(world, after=5), tmp_path)
    result = stop.value.result
    assert isinstance(stop.value, KeyboardInterrupt)
    assert result.metrics["interrupted"] is True
    assert result.metrics["frames"] == 6
    assert len(read_tum(tmp_path / "trajectory.tum")) == 6
    assert (tmp_path / "report.html").exists()


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("rhythm", ["inline", "lockstep", "live"])
def test_interrupt_leaves_what_there_is_in_every_rhythm(world, tmp_path, rhythm):
    before = set(threading.enumerate())
    with pytest.raises(Interrupted) as stop:
        run(Stopping(world, after=5), tmp_path, rhythm=rhythm)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["interrupted"] is True
    assert metrics["rhythm"] == rhythm
    assert len(read_tum(tmp_path / "trajectory.tum")) == metrics["tracked"] <= 6
    assert len(stop.value.result.estimates) == metrics["frames"]
    assert not [t for t in set(threading.enumerate()) - before if t.name.startswith("odomap")]


PARTS = ("reads", "solves", "writes")
SAME = ("trajectory.tum", "trajectory_live.tum", "keyframes.tum", "map.odomap")


@pytest.mark.usefixtures("no_report")
def test_lockstep_is_the_default_and_writes_the_same_bytes_again(result, tmp_path):
    """Also of a world that is rendered anew."""
    assert result.metrics["rhythm"] == "lockstep"
    assert "\nrhythm: lockstep\n" in (result.out / "config.yaml").read_text()
    again = run(WORLD, tmp_path)
    for name in SAME:
        assert (again.out / name).read_bytes() == (result.out / name).read_bytes()
    for name in ("frames_dropped", "jobs_skipped", "messages_dropped"):
        assert again.metrics[name] == result.metrics[name] == 0
    beside = result.metrics["beside_ms"]
    stages = {f"{stage} {part}" for stage in ("map", "close") for part in PARTS}
    assert set(beside) == {"keyframe", *stages}
    assert beside["map solves"]["count"] == beside["map writes"]["count"] >= 1
    assert "Beside the frames" in (result.out / "report.html").read_text()


@pytest.mark.usefixtures("no_report")
def test_with_a_delay_of_one_lockstep_writes_the_bytes_of_inline(world, tmp_path):
    config = chosen_config("stereo", None, [("threads.mapping_delay", "1")])
    for rhythm in ("inline", "lockstep"):
        found = run(world, tmp_path / rhythm, config=config, rhythm=rhythm)
        assert found.metrics["rhythm"] == rhythm
    for name in SAME:
        inline, lockstep = (tmp_path / rhythm / name for rhythm in ("inline", "lockstep"))
        assert inline.read_bytes() == lockstep.read_bytes()


@pytest.mark.usefixtures("no_report")
def test_live_counts_the_frames_that_it_drops(world, tmp_path):
    def slow(progress):
        if progress.stage == "tracking" and progress.done == 2:
            time.sleep(1.0)  # twenty frames of the sensor

    found = run(world, tmp_path, rhythm="live", progress=slow)
    m = json.loads((tmp_path / "metrics.json").read_text())
    assert m["rhythm"] == "live"
    assert m["frames_dropped"] >= 5
    assert m["frames"] + m["frames_dropped"] == 12
    dropped = m["frames_dropped"]
    assert (
        f"{dropped} of 12 frames were dropped: tracking is slower than they come" in found.warnings
    )
    assert found.warnings == tuple(m["warnings"])


def test_runs_in_a_thread_without_touching_signals(world):
    found = []
    thread = threading.Thread(target=lambda: found.append(run(world, max_frames=2)))
    thread.start()
    thread.join()
    assert found[0].metrics["frames"] == 2


@pytest.mark.usefixtures("no_report")
def test_skipped_frames_are_counted_and_named(world, tmp_path):
    source = Edited(world, lambda frame: None if frame.id == 4 else frame)
    result = run(source, tmp_path)
    assert result.metrics["frames"] == 11
    assert result.metrics["skipped"] == 1
    assert result.metrics["skipped_measurements"][0]["file"] == "4.png"
    assert any("4.png: truncated" in warning for warning in result.warnings)


def test_a_gap_is_a_warning(world):
    def late(frame):
        shift = 2_000_000_000 if frame.id > 6 else 0
        return Frame(frame.id, frame.stamp_ns + shift, frame.images)

    result = run(Edited(world, late))
    assert any("a gap of 2.05 s after frame 6" in warning for warning in result.warnings)


def test_black_frames_are_lost_and_fail_the_run(world, tmp_path):
    def blank(frame):
        black = tuple(np.zeros_like(image) for image in frame.images)
        return frame if frame.id < 2 else Frame(frame.id, frame.stamp_ns, black)

    result = run(Edited(world, blank), tmp_path)
    assert result.metrics["lost"] == 10
    assert "2 of 12 frames have a pose" in result.failure
    assert len(read_tum(tmp_path / "trajectory.tum")) == 2


def test_a_source_without_frames_fails_with_a_reason(world, tmp_path):
    result = run(Edited(world, lambda frame: None), tmp_path)
    assert result.failure == "no frame could be read"
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "trajectory.tum").exists()


def test_config_changes_the_run(world, tmp_path):
    (tmp_path / "c.yaml").write_text("orb: {count: 300}\n")
    few = run(world, config=tmp_path / "c.yaml", max_frames=4)
    many = run(world, max_frames=4)
    assert few.metrics["landmarks"] < many.metrics["landmarks"]


def test_refusals(world, tmp_path):
    with pytest.raises(ConfigError, match=r"'locked' is unknown.*: inline, lockstep, live"):
        run(world, rhythm="locked")
    with pytest.raises(ConfigError, match="did you mean 'stereo'"):
        run(world, preset="streo")
    with pytest.raises(InputError, match="max_frames"):
        run(world, max_frames=0)
    with pytest.raises(InputError, match="does not exist"):
        run(tmp_path / "nothing")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        run(world, tmp_path / "file")


def test_a_rig_without_a_pair_names_the_recording(world, tmp_path):
    class Single(Stopping):
        pass

    from dataclasses import replace

    source = Single(world, after=-1)
    source.rig = replace(world.rig, cameras=world.rig.cameras[:1])
    with pytest.raises(CalibrationError, match=r"^sim:room.*stereo needs two cameras"):
        run(source, preset="stereo")


def estimate(k, status=Status.TRACKING, keyframe_id=0):
    pose = SE3.identity()
    return Estimate(k, 10**9 * k, status, "dark", keyframe_id, pose, pose, np.eye(6))


def test_logbook_keeps_a_few_frames_only():
    book = Logbook(1000)
    frame = Frame(0, 0, (np.zeros((4, 4), np.uint8),))
    for k in range(1000):
        book.add(frame, estimate(k), 0.01)
    assert len(book.samples) == 6
    assert book.samples[0][1].frame_id == 0
    assert book.samples[-1][1].frame_id == 999
    assert book.frames_per_second == pytest.approx(100.0)


def test_logbook_counts_what_has_a_pose():
    book = Logbook(4)
    frame = Frame(0, 0)
    for k, (status, keyframe) in enumerate(
        [(Status.INITIALIZING, -1), (Status.TRACKING, 0), (Status.LOST, 0), (Status.LOST, 0)]
    ):
        book.add(frame, estimate(k, status, keyframe), 0.01)
    assert book.placed == 1
    assert book.failure() == "tracking was lost, 1 of 4 frames have a pose: dark"


def test_numbers_that_are_not_finite_become_null():
    text = as_json({"a": float("nan"), "b": [float("inf"), 1.0], "c": {"d": -0.5}})
    assert json.loads(text) == {"a": None, "b": [None, 1.0], "c": {"d": -0.5}}


def test_spread_and_memory():
    assert spread([1.0, 2.0, 9.0])["median"] == 2.0
    assert spread([])["p95"] == 0.0
    assert 20 < peak_memory_mb() < 1e5


# ---- every camera ----

LONE = "sim:room?seed=3&frames=24&rate_hz=12&resolution=400x250&sensors="


@pytest.fixture(scope="module")
def lone(tmp_path_factory):
    """A run of a single camera, and the recording."""
    source = Rendered(LONE + "mono")
    return run(source, tmp_path_factory.mktemp("lone")), source


def test_a_single_camera_is_tracked_as_one(lone):
    result, source = lone
    assert result.failure == ""
    assert "sensors: mono" in (result.out / "config.yaml").read_text()
    m = result.metrics
    assert m["is_metric"] is False
    assert m["statuses"]["initializing"] > 0
    # Frames before the start are placed in the end.
    assert m["frames"] == m["tracked"] == len(result.trajectory) == 24
    assert len(result.trajectory_live) == 24 - m["statuses"]["initializing"]
    assert "one camera cannot tell the scale: lengths are in units of their own" in result.warnings
    assert not any("lost" in warning or "anew" in warning for warning in result.warnings)
    # So truth is compared up to scale.
    assert m["ate"]["scale"] == pytest.approx(
        odomap.ate(result.trajectory, source.truth, "sim3").scale
    )
    assert m["ate"]["scale"] > 1.5
    assert m["ate_rmse_m"] < 0.01


def test_keyframes_have_a_file_of_their_own(lone, result):
    for found in (lone[0], result):
        keyframes = read_tum(found.out / "keyframes.tum")
        assert len(keyframes) == found.metrics["keyframes"] >= 2
        path = read_tum(found.out / "trajectory.tum")
        rows = np.searchsorted(path.stamps_ns, keyframes.stamps_ns)
        np.testing.assert_array_equal(path.stamps_ns[rows], keyframes.stamps_ns)
        np.testing.assert_allclose(path.positions[rows], keyframes.positions, atol=1e-9)


@pytest.mark.usefixtures("no_report")
def test_the_config_of_a_single_camera_repeats_its_run(lone, tmp_path):
    result, source = lone
    again = run(source, tmp_path, config=result.out / "config.yaml")
    for name in ("trajectory.tum", "trajectory_live.tum", "keyframes.tum"):
        assert (again.out / name).read_bytes() == (result.out / name).read_bytes()


def test_a_camera_with_depth_is_tracked_with_it(tmp_path):
    result = run(LONE + "mono,depth", tmp_path, max_frames=12)
    assert "sensors: rgbd" in (tmp_path / "config.yaml").read_text()
    m = result.metrics
    assert m["is_metric"] is True
    assert (m["frames"], m["tracked"], m["lost"]) == (12, 12, 0)
    assert m["statuses"]["initializing"] == 0
    assert m["ate"]["scale"] == 1.0
    assert m["ate_rmse_m"] < 0.01
    assert not any("scale" in warning for warning in result.warnings)


def test_one_camera_of_a_pair_may_be_asked_for():
    """The path is that of the camera, though the body is the IMU."""
    world = "sim:room?seed=3&frames=20&rate_hz=12&resolution=400x250&sensors=stereo,imu"
    source = open_source(world)
    result = run(source, preset="mono")
    assert result.metrics["is_metric"] is False
    assert result.failure == ""
    assert result.metrics["tracked"] == 20
    mount = source.rig.cameras[0].T_body_camera.matrix
    assert np.abs(mount - np.eye(4)).max() > 0.01
    assert result.metrics["ate_rmse_m"] < 0.01


def test_a_camera_that_never_moves_fails_with_the_reason():
    source = open_source(LONE + "mono")
    still = source.frame(0)
    edited = Edited(source, lambda frame: Frame(frame.id, frame.stamp_ns, still.images))
    result = run(edited, max_frames=6)
    assert "0 of 6 frames have a pose" in result.failure
    assert "move the camera sideways" in result.failure
    assert result.metrics["keyframes"] == 0


def test_a_frame_that_cannot_be_loses_nothing_of_those_before(world, tmp_path):
    from dataclasses import replace

    def shrunk(frame):
        if frame.id < 6:
            return frame
        return replace(frame, images=tuple(np.ascontiguousarray(i[::2, ::2]) for i in frame.images))

    with pytest.raises(CalibrationError, match=r"^sim:room.*frame 6: the image is .*before is in"):
        run(Edited(world, shrunk), tmp_path)
    assert len(read_tum(tmp_path / "trajectory.tum")) == 6
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["failure"].startswith("tracking stopped: frame 6")
    assert (tmp_path / "report.html").exists()
