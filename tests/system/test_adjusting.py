"""The map adjusted aside: begun where a loop was closed, written part by part, given up in time."""

import os
import signal
import threading
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.maps.map import Map
from odomap.system.adjusting import AdjustingConfig
from odomap.system.background import ThreadConfig
from odomap.system.live import LiveWorker
from odomap.system.lockstep import LockstepWorker
from odomap.system.stages import Loop, Stages
from odomap.system.worker import InlineWorker
from stagedoubles import Solved
from system.test_lockstep import Lift, Track, frames


@dataclass(frozen=True)
class Part:
    """Lifts the first keyframe, a part of the map."""

    log: list
    name: tuple
    loops: tuple = ()

    def write(self, map):
        self.log.append(("adjuster writes", *self.name))
        snapshot = map.snapshot([0], [])
        Ts = np.array(snapshot.Ts_world_body)
        Ts[0, 1, 3] += 1
        map.apply(replace(snapshot.solved(Ts, snapshot.points_world), anchor_id=1))


@dataclass(frozen=True)
class Parts:
    cut: tuple
    loops: tuple = ()

    def parts(self):
        return self.cut

    def write(self, map):
        for part in self.cut:
            part.write(map)


class Adjust:
    """Three parts for every job; solving takes as long as told, or until it is stopped."""

    def __init__(self, log, size=40, lasts=lambda keyframe_id: 0.0):
        self.log, self.size, self.lasts = log, size, lasts
        self.stopped, self.due = [], None

    def add(self, keyframe, has_closed):
        if not has_closed:
            return None
        self.log.append(("adjuster begins", keyframe.id))
        return AdjustJob(self, keyframe.id)

    def end(self):
        k, self.due = self.due, None
        return None if k is None else AdjustJob(self, k)


class AdjustJob:
    def __init__(self, stage, k):
        self.stage, self.k, self.size = stage, k, 0

    def read(self):
        self.size = self.stage.size

    def solve(self, stop=None):
        end = time.monotonic() + self.stage.lasts(self.k)
        while time.monotonic() < end:
            if stop is not None and stop.is_set():
                self.stage.stopped.append(self.k)
                return Parts(())
            time.sleep(0.001)
        return Parts(tuple(Part(self.stage.log, (self.k, n)) for n in range(3)))


class Close(Lift):
    """Closes a loop at some keyframes, at others finds what it does not believe."""

    def __init__(self, map, log, at):
        super().__init__(map, log, "closer")
        self.at, self.loops_of = at, {}

    def add(self, keyframe):
        job = super().add(keyframe)
        self.loops = (Loop(keyframe.id, 0, np.eye(4), 9, keyframe.id in self.at),)
        return None if job is None else CloseJob(job, self.loops)


class CloseJob:
    def __init__(self, job, loops):
        self.job, self.loops = job, loops

    def solve(self):
        change = self.job.solve()
        solved = Solved(change.solved.updates, self.loops)
        return type(change)(change.stage, change.keyframe_id, solved)


def make(at=(1,), worker=LockstepWorker, size=40, lasts=lambda k: 0.0, pace=10, closing=1):
    m, log = Map(), []
    adjuster = Adjust(log, size, lasts)
    stages = Stages(m, Track(m, log), None, Close(m, log, at), adjuster)
    config = ThreadConfig(closing_delay=closing, adjusting_pace=pace)
    return (worker(stages) if worker is InlineWorker else worker(stages, config)), log


def events(log):
    return [e for e in log if e[0] == "track" or e[0].startswith("adjuster")]


def track(*ids):
    return [("track", n) for n in ids]


def written(k, *parts):
    return [("adjuster writes", k, n) for n in parts]


def test_inline_the_map_is_adjusted_at_once_and_only_after_a_loop():
    worker, log = make(at=(1, 3), worker=InlineWorker)
    list(worker.run(frames(10)))
    worker.finish()
    assert events(log) == [
        *track(0, 1, 2, 3),
        ("adjuster begins", 1),
        *written(1, 0, 1, 2),
        *track(4, 5, 6, 7, 8, 9),
        ("adjuster begins", 3),
        *written(3, 0, 1, 2),
    ]


def test_in_lockstep_it_is_written_as_many_frames_later_as_it_is_large_part_by_part():
    worker, log = make(size=35)
    for frame in frames(13):
        worker.advance(frame)
    worker.finish()
    assert events(log) == [
        *track(0, 1, 2, 3),
        ("adjuster begins", 1),  # before frame 4, as the loop is due
        *track(4, 5, 6, 7),
        *[*written(1, 0), *track(8), *written(1, 1), *track(9), *written(1, 2)],
        *track(10, 11, 12),
    ]


def test_it_is_never_due_before_a_loop_would_be():
    worker, log = make(size=1, closing=3)
    for frame in frames(12):
        worker.advance(frame)
    worker.finish()
    order = events(log)
    begun, first = order.index(("adjuster begins", 1)), order.index(("adjuster writes", 1, 0))
    assert sum(e[0] == "track" for e in order[begun:first]) == 3


def test_without_a_pace_it_is_inline():
    made = []
    for worker in (LockstepWorker, InlineWorker):
        run, log = make(at=(1, 3), worker=worker, pace=0, closing=0)
        list(run.run(frames(12)))
        run.finish()
        m = run.stages.map
        made.append((log, m.Ts_world_body(m.keyframe_ids).tobytes()))
    assert made[0] == made[1]


@pytest.mark.parametrize("size", [60, 15])
def test_another_loop_gives_it_up(size):
    """Whether it is being solved, or half of it is written."""
    worker, log = make(at=(1, 2), size=size, lasts=lambda k: 0.02)
    for frame in frames(20):
        worker.advance(frame)
    worker.finish()
    of_first = [e for e in log if e[:2] == ("adjuster writes", 1)]
    assert of_first == ([] if size == 60 else written(1, 0))
    assert [e for e in log if e[:2] == ("adjuster writes", 2)] == written(2, 0, 1, 2)


@pytest.mark.parametrize("seed", range(4))
def test_the_result_does_not_know_how_long_it_took(seed):
    def result(lasts):
        worker, log = make(at=(1, 2, 5), size=45, lasts=lasts)
        live = [e.T_world_body.matrix.tobytes() for _, e in worker.run(frames(24))]
        worker.finish()
        m = worker.stages.map
        return log, live, m.Ts_world_body(m.keyframe_ids).tobytes()

    naps = np.random.default_rng(seed).uniform(0.0, 0.02, 30)
    assert result(lambda k: naps[k]) == result(lambda k: 0.0)


def test_what_is_given_up_ends_soon():
    worker, log = make(at=(1, 2), size=10_000, lasts=lambda k: 60.0 if k == 1 else 0.0)
    start = time.monotonic()
    for frame in frames(10):
        worker.advance(frame)
    worker.finish()
    assert time.monotonic() - start < 30.0
    assert worker.stages.adjuster.stopped == [1]
    assert events(log)[-3:] == written(2, 0, 1, 2)  # one that is due in the end is completed


def test_close_waits_for_nothing():
    worker, _ = make(size=10_000, lasts=lambda k: 60.0)
    start = time.monotonic()
    for frame in frames(6):
        worker.advance(frame)
    worker.close()
    assert time.monotonic() - start < 30.0
    assert worker.stages.adjuster.stopped == [1]
    assert not [t for t in threading.enumerate() if t.name.startswith("odomap")]


@pytest.mark.parametrize("when", ["while tracking", "at the end"])
def test_ctrl_c_gives_it_up(when):
    worker, log = make(size=10_000, lasts=lambda k: 60.0)
    start = time.monotonic()
    for frame, _ in worker.run(frames(10)):
        if when == "while tracking" and frame.id == 6:
            os.kill(os.getpid(), signal.SIGINT)
    assert worker.interrupted == (when == "while tracking")
    if when == "at the end":
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    worker.finish()
    assert time.monotonic() - start < 30.0
    assert worker.stages.adjuster.stopped == [1]
    assert not [e for e in log if e[0] == "adjuster writes"]


def test_ctrl_c_while_it_is_completed_is_told_to_whoever_runs_it():
    worker, _ = make(size=10_000, lasts=lambda k: 60.0)
    interrupt = threading.Event()
    for frame in worker.frames(frames(10), interrupt):
        worker.advance(frame)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    worker.finish()
    assert interrupt.is_set()


def test_what_the_adjuster_raises_is_raised():
    worker, _ = make(lasts=lambda k: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        list(worker.run(frames(20)))
    worker.close()


def test_live_it_is_written_when_it_is_solved():
    worker, log = make(worker=LiveWorker, lasts=lambda k: 0.05)
    for frame in frames(8):
        worker.advance(frame)
        time.sleep(0.02)
    worker.finish()
    assert [e for e in log if e[0] == "adjuster writes"] == written(1, 0, 1, 2)
    assert worker.beside_ms["adjust solves"][0] >= 50
    assert not [t for t in threading.enumerate() if t.name.startswith("odomap")]


@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"tolerance": -1.0}, {"tolerance": np.nan}])
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        AdjustingConfig(**wrong)


@pytest.mark.parametrize("worker", [InlineWorker, LockstepWorker, LiveWorker])
def test_what_is_due_at_the_end_is_done(worker):
    run, log = make(at=(), worker=worker)
    for frame in frames(8):
        run.advance(frame)
    run.stages.adjuster.due = 2
    run.finish()
    assert log[-3:] == written(2, 0, 1, 2)
    assert not [t for t in threading.enumerate() if t.name.startswith("odomap")]
