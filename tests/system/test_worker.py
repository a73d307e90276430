"""The worker with stages made of sticks: order, observers, interrupts, rhythms."""

import logging
import os
import signal
import threading
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.rhythms import RHYTHMS, make_worker
from odomap.system.stages import Loop, Stages
from odomap.system.worker import InlineWorker, Worker, deferred_interrupt
from stagedoubles import Solved


class Track:
    """Every third frame becomes a keyframe one metre further."""

    def __init__(self, map, log, during=None):
        self.map, self.log, self.during = map, log, during
        self.wanted = None

    def prepare(self, frame):
        return frame

    def track(self, frame):
        self.log.append(("track", frame.id))
        T = np.eye(4)
        T[0, 3] = frame.id
        self.wanted = (frame, T) if frame.id % 3 == 0 else None
        if self.during is not None:
            self.during(frame)
        self.log.append(("tracked", frame.id))
        return Estimate(
            frame_id=frame.id,
            stamp_ns=frame.stamp_ns,
            status=Status.TRACKING,
            reason="",
            keyframe_id=int(max(self.map.keyframe_ids, default=-1)),
            T_keyframe_body=SE3.identity(),
            T_world_body=SE3(T),
            covariance=np.eye(6),
            is_keyframe=self.wanted is not None,
        )

    def make_keyframe(self):
        if self.wanted is None:
            return None
        (frame, T), self.wanted = self.wanted, None
        k = self.map.new_keyframe_id()
        self.map.add_keyframe(Keyframe(k, frame.stamp_ns), T)
        return self.map.keyframe(k)


class Lift:
    """Mapper or closer that lifts every keyframe but the first by one metre."""

    def __init__(self, map, log, name, loops=()):
        self.map, self.log, self.name, self.loops = map, log, name, loops

    def last(self):
        return None

    def add(self, keyframe):
        self.log.append((f"{self.name} reads", keyframe.id))
        if keyframe.id == 0:
            return None
        self.snapshot = self.map.snapshot([keyframe.id], [0])
        return self

    def solve(self):
        self.log.append((f"{self.name} solves", int(self.snapshot.keyframe_ids[0])))
        Ts = self.snapshot.Ts_world_body.copy()
        Ts[0, 2, 3] += 1
        return Solved((self.snapshot.solved(Ts, self.snapshot.points_world),), self.loops)


def make(during=None, loops=()):
    m, log = Map(), []
    stages = Stages(m, Track(m, log, during), Lift(m, log, "mapper"), Lift(m, log, "closer", loops))
    return make_worker("inline", stages), log


def frames(number):
    return [Frame(n, 50 * n) for n in range(number)]


def press_ctrl_c():
    os.kill(os.getpid(), signal.SIGINT)


def test_inline_runs_each_stage_in_turn():
    worker, log = make()
    estimates = list(worker.run(frames(5)))
    worker.finish()
    assert [(f.id, e.frame_id) for f, e in estimates] == [(n, n) for n in range(5)]
    assert log == [
        *[("track", 0), ("tracked", 0), ("mapper reads", 0), ("closer reads", 0)],
        *[("track", 1), ("tracked", 1), ("track", 2), ("tracked", 2), ("track", 3), ("tracked", 3)],
        *[("mapper reads", 1), ("mapper solves", 1), ("closer reads", 1), ("closer solves", 1)],
        *[("track", 4), ("tracked", 4)],
    ]
    np.testing.assert_array_equal(worker.stages.map.T_world_body(1)[:3, 3], [3, 0, 2])


def test_a_tracker_alone_is_a_run():
    m = Map()
    worker = InlineWorker(Stages(m, Track(m, [])))
    assert len(list(worker.run(frames(7)))) == 7
    assert m.keyframe_ids.tolist() == [0, 1, 2]


def test_observers_are_told_in_order():
    loop = Loop(1, 0, np.eye(4), 3, False, "3 inliers of 15 needed")
    worker, _ = make(loops=(loop,))
    told = []
    worker.on_estimate.append(lambda e: told.append(("estimate", e.frame_id)))
    worker.on_keyframe.append(lambda k: told.append(("keyframe", k.id)))
    worker.on_loop.append(lambda x: told.append(("loop", x.reason)))
    worker.on_map.append(lambda s: told.append(("map", s.num_keyframes, s.epoch)))
    list(worker.run(frames(5)))
    worker.finish()
    assert told == [
        *[("estimate", 0), ("keyframe", 0), ("map", 1, 0)],
        *[("estimate", 1), ("estimate", 2)],
        *[("estimate", 3), ("keyframe", 1), ("loop", loop.reason), ("map", 2, 2)],
        ("estimate", 4),
    ]


def test_observers_get_values_that_cannot_be_changed():
    worker, _ = make(loops=(Loop(1, 0, np.eye(4), 3, True),))
    seen = []
    for event in ("on_estimate", "on_keyframe", "on_loop", "on_map"):
        getattr(worker, event).append(seen.append)
    list(worker.run(frames(4)))
    assert {type(v).__name__ for v in seen} == {"Estimate", "Keyframe", "Loop", "MapState"}
    for value in seen:
        with pytest.raises(FrozenInstanceError):
            setattr(value, next(iter(vars(value))), None)


def test_an_observer_that_raises_is_detached_and_reported(caplog):
    worker, _ = make()
    calls, told = [], []

    def viewer(estimate):
        calls.append(estimate.frame_id)
        if estimate.frame_id == 1:
            raise RuntimeError("the window is gone")

    worker.on_estimate += [viewer, lambda e: told.append(e.frame_id)]
    with caplog.at_level(logging.ERROR):
        list(worker.run(frames(5)))
    assert calls == [0, 1]
    assert told == [0, 1, 2, 3, 4]
    (failure,) = worker.failures
    assert failure.event == "on_estimate"
    assert "viewer" in failure.observer
    assert str(failure.error) == "the window is gone"
    assert "the window is gone" in caplog.text


def test_an_observer_may_detach_itself():
    worker, _ = make()
    calls = []

    def once(estimate):
        calls.append(estimate.frame_id)
        worker.on_estimate.remove(once)

    worker.on_estimate.append(once)
    list(worker.run(frames(3)))
    assert calls == [0]
    assert not worker.failures


def test_a_stage_that_raises_ends_the_run():
    def during(frame):
        if frame.id == 2:
            raise ValueError("broken")

    worker, _ = make(during)
    with pytest.raises(ValueError, match="broken"):
        list(worker.run(frames(5)))
    worker.finish()
    assert not worker.failures


def test_ctrl_c_lets_the_frame_finish_and_ends_the_run():
    before = signal.getsignal(signal.SIGINT)
    worker, log = make(lambda frame: press_ctrl_c() if frame.id == 3 else None)
    estimates = list(worker.run(frames(9)))
    worker.finish()
    assert [e.frame_id for _, e in estimates] == [0, 1, 2, 3]
    assert worker.interrupted
    assert log[-1] == ("closer solves", 1)  # mapping and closing of the keyframe are done as well
    assert signal.getsignal(signal.SIGINT) is before
    worker.stages.tracker.during = None
    assert len(list(worker.run(frames(2)))) == 2  # and one may go on
    assert not worker.interrupted


def test_ctrl_c_while_a_frame_is_read_ends_the_run():
    def source():
        yield from frames(2)
        press_ctrl_c()
        yield from frames(9)

    worker, _ = make()
    assert len(list(worker.run(source()))) == 2
    assert worker.interrupted


def test_a_second_ctrl_c_interrupts_at_once():
    before = signal.getsignal(signal.SIGINT)

    def twice(frame):
        press_ctrl_c()
        press_ctrl_c()

    worker, log = make(twice)
    with pytest.raises(KeyboardInterrupt):
        list(worker.run(frames(3)))
    worker.finish()
    assert log == [("track", 0)]
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_in_a_single_frame_is_raised_after_it():
    worker, log = make(lambda frame: press_ctrl_c())
    with pytest.raises(KeyboardInterrupt):
        worker.track(Frame(0, 0))
    worker.finish()
    assert log[-1] == ("closer reads", 0)


def test_outside_the_main_thread_signals_are_left_alone():
    seen = []

    def body():
        with deferred_interrupt() as interrupt:
            seen.append(interrupt.is_set())

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert seen == [False]


@pytest.mark.parametrize("rhythm", ["inlin", ""])
def test_a_rhythm_that_is_not_there_is_refused_by_name(rhythm):
    with pytest.raises(ConfigError, match=r"rhythm.*inline, lockstep, live"):
        make_worker(rhythm, Stages(Map(), Track(Map(), [])))


def test_rhythms_are_workers():
    assert list(RHYTHMS) == ["inline", "lockstep", "live"]
    assert isinstance(make()[0], Worker)


@pytest.mark.parametrize("rhythm", RHYTHMS)
def test_what_the_last_keyframe_points_at_is_decided_at_the_end(rhythm):
    """A closer reads what it decides on a keyframe later: the last one has none after it."""

    class Late(Lift):
        def last(self):
            self.log.append(("closer ends", 0))
            self.snapshot = self.map.snapshot([1], [0])
            return self

    m, log, told = Map(), [], []
    loop = Loop(1, 0, np.eye(4), 3, False, "3 inliers of 15 needed")
    worker = make_worker(rhythm, Stages(m, Track(m, log), None, Late(m, log, "closer", (loop,))))
    worker.on_loop.append(told.append)
    for frame in frames(5):
        worker.track(frame)
    assert ("closer ends", 0) not in log
    worker.finish()
    assert log.count(("closer ends", 0)) == 1
    assert told == [loop, loop]
