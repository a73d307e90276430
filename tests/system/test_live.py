"""Live: nothing waits for what is slow, all that is left out is counted, and no thread stays."""

import logging
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest

from odomap.evaluation.metrics import ate
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.background import ThreadConfig
from odomap.system.config import Config
from odomap.system.feed import Feed, Mailbox
from odomap.system.live import LiveWorker
from odomap.system.odometry import StereoVO
from odomap.system.stages import Stages


@pytest.fixture(autouse=True)
def no_thread_stays():
    before = sys.getswitchinterval(), signal.getsignal(signal.SIGINT)
    yield
    assert (sys.getswitchinterval(), signal.getsignal(signal.SIGINT)) == before
    assert not [t.name for t in threading.enumerate() if t.name.startswith("odomap")]


class Track:
    """Every frame is a keyframe; calls `during`, which may wait."""

    def __init__(self, map, during=lambda frame: None):
        self.map, self.during = map, during
        self.stamp_ns = -1

    def prepare(self, frame):
        return frame

    def track(self, frame):
        self.during(frame)
        self.stamp_ns = frame.stamp_ns
        return Estimate(
            frame_id=frame.id,
            stamp_ns=frame.stamp_ns,
            status=Status.TRACKING,
            reason="",
            keyframe_id=self.map.num_keyframes - 1,
            T_keyframe_body=SE3.identity(),
            T_world_body=SE3.identity(),
            covariance=np.eye(6),
            is_keyframe=True,
        )

    def make_keyframe(self):
        k = self.map.new_keyframe_id()
        self.map.add_keyframe(Keyframe(k, self.stamp_ns), np.eye(4))
        return self.map.keyframe(k)


class Slow:
    """A mapper whose jobs wait until they are let go."""

    def __init__(self, map):
        self.map, self.read, self.written = map, [], []
        self.go = threading.Semaphore(0)

    def last(self):
        return None

    def add(self, keyframe):
        self.read.append(keyframe.id)
        return SlowJob(self, keyframe.id)


class SlowJob:
    def __init__(self, mapper, keyframe_id):
        self.mapper, self.keyframe_id, self.loops = mapper, keyframe_id, ()

    def solve(self):
        assert self.mapper.go.acquire(timeout=30)
        return self

    def write(self, map):
        self.mapper.written.append(self.keyframe_id)


def release(worker):
    """Let a job be solved, and see that the worker knows, as it would at the next frame."""
    worker._take_back()
    worker.stages.mapper.go.release()
    deadline = time.perf_counter() + 30
    while not worker._lanes[0].is_solved:
        assert time.perf_counter() < deadline
        time.sleep(0.001)


def make(during=lambda frame: None, mapper=None, **config):
    m = Map()
    stages = Stages(m, Track(m, during), mapper(m) if mapper else None)
    return LiveWorker(stages, ThreadConfig(**config))


def frames(first, last):
    return [Frame(n, 50 * n) for n in range(first, last)]


def endless(stop):
    """A camera that always has a frame, until it is told to stop."""
    number = 0
    while not stop.is_set():
        yield Frame(number, number)
        number += 1
        time.sleep(0.001)


# ---- stages ----


def test_a_change_is_written_at_the_first_frame_that_finds_it_solved():
    worker = make(mapper=Slow)
    mapper = worker.stages.mapper
    for frame in frames(0, 1):
        worker.advance(frame)
    release(worker)
    assert (mapper.read, mapper.written) == ([0], [])  # no frame has come to find it
    worker.advance(Frame(1, 50))
    worker._take_back()
    assert (mapper.read, mapper.written) == ([0, 1], [0])
    mapper.go.release()
    worker.finish()
    assert mapper.written == [0, 1]
    assert worker.jobs_skipped == 0


def test_a_mapper_that_is_behind_skips_to_the_newest_keyframe():
    worker = make(mapper=Slow)
    mapper = worker.stages.mapper
    for frame in frames(0, 5):
        worker.advance(frame)
    worker._take_back()
    assert mapper.read == [0]
    assert worker.jobs_skipped == 3  # 1, 2 and 3; 4 waits
    release(worker)
    worker.advance(Frame(5, 250))
    worker._take_back()
    assert mapper.read == [0, 4]
    assert worker.jobs_skipped == 3  # and now 5 waits
    mapper.go.release(2)
    worker.finish()
    assert mapper.written == [0, 4, 5]


def test_what_a_stage_raises_in_its_thread_reaches_the_caller():
    class Broken(Slow):
        def add(self, keyframe):
            return self

        def solve(self):
            raise ZeroDivisionError("no parallax")

    worker = make(mapper=Broken)
    with pytest.raises(ZeroDivisionError, match="no parallax"):
        list(worker.run(Frame(n, 10_000_000 * n) for n in range(100_000)))
    worker.close()


# ---- frames ----


def test_frames_that_come_too_fast_are_dropped_and_counted(caplog):
    stop = threading.Event()

    def during(frame):
        time.sleep(0.01)
        if frame.id > 60:
            stop.set()

    worker = make(during, queue=2)
    with caplog.at_level(logging.WARNING):
        found = [frame.id for frame, _ in worker.run(endless(stop))]
    worker.finish()
    assert found == sorted(set(found))
    assert worker.frames_dropped > 0
    assert len(found) + worker.frames_dropped > 60
    assert "is dropped: tracking is slower than the source" in caplog.text
    assert len(caplog.records) == 1


def test_the_oldest_is_dropped():
    dropped = []
    feed = Feed((frame for frame in frames(0, 10)), 3, lambda frame: dropped.append(frame.id))
    feed.close()
    assert [frame.id for frame in feed.frames(threading.Event())] == [7, 8, 9]
    assert dropped == [0, 1, 2, 3, 4, 5, 6]


def test_a_source_slower_than_tracking_loses_nothing():
    def source():
        for frame in frames(0, 20):
            time.sleep(0.002)
            yield frame

    worker = make(queue=20)
    assert [frame.id for frame, _ in worker.run(source())] == list(range(20))
    worker.finish()
    assert worker.frames_dropped == 0


def test_a_recording_comes_at_the_pace_of_its_stamps():
    recording = [Frame(n, 20_000_000 * n) for n in range(11)]
    worker = make(queue=11)
    start = time.perf_counter()
    assert len(list(worker.run(recording))) == 11
    assert time.perf_counter() - start >= 0.2
    worker.finish()
    assert worker.frames_dropped == 0


def test_a_jump_of_the_clock_is_not_waited_for():
    recording = [Frame(0, 0), Frame(1, 10**15), Frame(2, 10**15 + 1000)]
    worker = make(queue=3)
    start = time.perf_counter()
    assert len(list(worker.run(recording))) == 3
    assert time.perf_counter() - start < 100.0  # it is a million seconds
    worker.finish()


def test_what_the_source_raises_comes_after_the_frames_before_it():
    def source():
        yield from frames(0, 3)
        raise OSError("unplugged")

    worker, found = make(queue=5), []
    with pytest.raises(OSError, match="unplugged"):
        found.extend(frame.id for frame, _ in worker.run(source()))
    worker.finish()


def test_a_source_is_closed_by_the_thread_that_reads_it():
    closed = []

    def source():
        try:
            yield from frames(0, 1000)
        finally:
            closed.append(threading.current_thread().name)

    worker = make()
    for _ in worker.run(source()):
        break
    worker.finish()
    assert closed == ["odomap source"]


# ---- Ctrl-C ----


def test_ctrl_c_ends_a_run_though_the_source_waits():
    stop = threading.Event()

    def source():
        yield from frames(0, 3)
        os.kill(os.getpid(), signal.SIGINT)
        stop.wait(0.5)  # a camera that has no frame just now
        yield Frame(9, 450)

    worker = make(queue=5)
    found = [frame.id for frame, _ in worker.run(source())]
    worker.finish()
    assert worker.interrupted
    assert found == list(range(len(found)))
    assert len(found) <= 3


@pytest.mark.parametrize("moment", ["tracking", "mapping"])
def test_ctrl_c_at_any_moment_ends_with_what_there_is(moment):
    pressed = []

    def press():
        if not pressed:
            pressed.append(os.kill(os.getpid(), signal.SIGINT))

    def during(frame):
        if moment == "tracking" and frame.id >= 5:
            press()

    class Job(SlowJob):
        def solve(self):
            if moment == "mapping" and self.keyframe_id >= 2:
                press()
            return super().solve()

    worker = make(during, Slow, queue=2)
    mapper = worker.stages.mapper
    mapper.go.release(10_000)
    mapper.add = lambda keyframe: Job(mapper, keyframe.id)
    stop = threading.Event()
    found = [frame.id for frame, _ in worker.run(endless(stop))]
    worker.finish()
    assert pressed
    assert worker.interrupted
    assert worker.stages.map.num_keyframes == len(found)
    assert mapper.written[-1] == len(found) - 1  # the newest keyframe is mapped in the end


# ---- observers ----


def test_observers_are_told_in_order_from_a_thread_of_their_own():
    worker, told, threads = make(), [], set()

    def tell(*message):
        told.append(message)
        threads.add(threading.current_thread().name)

    worker.on_estimate.append(lambda e: tell("estimate", e.frame_id))
    worker.on_keyframe.append(lambda k: tell("keyframe", k.id))
    worker.on_map.append(lambda s: tell("map", s.num_keyframes))
    list(worker.run(f for f in frames(0, 2)))
    worker.finish()
    assert told == [
        *[("estimate", 0), ("keyframe", 0), ("map", 1)],
        *[("estimate", 1), ("keyframe", 1), ("map", 2)],
    ]
    assert threads == {"odomap observers"}
    assert worker.messages_dropped == 0


def test_a_slow_observer_loses_messages_but_no_frame():
    worker, told, is_busy = make(messages=4), [], threading.Event()

    def slow(estimate):
        told.append(estimate.frame_id)
        assert is_busy.wait(30)

    worker.on_estimate.append(slow)
    for frame in frames(0, 100):
        worker.advance(frame)
    worker._take_back()
    assert worker.stages.map.num_keyframes == 100
    assert worker.messages_dropped >= 95
    is_busy.set()
    worker.finish()
    assert told[-1] == 99
    assert len(told) + worker.messages_dropped == 100


def test_an_observer_that_raises_is_detached():
    worker, told = make(), []

    def viewer(estimate):
        told.append(estimate.frame_id)
        raise RuntimeError("the window is gone")

    worker.on_estimate.append(viewer)
    worker.advance(Frame(0, 0))
    worker.finish()
    worker.advance(Frame(1, 50))
    worker.finish()
    assert told == [0]
    (failure,) = worker.failures
    assert str(failure.error) == "the window is gone"


def test_a_mailbox_drops_the_oldest():
    mailbox = Mailbox(2)
    assert [mailbox.put(n) for n in "abcd"] == [None, None, "a", "b"]
    assert not mailbox.is_over
    mailbox.end()
    assert [mailbox.take(0), mailbox.take(0), mailbox.take(0)] == ["c", "d", None]
    assert mailbox.is_over
    assert mailbox.clear() == 0


# ---- the odometry ----


def test_odometry_that_keeps_up_with_the_sensor_tracks_it_all(room):
    vo = StereoVO(room.rig, Config(threads=ThreadConfig(queue=len(room))), "live")
    estimates = [estimate for _, estimate in vo.worker.run(room)]
    result = vo.finish()
    assert len(estimates) == len(result.trajectory) == len(room)
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert ate(result.trajectory, room.truth).rmse < 0.02


def test_odometry_under_pressure_skips_windows_and_still_tracks(room):
    vo = StereoVO(room.rig, None, "live")
    add = vo.worker.stages.mapper.add

    class Late:
        def __init__(self, job):
            self.job = job

        def solve(self):
            time.sleep(0.2)
            return self.job.solve()

    vo.worker.stages.mapper.add = lambda k: Late(job) if (job := add(k)) is not None else None
    estimates = [vo.track(frame) for frame in room]
    result = vo.finish()
    assert vo.worker.jobs_skipped > 0
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert len(result.trajectory) == len(room)
