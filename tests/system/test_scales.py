"""A single camera goes on after its keyframes have got scales of their own, as a loop gives them.

Units are nobody's business: a map with keyframes in units of their own is the same world as one in
which all count in the world's, and what is tracked and mapped from then on must be the same.
"""

from dataclasses import replace

import numpy as np
import pytest

from odomap.maps.snapshot import Update
from odomap.maps.states import compose, inverse, stretched
from odomap.system.config import preset
from odomap.system.slam import Slam
from system.test_localmapping import as_map, mapper_of
from windowworlds import world

HALF = 24


def update(map, ids, Ts, scales, landmarks=()):
    """Return an update that holds the first keyframe."""
    ids, landmarks, root = np.asarray(ids), np.asarray(landmarks, np.int64), int(ids[0])
    return Update(
        anchor_id=root,
        T_world_anchor=map.T_world_body(root),
        keyframe_ids=ids,
        Ts_world_body=Ts,
        landmark_ids=landmarks,
        points_world=map.points_world(landmarks),
        version=map.version,
        scales=scales,
        scale_anchor=map.scale(root),
    )


def drift(slam, total=0.3):
    """Have each keyframe be larger than the one it was placed against: lengths grow on the way."""
    m = slam.map
    ids = m.keyframe_ids
    larger = dict(zip(ids.tolist(), 1.0 + total * np.arange(len(ids)) / len(ids)))
    placed = {-1: (np.eye(4), np.ones(()))}
    for k in ids.tolist():
        p = m.parent(k)
        own, of = ((m.T_world_body(j), np.asarray(m.scale(j))) for j in (k, max(p, 0)))
        step = own if p < 0 else compose(inverse(of), own)
        placed[k] = compose(placed[p], (step[0], step[1] * larger[k] / larger.get(p, 1.0)))
    Ts, scales = zip(*(placed[k] for k in ids.tolist()))
    m.apply(update(m, ids, np.stack(Ts), np.array(scales, float)))


def count_in(slam, units):
    """Have keyframes count in other units, and leave all in the world as it is."""
    m, path = slam.map, slam._tracker.path
    ids, placed = m.keyframe_ids, [path[n] for n in range(len(path))]
    frames = [
        (f, m.place(f.keyframe_id, f.T_keyframe_body), m.scale(f.keyframe_id)) for f in placed
    ]
    scales, sure = units(ids), m.states.covariances[ids].copy()
    m.apply(update(m, ids, m.Ts_world_body(ids), scales, m.landmark_ids))
    m.set_covariance(ids, sure)
    for n, (frame, T, before) in enumerate(frames):
        T_keyframe_body = m.relative(frame.keyframe_id, T)
        own = stretched(frame.covariance, before / m.scale(frame.keyframe_id))
        path.replace(n, replace(frame, T_keyframe_body=T_keyframe_body, covariance=own))


def as_in_the_world(slam):
    count_in(slam, lambda ids: np.ones(len(ids)))


def at_random(slam):
    rng = np.random.default_rng(1)
    count_in(slam, lambda ids: np.r_[1.0, np.exp(rng.uniform(-0.7, 0.7, len(ids) - 1))])


def drift_in_the_world(slam):
    drift(slam)
    as_in_the_world(slam)


def run(source, change, config, half=HALF):
    """Track a recording, change the map in the middle; return what came after, and the result."""
    slam, estimates = Slam(source.rig, config), []
    for n, frame in enumerate(source):
        if n == half:
            change(slam)
        estimates.append(slam.track(frame))
    return estimates[half:], slam.finish()


@pytest.mark.parametrize(
    ("association", "change", "plain"),
    [
        ("features", at_random, as_in_the_world),
        ("features", drift, drift_in_the_world),
        ("flow", drift, drift_in_the_world),
    ],
)
def test_what_comes_is_the_same_in_whatever_units(room, association, change, plain):
    mono = preset("mono")
    config = replace(mono, tracking=replace(mono.tracking, association=association))
    estimates, result = run(room, change, config)
    expected, reference = run(room, plain, config)
    scales = result.map.states.scales[result.map.keyframe_ids]
    assert (scales != 1.0).sum() >= 2
    assert (scales == 1.0).sum() >= 3  # those that came since are in units of the world
    for a, b in zip(estimates, expected):
        assert (a.status, a.num_inliers, a.is_keyframe) == (b.status, b.num_inliers, b.is_keyframe)
        np.testing.assert_allclose(a.T_world_body.matrix, b.T_world_body.matrix, atol=1e-7)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-3, atol=1e-12)
    x, y = (r.trajectory for r in (result, reference))
    np.testing.assert_allclose(x.Ts_world_body, y.Ts_world_body, atol=1e-6)
    ids = result.map.landmark_ids
    np.testing.assert_array_equal(ids, reference.map.landmark_ids)
    places, others = result.map.points_world(ids), reference.map.points_world(ids)
    away = np.linalg.norm(others, axis=1, keepdims=True)
    assert np.quantile(np.abs(places - others) / away, 0.99) < 1e-4


def stretch_all(m, by=1.3):
    """Have the whole world be larger, as a loop to another piece of the map may have it."""
    with m.lock:
        ids = m.keyframe_ids
        everything = np.diag([1.0, 1.0, 1.0, 1.0]), np.asarray(by)
        m.states.move(ids, compose(everything, m.states.placements(ids)))


def mapped(order):
    """Work on a window, write it, and stretch the world, in some order; return the map."""
    m, change = as_map(world(known=0.4).window, off=0.01)[0], None
    m.set_covariance(m.keyframe_ids, np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6]))
    for step in order:
        if step == "stretch":
            stretch_all(m)
        elif step == "work":
            change = mapper_of(m).add(m.keyframe(int(m.keyframe_ids[-1]))).solve()
        else:
            change.write(m)
    return m


@pytest.mark.parametrize("order", [("work", "stretch", "write"), ("stretch", "work", "write")])
def test_a_window_is_written_in_the_units_of_then(order):
    expected, found = mapped(("work", "write", "stretch")), mapped(order)
    ids, landmarks, newest = found.keyframe_ids, found.landmark_ids, int(found.keyframe_ids[-1])
    assert found.scale(newest) == pytest.approx(1.3)
    np.testing.assert_array_equal(landmarks, expected.landmark_ids)
    np.testing.assert_allclose(found.Ts_world_body(ids), expected.Ts_world_body(ids), atol=1e-6)
    places = expected.points_world(landmarks)
    np.testing.assert_allclose(found.points_world(landmarks), places, rtol=1e-6, atol=1e-6)
    sure = expected.covariance(newest)
    np.testing.assert_allclose(found.covariance(newest), sure, rtol=1e-4, atol=1e-10)
