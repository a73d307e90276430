"""What a logbook notes of a run beside its estimates."""

import os
import time

import numpy as np
import pytest

from odomap.geometry.pose import SE3
from odomap.logbook import MEMORY_EVERY, Logbook, memory_mb, peak_memory_mb
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame


def estimate(k):
    pose = SE3.identity()
    return Estimate(k, 10**9 * k, Status.TRACKING, "", 0, pose, pose, np.eye(6))


def test_the_map_is_counted_with_every_frame():
    book, m = Logbook(25), Map()
    book.map = m
    for k in range(25):
        if k % 5 == 0:
            m.add_keyframe(Keyframe(m.new_keyframe_id(), k), np.eye(4))
        m.add_landmarks(0, np.zeros((3, 3)))
        if k == 20:
            m.cull_keyframes([1, 2])
        book.add(Frame(k, k), estimate(k), 0.01)
    growth = book.growth()
    kept = np.arange(25) // 5 + 1 - 2 * (np.arange(25) >= 20)
    np.testing.assert_array_equal(growth.keyframes, kept)
    np.testing.assert_array_equal(growth.landmarks, 3 * np.arange(1, 26))
    np.testing.assert_array_equal(growth.memory_frames, [0, MEMORY_EVERY, 2 * MEMORY_EVERY])
    assert ((growth.memory_mb > 20) & (growth.memory_mb <= peak_memory_mb())).all()


def test_without_a_map_memory_alone_is_noted():
    book = Logbook(1)
    book.add(Frame(0, 0), estimate(0), 0.01)
    growth = book.growth()
    assert len(growth.keyframes) == len(growth.landmarks) == 0
    assert len(growth.memory_mb) == 1


def test_memory_that_is_taken_is_seen():
    book = Logbook(1)
    book.add(Frame(0, 0), estimate(0), 0.01)
    taken = np.ones(8 << 20)
    numbers = book.numbers()["memory_mb"]
    assert numbers["end"] - numbers["start"] == pytest.approx(64, abs=8)
    assert numbers["peak"] == numbers["end"]
    del taken


def test_an_empty_logbook_tells_of_memory_too():
    noted = Logbook(0).numbers()["memory_mb"]
    assert noted["start"] == noted["end"] == noted["peak"] > 20


def test_memory_is_cheap_to_ask_for():
    start = time.perf_counter()
    for _ in range(200):
        memory_mb()
    assert (time.perf_counter() - start) / 200 < 1e-3


def test_where_the_system_says_nothing_the_most_is_told(monkeypatch):
    import builtins

    real = builtins.open

    def absent(file, *args, **kwargs):
        if os.fspath(file) == "/proc/self/statm":
            raise FileNotFoundError(file)
        return real(file, *args, **kwargs)

    monkeypatch.setattr(builtins, "open", absent)
    assert memory_mb() == peak_memory_mb()
