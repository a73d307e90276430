"""The map, rule by rule; `test_map_properties` has the interleavings."""

import sys
import threading

import numpy as np
import pytest

from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Update


def pose(t=(0.0, 0.0, 0.0), yaw=0.0):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = t
    return T


def chain(number, landmarks=5, seed=0):
    """Return a map of keyframes one metre apart, each seeing its landmarks and its neighbours'."""
    rng = np.random.default_rng(seed)
    m = Map()
    ids = np.zeros((0, landmarks), np.int64)
    for k in range(number):
        m.add_keyframe(
            Keyframe(m.new_keyframe_id(), k),
            pose((k, 0, 0), 0.1 * k),
            covariance=np.eye(6) * (k + 1),
            v_world_body=np.array([1.0, 2.0, 3.0]),
        )
        new = m.add_landmarks(k, rng.normal(size=(landmarks, 3)))
        ids = np.vstack([ids, new])
        for j in range(max(0, k - 2), k + 1):
            m.add_observations(k, ids[j], np.arange(landmarks) + landmarks * (k - j))
    return m, ids


def update(m, ids, Ts, scales=None, anchor=0, **rest):
    empty = np.zeros(0, np.int64)
    T_anchor = rest.pop("T_world_anchor", m.T_world_body(anchor))
    return Update(
        anchor_id=anchor,
        T_world_anchor=T_anchor,
        keyframe_ids=np.asarray(ids),
        Ts_world_body=np.asarray(Ts),
        landmark_ids=rest.pop("landmark_ids", empty),
        points_world=rest.pop("points_world", np.zeros((0, 3))),
        version=rest.pop("version", m.version),
        scales=scales,
        scale_anchor=None if scales is None else rest.pop("scale_anchor", m.scale(anchor)),
        **rest,
    )


def test_an_identity_update_changes_no_geometry():
    m, ids = chain(12)
    before = m.Ts_world_body(m.keyframe_ids), m.points_world(ids.ravel())
    snapshot = m.snapshot(np.arange(3, 10), [0, 1, 2])
    for _ in range(50):
        m.apply(snapshot.solved(snapshot.Ts_world_body, snapshot.points_world))
    np.testing.assert_allclose(m.Ts_world_body(m.keyframe_ids), before[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(m.points_world(ids.ravel()), before[1], rtol=0, atol=1e-12)


def test_a_sim3_write_moves_landmarks_by_the_sim3_formula():
    m, _ = chain(4)
    p = np.random.default_rng(1).normal(size=(5, 3))
    lm = m.add_landmarks(2, p)
    T, s = pose((3, -1, 2), 0.7), 1.8
    m.apply(update(m, [2], [T], scales=np.array([s])))
    np.testing.assert_allclose(m.points_world(lm), T[:3, 3] + s * p @ T[:3, :3].T, atol=1e-12)
    assert m.scale(2) == pytest.approx(s)
    # a frame that hangs from it, in its units
    T_k_body = pose((1, 0, 0), 0.2)
    placed = m.place(2, T_k_body)
    np.testing.assert_allclose(placed[:3, 3], T[:3, 3] + s * T[:3, 0], atol=1e-12)
    np.testing.assert_allclose(placed[:3, :3], T[:3, :3] @ T_k_body[:3, :3], atol=1e-12)
    # and a landmark written as a world point is stored in the units of its anchor
    q = np.array([[4.0, 5.0, 6.0]])
    m.apply(update(m, [], np.zeros((0, 4, 4)), landmark_ids=lm[:1], points_world=q))
    np.testing.assert_allclose(m.points_world(lm[:1]), q, atol=1e-12)


def test_velocity_turns_and_covariance_scales_with_the_keyframe():
    m, _ = chain(3)
    turn = pose((0, 0, 0), np.pi / 2)
    m.apply(update(m, [1], [turn @ m.T_world_body(1)], scales=np.array([2.0])))
    np.testing.assert_allclose(m.states.v_world_body[1], [-4.0, 2.0, 6.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(m.covariance(1)), [8, 8, 8, 2, 2, 2], atol=1e-12)
    m.apply(update(m, [2], [m.T_world_body(2)], covariances=np.eye(6)[None] * 7))
    np.testing.assert_allclose(m.covariance(2), np.eye(6) * 7)


def test_the_solution_is_written_relative_to_its_anchor():
    m, _ = chain(6)
    snapshot = m.snapshot([3, 4, 5], [2])
    m.apply(update(m, [2], [pose((50, 60, 70), 1.0)]))  # someone else moved the anchor meanwhile
    Ts = snapshot.Ts_world_body @ pose((0.1, 0, 0))
    Ts[3] = snapshot.Ts_world_body[3]
    m.apply(snapshot.solved(Ts, snapshot.points_world))
    got = np.linalg.inv(m.T_world_body(2)) @ m.Ts_world_body([3, 4, 5])
    np.testing.assert_allclose(got, np.linalg.inv(Ts[3]) @ Ts[:3], atol=1e-12)
    np.testing.assert_allclose(m.T_world_body(2), pose((50, 60, 70), 1.0), atol=1e-12)


def test_a_rescaled_anchor_rescales_a_solution_that_knew_nothing_of_scale():
    m, _ = chain(4)
    snapshot = m.snapshot([2, 3], [1])
    m.apply(update(m, [1, 2, 3], m.Ts_world_body([1, 2, 3]), scales=np.full(3, 2.0)))
    m.apply(snapshot.solved(snapshot.Ts_world_body, snapshot.points_world))
    assert m.scale(3) == pytest.approx(2.0)
    step = m.T_world_body(2)[:3, 3] - m.T_world_body(1)[:3, 3]
    assert np.linalg.norm(step) == pytest.approx(2.0)


def test_keyframes_created_since_follow_and_older_ones_stay():
    m, _ = chain(5)
    snapshot = m.snapshot([3], [2])
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 5), pose((5, 1, 0)), parent=3)
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 6), pose((6, 2, 0)), parent=5)
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 7), pose((7, 3, 0)), parent=4)
    before = m.Ts_world_body(np.arange(8))
    Ts = snapshot.Ts_world_body.copy()
    Ts[0] = pose((3, 9, 0), 2.0)
    m.apply(snapshot.solved(Ts, snapshot.points_world))
    after = m.Ts_world_body(np.arange(8))
    for k in (5, 6):
        np.testing.assert_allclose(
            np.linalg.inv(after[3]) @ after[k], np.linalg.inv(before[3]) @ before[k], atol=1e-12
        )
    np.testing.assert_array_equal(after[[0, 1, 2, 4, 7]], before[[0, 1, 2, 4, 7]])


def test_a_young_keyframe_named_by_an_update_goes_where_it_says():
    m, _ = chain(3)
    said = pose((8, 8, 8))
    m.apply(update(m, [1, 2], [pose((1, 5, 0)), said], version=0))
    np.testing.assert_allclose(m.T_world_body(2), said, atol=1e-12)


def test_a_frame_of_a_culled_keyframe_moves_with_the_parent():
    m, _ = chain(6)
    T_k_body = pose((0.3, 0, 0), 0.1)
    frame = m.place(3, T_k_body)
    m.cull_keyframes([3, 2])
    np.testing.assert_allclose(m.place(3, T_k_body), frame, atol=1e-12)
    assert m.parent(3) == m.parent(4) == 1
    delta = pose((7, 0, 0), 0.5)
    m.apply(update(m, [1], [delta @ m.T_world_body(1)]))
    np.testing.assert_allclose(m.place(3, T_k_body), delta @ frame, atol=1e-12)
    assert not m.is_keyframe_alive(3)
    with pytest.raises(KeyError, match="culled"):
        m.keyframe(3)


def test_culling_spares_the_last_keyframe():
    m, _ = chain(3)
    with pytest.raises(ValueError, match="no keyframe"):
        m.cull_keyframes([0, 1, 2])
    m.cull_keyframes([0, 2])
    assert m.keyframe_ids.tolist() == [1]
    assert m.parent(1) == -1


def test_retiring_forgets_all_but_the_path():
    m, ids = chain(6)
    T = m.T_world_body(0)
    m.retire_keyframes([0])
    assert m.num_observations == len(m.observers_of(m.landmark_ids)[1])
    assert len(m.observations_of(0)[0]) == 0
    assert m.is_alive(ids[0]).all()  # keyframes 1 and 2 still see them
    m.retire_keyframes([1, 2])
    assert not m.is_alive(ids[0]).any()
    np.testing.assert_array_equal(m.T_world_body(0), T)
    assert m.keyframe(0).features is None


def size_of(thing):
    """Return the bytes of an object and all it holds."""
    size = thing.nbytes if isinstance(thing, np.ndarray) else sys.getsizeof(thing)
    parts = list(thing.items()) if isinstance(thing, dict) else thing
    parts = list(vars(thing).values()) if hasattr(thing, "__dict__") else parts
    parts = parts if isinstance(parts, list | tuple) else []
    return size + sum(size_of(part) for part in parts)


def test_odometry_needs_constant_memory_but_for_its_path():
    m, window, recent = Map(), 6, []

    def drive(number):
        for _ in range(number):
            k = m.new_keyframe_id()
            m.add_keyframe(Keyframe(k, k), np.eye(4))
            recent.append(m.add_landmarks(k, np.ones((60, 3))))
            for ids in recent[-3:]:
                m.add_observations(k, ids, np.arange(60))
            m.fuse_landmarks(recent[-1][:3], recent[-1][3:6])
            m.retire_keyframes([k - window] if k >= window else [])
            del recent[:-window]
        return size_of(m)

    first = drive(520)  # the columns of states have room for 1024 from here on
    second = drive(480)
    assert m.num_landmarks <= 60 * (window + 2)
    assert (second - first) / 480 < 400  # bytes per keyframe; its landmarks would be 5,000


def test_fused_ids_follow_their_survivor_for_ever():
    m = Map()
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 0), np.eye(4))
    old = m.add_landmarks(0, np.zeros((3, 3)))
    m.fuse_landmarks([old[1], old[2]], [old[0], old[1]])
    for _ in range(40):  # long enough for the table of ids to be compacted more than once
        m.remove_landmarks(m.add_landmarks(0, np.zeros((50, 3))))
    assert m.resolve(old).tolist() == [old[2]] * 3
    m.remove_landmarks(old[:1])
    fresh = m.add_landmarks(0, np.zeros((5000, 3)))
    assert m.resolve(old).tolist() == [-1] * 3
    assert fresh[0] == 3 + 40 * 50
    assert np.isnan(m.points_world(old)).all()


def test_edges_are_kept_as_measured():
    m, _ = chain(3)
    row = m.add_edge(0, 2, pose((2, 0, 0)), np.eye(6), "loop", scale_i_j=1.5)
    m.cull_keyframes([1, 2])
    edges = m.edges()
    assert (edges.i[row], edges.j[row], edges.kind[row]) == (0, 2, "loop")
    assert edges.scales_i_j[row] == 1.5
    np.testing.assert_array_equal(edges.Ts_i_j[row], pose((2, 0, 0)))


def test_snapshots_are_read_only_copies():
    m, _ = chain(4)
    snapshot = m.snapshot([2, 3])
    assert snapshot.anchor_id == 2
    for name in ("Ts_world_body", "points_world", "obs_keypoint", "landmark_ids"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(snapshot, name)[:1] = 0


def test_a_snapshot_for_a_pose_graph_has_no_landmarks():
    m, _ = chain(5)
    snapshot = m.snapshot([1, 2, 3, 4], [0], landmarks=False)
    assert snapshot.keyframe_ids.tolist() == [1, 2, 3, 4, 0]
    assert len(snapshot.landmark_ids) == len(snapshot.obs_keyframe) == 0
    before = m.points_world(m.landmark_ids[-1:])
    Ts = snapshot.Ts_world_body.copy()
    Ts[3, 2, 3] += 2
    m.apply(snapshot.solved(Ts, snapshot.points_world))
    np.testing.assert_allclose(
        m.points_world(m.landmark_ids[-1:]), before + np.array([0, 0, 2.0]), atol=1e-12
    )


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"Ts_world_body": np.full((1, 4, 4), np.nan)}, "finite"),
        ({"Ts_world_body": 2 * np.eye(4)[None]}, "orthonormal"),
        ({"Ts_world_body": np.eye(4)}, "poses"),
        ({"points_world": np.zeros((1, 3))}, "points"),
        ({"scales": np.array([-1.0]), "scale_anchor": 1.0}, "positive"),
        ({"scales": np.array([1.0])}, "together"),
        ({"keyframe_ids": np.array([1, 1]), "Ts_world_body": np.stack([np.eye(4)] * 2)}, "twice"),
    ],
)
def test_a_solution_that_cannot_be_true_is_refused(change, complaint):
    good = {
        "anchor_id": 0,
        "T_world_anchor": np.eye(4),
        "keyframe_ids": np.array([1]),
        "Ts_world_body": np.eye(4)[None],
        "landmark_ids": np.zeros(0, np.int64),
        "points_world": np.zeros((0, 3)),
        "version": 0,
    }
    Update(**good)
    with pytest.raises(ValueError, match=complaint):
        Update(**(good | change))


def test_wrong_calls_are_refused_and_change_nothing():
    m, ids = chain(3)
    version = m.version
    calls = [
        (KeyError, lambda: m.T_world_body(99)),
        (KeyError, lambda: m.T_world_body(-1)),
        (KeyError, lambda: m.cull_keyframes([1, 99])),
        (KeyError, lambda: m.add_landmarks(99, np.zeros((1, 3)))),
        (KeyError, lambda: m.add_edge(0, 99, np.eye(4), np.eye(6), "loop")),
        (KeyError, lambda: m.descriptors([10**6])),
        (KeyError, lambda: m.apply(update(m, [99], [np.eye(4)]))),
        (ValueError, lambda: m.add_keyframe(Keyframe(1, 0), np.eye(4))),
        (ValueError, lambda: m.add_keyframe(Keyframe(9, 0), np.full((4, 4), np.nan))),
        (ValueError, lambda: m.add_landmarks(0, np.full((1, 3), np.inf))),
        (ValueError, lambda: m.add_observations(0, ids[0], [1])),
        (TypeError, lambda: m.points_world([1.5])),
    ]
    for error, call in calls:
        with pytest.raises(error):
            call()
    assert m.version == version
    assert m.keyframe_ids.tolist() == [0, 1, 2]


def test_threads_share_a_map():
    m, ids = chain(30)
    errors = []

    def work(action):
        try:
            for n in range(150):
                action(n)
        except BaseException as error:
            errors.append(error)

    def track(n):
        assert m.points_world(ids.ravel()).shape == (150, 3)
        m.add_observations(n % 20, ids[n % 30], np.arange(5))

    def solve(n):
        snapshot = m.snapshot(np.arange(10, 20), [9])
        m.apply(snapshot.solved(snapshot.Ts_world_body, snapshot.points_world))

    def prune(n):
        fresh = m.add_landmarks(25, np.zeros((4, 3)))
        m.fuse_landmarks(fresh[:1], fresh[1:2])
        m.remove_landmarks(fresh)
        if n % 30 == 0:
            m.cull_keyframes([21 + n // 30])

    threads = [threading.Thread(target=work, args=(a,)) for a in (track, solve, prune)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert m.num_landmarks == 150
    assert m.keyframe_ids.tolist() == [*range(21), *range(26, 30)]


def test_landmarks_settle_in_their_anchors_unless_others_have_moved_them():
    m, ids = chain(4)
    snapshot = m.snapshot(m.keyframe_ids)
    read = {k: n for n, k in enumerate(snapshot.landmark_ids.tolist())}
    anchors, before = snapshot.anchors, snapshot.points_anchor
    world = m.points_world(snapshot.landmark_ids)
    np.testing.assert_array_equal(anchors, np.repeat(np.arange(4), 5))
    moved, fused, survivor, gone, hangs = ids[1, 0], ids[1, 1], ids[1, 2], ids[1, 3], ids[3, 0]
    places = m.points_world([moved]) + 1.0
    m.apply(update(m, [], np.zeros((0, 4, 4)), landmark_ids=ids[1, :1], points_world=places))
    m.fuse_landmarks([survivor], [fused])
    m.remove_landmarks([gone])
    m.cull_keyframes([3])  # what it held hangs from another one now
    epoch, version = m.epoch, m.version
    m.settle(snapshot.landmark_ids, anchors, before, before + 0.5)
    assert m.epoch == epoch + 1
    assert m.version == version + 1
    np.testing.assert_allclose(m.points_world([moved]), places)
    np.testing.assert_allclose(m.points_world([hangs])[0], world[read[hangs]])
    assert not m.is_alive([gone])[0]
    after = m.snapshot([0, 1])
    now = {k: n for n, k in enumerate(after.landmark_ids.tolist())}
    settled = [k for k in ids[:3].ravel().tolist() if k not in (moved, fused, gone)]
    rows = [now[k] for k in settled if k in now], [read[k] for k in settled if k in now]
    np.testing.assert_array_equal(after.points_anchor[rows[0]], before[rows[1]] + 0.5)
    assert survivor in settled
