"""Lockstep: parallel, and yet every event in a fixed order, whatever the threads do."""

import os
import signal
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.background import Lane, QuickSwitching, ThreadConfig
from odomap.system.closing import LoopCloser
from odomap.system.config import Config
from odomap.system.lockstep import LockstepWorker
from odomap.system.loopsearch import ClosingConfig, LoopSearch
from odomap.system.odometry import StereoVO
from odomap.system.stages import Loop, Stages
from odomap.system.worker import InlineWorker
from stagedoubles import Solved

EVERY = 3


class Track:
    """Every third frame becomes a keyframe; where it stands depends on the map as it is now."""

    def __init__(self, map, log):
        self.map, self.log = map, log
        self.during = lambda frame: None
        self.wanted = None

    def prepare(self, frame):
        return frame

    def track(self, frame):
        T = np.eye(4)
        if self.map.num_keyframes:
            T = np.array(self.map.T_world_body(int(self.map.keyframe_ids[-1])))
        T[0, 3] += 1 / 3
        self.during(frame)
        self.log.append(("track", frame.id))
        self.wanted = (frame, T) if frame.id % EVERY == 0 else None
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
    """Moves a keyframe by what it read of the map; solving sleeps for as long as told."""

    def __init__(self, map, log, name, nap=lambda keyframe_id: 0.0, loops=()):
        self.map, self.log, self.name, self.nap, self.loops = map, log, name, nap, loops
        self.threads = set()

    def last(self):
        return None

    def add(self, keyframe):
        self.log.append((f"{self.name} reads", keyframe.id))
        if keyframe.id == 0:
            return None
        return LiftJob(self, self.map.snapshot([keyframe.id], [0]))


class LiftJob:
    def __init__(self, stage, snapshot):
        self.stage, self.snapshot = stage, snapshot

    def solve(self):
        k = int(self.snapshot.keyframe_ids[0])
        self.stage.threads.add(threading.current_thread())
        time.sleep(self.stage.nap(k))
        Ts = self.snapshot.Ts_world_body.copy()
        Ts[0, 2, 3] += 1 + 0.25 * Ts[0, 0, 3]
        solved = self.snapshot.solved(Ts, self.snapshot.points_world)
        return Written(self.stage, k, Solved((solved,), self.stage.loops))


class Written:
    def __init__(self, stage, keyframe_id, solved):
        self.stage, self.keyframe_id, self.solved = stage, keyframe_id, solved
        self.loops = solved.loops

    def write(self, map):
        self.stage.log.append((f"{self.stage.name} writes", self.keyframe_id))
        self.solved.write(map)


def make(
    mapping=1, closing=0, nap=lambda keyframe_id: 0.0, worker=LockstepWorker, loops=(), line=0
):
    m, log = Map(), []
    mapper = Lift(m, log, "mapper", nap)
    closer = Lift(m, log, "closer", lambda k: nap(k + 1000), loops)
    stages = Stages(m, Track(m, log), mapper, closer)
    config = ThreadConfig(mapping, closing, line)
    return (worker(stages) if worker is InlineWorker else worker(stages, config)), log


def frames(number):
    return [Frame(n, 50 * n) for n in range(number)]


def result(made, number=20):
    """Return all that a run says: the order of events, the live poses, the final map."""
    worker, log = made
    live = [e.T_world_body.matrix.tobytes() for _, e in worker.run(frames(number))]
    worker.finish()
    m = worker.stages.map
    return log, live, m.Ts_world_body(m.keyframe_ids).tobytes()


def test_a_change_is_written_exactly_d_frames_later():
    worker, log = make(mapping=2, closing=1)
    for frame in frames(10):
        worker.advance(frame)
    worker.finish()
    assert log == [
        *[("track", 0), ("mapper reads", 0), ("closer reads", 0), ("track", 1), ("track", 2)],
        *[("track", 3), ("mapper reads", 1), ("track", 4)],
        *[("mapper writes", 1), ("closer reads", 1), ("track", 5)],
        *[("closer writes", 1), ("track", 6), ("mapper reads", 2), ("track", 7)],
        *[("mapper writes", 2), ("closer reads", 2), ("track", 8)],
        *[("closer writes", 2), ("track", 9), ("mapper reads", 3)],
        *[("mapper writes", 3), ("closer reads", 3), ("closer writes", 3)],
    ]


def test_a_change_is_written_before_its_stage_reads_again():
    worker, log = make(mapping=100, closing=100)
    list(worker.run(frames(10)))
    worker.finish()
    of_mapper = [event for event in log if event[0].startswith("mapper")]
    assert of_mapper == [
        *[("mapper reads", 0), ("mapper reads", 1), ("mapper writes", 1)],
        *[("mapper reads", 2), ("mapper writes", 2), ("mapper reads", 3), ("mapper writes", 3)],
    ]
    assert log[-1] == ("closer writes", 3)


def test_keyframes_wait_in_line_for_a_closer_that_is_busy():
    worker, log = make(mapping=0, closing=5, line=1)
    list(worker.run(frames(15)))
    worker.finish()
    of_closer = [event for event in log if event[0].startswith(("closer", "track"))]
    assert of_closer == [
        *[("track", 0), ("closer reads", 0), ("track", 1), ("track", 2), ("track", 3)],
        *[("closer reads", 1), *(("track", n) for n in (4, 5, 6, 7))],  # the second one waits
        *[("closer writes", 1), ("closer reads", 2), ("track", 8), ("track", 9), ("track", 10)],
        *[("track", 11), ("track", 12)],  # the third one waits; with the fourth the line is full
        *[("closer writes", 2), ("closer reads", 3), ("track", 13), ("track", 14)],
        *[("closer writes", 3), ("closer reads", 4), ("closer writes", 4)],
    ]


@pytest.mark.parametrize("line", [1, 4])
def test_who_waits_in_line_does_not_depend_on_time(line):
    expected = result(make(1, 7, line=line), 40)
    random = np.random.default_rng(line)
    naps = random.uniform(0, 0.01, 2000) * (random.uniform(size=2000) < 0.5)
    assert result(make(1, 7, lambda k: naps[k], line=line), 40) == expected
    kept, _ = make(1, 7, line=line)
    list(kept.run(frames(8)))
    kept.close()
    kept.finish()  # what was in line is lost, and nothing waits for it


def test_without_delay_it_is_inline_byte_for_byte():
    assert result(make(0, 0)) == result(make(worker=InlineWorker))


def test_a_delay_of_one_frame_gives_every_frame_the_map_it_would_see_inline():
    _, live, final = result(make(1, 0))
    _, inline_live, inline_final = result(make(worker=InlineWorker))
    assert (live, final) == (inline_live, inline_final)


class Sure:
    """A mapper that says how sure a keyframe is: k + 1 in all directions; slow where told."""

    def __init__(self, map, nap):
        self.map, self.nap = map, nap

    def add(self, keyframe):
        return Saying(self, keyframe.id)


class Saying:
    loops = ()

    def __init__(self, stage, keyframe_id):
        self.stage, self.keyframe_id = stage, keyframe_id

    def solve(self):
        time.sleep(self.stage.nap)
        return self

    def write(self, map):
        map.set_covariance([self.keyframe_id], (self.keyframe_id + 1.0) * np.eye(6))


@pytest.mark.parametrize("delays", [None, (0, 0), (1, 20), (2, 5), (7, 20)])
def test_the_closer_writes_down_what_the_mapper_is_done_with(delays):
    m = Map()
    search = LoopSearch(SimpleNamespace(num_words=1), ClosingConfig())
    closer = LoopCloser(m, search, SimpleNamespace(read=None), False, ClosingConfig())
    stages = Stages(m, Track(m, []), Sure(m, 0.002), closer)
    worker = InlineWorker(stages)
    if delays is not None:
        worker = LockstepWorker(stages, ThreadConfig(*delays))
    list(worker.run(frames(30)))
    worker.finish()
    assert search.known.keyframe_ids.tolist() == list(range(10))
    growths = m.states.growths[1:10]
    assert np.isfinite(growths).all()  # NaN until it is mapped
    np.testing.assert_allclose(growths[:, 3:, 3:], np.tile(np.eye(3), (9, 1, 1)))


@pytest.mark.parametrize(("mapping", "closing"), [(1, 1), (2, 0), (2, 5), (7, 20)])
def test_the_result_does_not_know_how_long_a_thread_took(mapping, closing):
    expected = result(make(mapping, closing))
    for seed in range(5):
        random = np.random.default_rng(seed)
        naps = random.uniform(0, 0.01, 2000) * (random.uniform(size=2000) < 0.5)
        assert result(make(mapping, closing, lambda k, naps=naps: naps[k])) == expected


def test_delays_change_the_result_since_frames_see_another_map():
    assert result(make(1, 0))[1] != result(make(2, 0))[1]


def test_jobs_are_solved_in_threads_that_finish_ends():
    before = set(threading.enumerate())
    worker, _ = make(2, 2)
    list(worker.run(frames(10)))
    lanes = worker.stages.mapper, worker.stages.closer
    mapping, closing = (stage.threads for stage in lanes)
    worker.finish()
    assert len(mapping) == len(closing) == 1
    assert threading.main_thread() not in mapping | closing
    assert mapping.isdisjoint(closing)
    assert set(threading.enumerate()) == before
    list(worker.run([Frame(n, 50 * n) for n in range(10, 15)]))  # and one may go on
    assert len(mapping) == 2
    worker.finish()
    assert set(threading.enumerate()) == before
    worker.finish()


def test_what_a_stage_raises_in_its_thread_reaches_the_caller():
    def nap(keyframe_id):
        if keyframe_id == 2:
            raise ZeroDivisionError("no parallax")
        return 0.0

    before = set(threading.enumerate())
    worker, log = make(2, 0, nap)
    with pytest.raises(ZeroDivisionError, match="no parallax"):
        list(worker.run(frames(20)))
    assert log[-1] == ("track", 7)  # told when the change was due
    worker.finish()  # and only once
    assert set(threading.enumerate()) == before


def test_an_error_that_nobody_was_told_of_is_raised_by_finish():
    def nap(keyframe_id):
        raise ZeroDivisionError("no parallax")

    before = set(threading.enumerate())
    worker, _ = make(2, 0, nap)
    list(worker.run(frames(4)))
    with pytest.raises(ZeroDivisionError):
        worker.finish()
    assert set(threading.enumerate()) == before
    worker.finish()


def test_ctrl_c_while_a_job_is_waited_for_ends_after_the_frame():
    def nap(keyframe_id):
        if keyframe_id == 1:
            time.sleep(0.2)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)
        return 0.0

    worker, log = make(1, 0, nap)
    found = [frame.id for frame, _ in worker.run(frames(20))]
    worker.finish()
    assert worker.interrupted
    assert found == [0, 1, 2, 3, 4]
    assert ("mapper writes", 1) in log


def test_a_second_ctrl_c_stops_the_wait_and_loses_no_job():
    before = set(threading.enumerate()), signal.getsignal(signal.SIGINT)

    def nap(keyframe_id):
        if keyframe_id == 1:
            for _ in range(2):
                time.sleep(0.2)
                os.kill(os.getpid(), signal.SIGINT)
        return 0.2 if keyframe_id == 1 else 0.0

    worker, log = make(1, 0, nap)
    with pytest.raises(KeyboardInterrupt):
        list(worker.run(frames(20)))
    assert ("mapper writes", 1) not in log
    worker.finish()
    assert ("mapper writes", 1) in log
    assert (set(threading.enumerate()), signal.getsignal(signal.SIGINT)) == before


def test_close_ends_the_threads_and_writes_nothing():
    before = set(threading.enumerate()), sys.getswitchinterval()
    worker, log = make(3, 0)
    list(worker.run(frames(4)))
    worker.close()
    assert (set(threading.enumerate()), sys.getswitchinterval()) == before
    assert ("mapper writes", 1) not in log


def test_threads_take_turns_quickly_while_there_are_any():
    before = sys.getswitchinterval()
    (one, _), (other, _) = make(2, 0), make(2, 0)
    list(one.run(frames(4)))
    list(other.run(frames(4)))
    assert sys.getswitchinterval() == pytest.approx(QuickSwitching.INTERVAL_S)
    one.finish()
    assert sys.getswitchinterval() == pytest.approx(QuickSwitching.INTERVAL_S)
    other.finish()
    other.finish()
    assert sys.getswitchinterval() == before


def test_observers_and_timing_are_those_of_the_frame_that_waited():
    loop = Loop(1, 0, np.eye(4), 3, False, "3 inliers of 15 needed")
    worker, _ = make(1, 1, lambda k: 0.4 if k < 1000 else 0.0, loops=(loop,))
    told = []
    worker.on_estimate.append(lambda e: told.append(("estimate", e.frame_id)))
    worker.on_keyframe.append(lambda k: told.append(("keyframe", k.id)))
    worker.on_loop.append(lambda x: told.append(("loop", x.reason)))
    worker.on_map.append(lambda s: told.append(("map", s.num_keyframes, s.epoch)))
    estimates = [e for _, e in worker.run(frames(6))]
    worker.finish()
    assert told == [
        *[("estimate", 0), ("keyframe", 0), ("map", 1, 0), ("estimate", 1), ("estimate", 2)],
        *[("estimate", 3), ("keyframe", 1), ("map", 2, 1), ("estimate", 4)],
        *[("loop", loop.reason), ("map", 2, 2), ("estimate", 5)],
    ]
    assert estimates[4].timing["wait"] > 100 > estimates[3].timing["wait"]
    assert [len(worker.beside_ms[n]) for n in ("keyframe", "map reads", "map solves")] == [2, 2, 1]
    assert worker.beside_ms["map solves"][0] > 390


def test_a_lane_has_one_job_out():
    m, log = Map(), []
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 0), np.eye(4))
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 1), np.eye(4))
    lane = Lane("map", Lift(m, log, "mapper"))
    assert not lane.start(m.keyframe(0))
    assert not lane.is_out
    assert lane.start(m.keyframe(1))
    assert lane.is_out
    assert lane.collect()[0].id == 1
    assert not lane.is_out
    lane.close()


def test_impossible_delays_are_refused():
    with pytest.raises(ConfigError, match="mapping_delay: -1 must be at least 0"):
        ThreadConfig(mapping_delay=-1)


# ---- the odometry ----


def path_of(room, rhythm, delay, nap=None):
    config = Config(threads=ThreadConfig(mapping_delay=delay))
    vo = StereoVO(room.rig, config, rhythm)
    if nap is not None:
        add = vo.worker.stages.mapper.add

        def slow(keyframe):
            job = add(keyframe)
            return None if job is None else Sleeping(job, nap)

        vo.worker.stages.mapper.add = slow
    for frame in room:
        vo.track(frame)
    found = vo.finish()
    parts = found.trajectory, found.trajectory_live
    return b"".join(p.Ts_world_body.tobytes() + p.covariances.tobytes() for p in parts)


class Sleeping:
    def __init__(self, job, nap):
        self.job, self.nap = job, nap

    def solve(self):
        time.sleep(next(self.nap))
        return self.job.solve()


def test_odometry_is_that_of_inline_with_a_delay_of_one(room):
    inline = path_of(room, "inline", 0)
    assert path_of(room, "lockstep", 0) == inline
    assert path_of(room, "lockstep", 1) == inline


def test_odometry_is_the_same_whatever_its_threads_do(room):
    expected = path_of(room, "lockstep", 2)
    naps = iter(np.random.default_rng(1).uniform(0, 0.04, 100))
    assert path_of(room, "lockstep", 2, naps) == expected
    assert expected != path_of(room, "inline", 0)
