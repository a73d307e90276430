"""Columns that grow and are copied bit by bit: nothing is lost, and a copy is of one moment."""

import hashlib
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from mapworlds import Walk, rich_map, same_map
from odomap.maps import column as columns
from odomap.maps import copying
from odomap.maps import map as maps
from odomap.maps.column import Column
from odomap.maps.map import Map


@pytest.fixture
def small_steps(monkeypatch):
    """So small that a handful of rows takes many of them."""
    monkeypatch.setattr(copying, "STEP", 200)
    monkeypatch.setattr(columns, "LEAST", 1)


@pytest.mark.parametrize("seed", range(20))
def test_a_column_is_an_array_whatever_is_in_the_making(monkeypatch, seed):
    monkeypatch.setattr(columns, "LEAST", 1)
    rng = np.random.default_rng(seed)
    column, model, copies = Column.empty(np.int32, 2), np.zeros((0, 2), np.int32), []
    was_in_the_making = 0
    for _ in range(400):
        action = rng.integers(6)
        rows = rng.integers(0, len(model), 5) if len(model) else np.zeros(0, np.int64)
        if action == 0:
            fresh = int(rng.integers(1, 9)) if rng.random() < 0.95 else 300
            column.reserve(len(model) + fresh)
            model = np.vstack([model, np.zeros((fresh, 2), np.int32)])
        elif action == 1:
            rows = np.unique(rows)
            column[rows] = model[rows] = rng.integers(0, 99, (len(rows), 2))
        elif action == 2:
            column.add(rows, 1)
            np.add.at(model, rows, 1)
        elif action == 3 and len(copies) < 3:
            copies.append(column.begin_copy())
        elif action == 4:
            for copy in copies:
                column.go_on(copy, int(rng.integers(0, 500)))
        elif action == 5 and copies and rng.random() < 0.3:
            copy = copies.pop(int(rng.integers(len(copies))))
            column.go_on(copy, column.left(copy))
            assert column.left(copy) == 0
            ended = column.end_copy(copy)
            np.testing.assert_array_equal(ended[:], model)
            column[:1] = model[:1] = 7  # the copy does not follow any more
            assert not len(model) or ended.values is not column.values
        was_in_the_making += bool(copies)
        assert column.is_followed == bool(copies)
        assert len(column) == len(model)
        np.testing.assert_array_equal(column[: len(model)], model)
        np.testing.assert_array_equal(column.take(rows), model[rows])
    assert was_in_the_making > 50


def test_an_append_never_moves_many_rows(monkeypatch):
    moved = []
    take_over = columns.Copy.take_over

    def counted(self, source, end, rows):
        before = self.moved
        take_over(self, source, end, rows)
        moved.append(self.moved - before)

    monkeypatch.setattr(columns.Copy, "take_over", counted)
    column = Column.empty(np.int64)
    for rows in range(100, 200_000, 100):
        column.reserve(rows)
    assert max(moved) == 100 * columns.PACE + columns.LEAST
    assert sum(moved) < 2 * 200_000
    assert len(column.values) < 4 * 200_000


@pytest.mark.parametrize("seed", range(8))
def test_a_dump_is_of_its_last_moment_whatever_happens_meanwhile(monkeypatch, small_steps, seed):
    walk, pauses, busy = Walk(seed), [], []
    walk.go(30)

    def others(_):
        if busy:  # culling pauses, too
            return
        pauses.append(walk.map.version)
        if len(pauses) < 60:
            busy.append(True)
            walk.go(1)
            busy.clear()

    monkeypatch.setattr(maps, "time", SimpleNamespace(sleep=others))
    tables = walk.map.dump()
    assert len(pauses) > 10
    assert pauses[-1] > pauses[0]
    monkeypatch.undo()
    same_map(Map.restored(tables), walk.map)
    walk.go(10)
    walk.agrees_with_the_model()
    walk.both_views_tell_the_same()


def test_a_dump_that_fails_leaves_nothing_behind(monkeypatch, small_steps):
    m = rich_map()

    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(maps, "time", SimpleNamespace(sleep=interrupted))
    with pytest.raises(KeyboardInterrupt):
        m.dump()
    assert not any_followed(m)
    begin = Column.begin_copy

    def without_memory(column):
        if column.values.ndim == 2:
            raise MemoryError
        return begin(column)

    monkeypatch.setattr(Column, "begin_copy", without_memory)
    with pytest.raises(MemoryError):
        m.dump()
    assert not any_followed(m)


def any_followed(m):
    return any(c.is_followed for c in (*m._landmarks.columns(), *m._observations.columns()))


def digest(m):
    content = hashlib.sha256()
    for name, array in sorted(m.dump().columns.items()):
        content.update(name.encode() + array.tobytes())
    return content.hexdigest()


def test_dumps_beside_a_thread_that_changes_the_map(small_steps):
    walk, known, errors = Walk(3), {}, []
    walk.go(20)

    def change():
        try:
            for _ in range(150):
                with walk.map.lock:
                    walk.go(1)
                    known[walk.map.version] = digest(walk.map)
        except BaseException as error:
            errors.append(error)

    known[walk.map.version] = digest(walk.map)
    thread, dumps = threading.Thread(target=change), []
    thread.start()
    while thread.is_alive():
        dumps.append(walk.map.dump())
    thread.join()
    assert not errors
    assert len({tables.version for tables in dumps}) > 2
    for tables in dumps:
        assert digest(Map.restored(tables)) == known[tables.version]


def test_a_large_snapshot_is_cut_from_a_copy(monkeypatch):
    m = rich_map(keyframes=12)
    ids = m.keyframe_ids
    whole = m.snapshot(ids[2:], ids[:2])
    monkeypatch.setattr(maps, "LARGE", 5)
    copied = m.snapshot(ids[2:], ids[:2])
    for name, value in vars(whole).items():
        other = getattr(copied, name)
        if isinstance(value, np.ndarray):
            assert value.dtype == other.dtype, name
            np.testing.assert_array_equal(value, other)
        else:
            assert value == other, name
    assert all(a is b for a, b in zip(whole.keyframes, copied.keyframes, strict=True))


def test_dead_ids_are_cut_off_and_the_oldest_stays():
    m = rich_map()
    keep = m.add_landmarks(4, np.ones((1, 3)))
    for n in range(60):
        ids = m.add_landmarks(4, np.full((100, 3), float(n)))
        m.fuse_landmarks(ids[:1], ids[1:2])
        m.remove_landmarks(ids[1:])
    m.remove_landmarks(m.landmark_ids[m.landmark_ids < keep[0]])
    assert m.resolve(keep).tolist() == keep.tolist()
    m.remove_landmarks(keep)
    for n in range(60):
        ids = m.add_landmarks(4, np.full((100, 3), float(n)))
        m.remove_landmarks(ids[:-1])
        m.remove_landmarks(m.landmark_ids[:-1])
    assert len(m._landmarks._entry.values) < 6000
    np.testing.assert_array_equal(m.landmark_ids, ids[-1:])
    np.testing.assert_allclose(
        m.points_world(ids[-1:]),
        m.place(4, np.eye(4))[None, :3, 3]
        + m.scale(4) * (m.T_world_body(4)[:3, :3] @ np.full(3, 59.0)),
    )
    assert m.is_alive(ids).tolist() == [False] * 99 + [True]
    same_map(m, Map.restored(m.dump()))
