"""Reading a map for the eye: little at a time, and right."""

import numpy as np

from odomap.geometry.lie import se3_exp
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.views.livemap import CHUNK, LandmarkSample, LivePath, sketch


def pose(seed):
    return se3_exp(np.random.default_rng(seed).normal(size=6))


def make_map(keyframes=3, landmarks=50):
    map, rng = Map(), np.random.default_rng(1)
    for k in range(keyframes):
        map.add_keyframe(Keyframe(map.new_keyframe_id(), 100 * k), pose(k))
        ids = map.add_landmarks(k, rng.normal(size=(landmarks, 3)))
        map.add_observations(k, ids, np.full(landmarks, -1))
    return map


def estimate(frame, keyframe, T_keyframe_body, status=Status.TRACKING):
    T = SE3(T_keyframe_body)
    return Estimate(frame, frame, status, "", keyframe, T, T, np.eye(6))


class Watchful(Map):
    """A map that notes how many rows it is asked for at once."""

    def __init__(self):
        super().__init__()
        self.asked = [0]

    def points_world(self, landmark_ids):
        self.asked.append(len(landmark_ids))
        return super().points_world(landmark_ids)

    def resolve(self, landmark_ids):
        self.asked.append(len(landmark_ids))
        return super().resolve(landmark_ids)

    def Ts_world_body(self, keyframe_ids):
        self.asked.append(len(keyframe_ids))
        return super().Ts_world_body(keyframe_ids)


def test_a_sketch_shows_what_is_there():
    map = make_map()
    sample = LandmarkSample()
    seen = sketch(map, sample)
    assert np.array_equal(sample.ids, map.landmark_ids)
    assert np.array_equal(seen.shown.points, map.points_world(map.landmark_ids))
    assert np.array_equal(seen.shown.is_seen, np.arange(150) >= 100)  # by the newest keyframe
    assert np.array_equal(seen.Ts_world_body, map.Ts_world_body(map.keyframe_ids))
    assert seen.shown.count == 150


def test_an_empty_map_is_an_empty_sketch():
    seen = sketch(Map(), LandmarkSample())
    assert seen.shown.points.shape == (0, 3)
    assert seen.Ts_world_body.shape == (0, 4, 4)
    assert seen.shown.count == 0


def test_landmarks_that_go_and_fuse_leave_the_sample():
    map = make_map()
    sample = LandmarkSample()
    sketch(map, sample)
    map.remove_landmarks([0, 1])
    map.fuse_landmarks([10], [11])
    seen = sketch(map, sample)
    assert np.array_equal(sample.ids, map.landmark_ids)
    assert len(seen.shown.points) == 147
    assert np.isfinite(seen.shown.points).all()


def test_a_sample_is_limited_spread_and_steady():
    sample = LandmarkSample(limit=100)
    sample.add(np.arange(90))
    assert len(sample.ids) == 90
    before = None
    for k in range(1, 40):
        sample.add(np.arange(90 * k, 90 * (k + 1)))
        assert 50 <= len(sample.ids) <= 100
        gaps = np.diff(sample.ids)
        assert gaps.min() == gaps.max()  # as dense everywhere
        if before is not None and len(np.setdiff1d(before, sample.ids)):
            stride = gaps[0]
            assert np.array_equal(np.intersect1d(before, sample.ids), before[before % stride == 0])
        before = sample.ids


def test_the_lock_is_asked_for_little_at_a_time():
    map = Watchful()
    map.add_keyframe(Keyframe(0, 0), np.eye(4))
    ids = map.add_landmarks(0, np.random.default_rng(0).normal(size=(3 * CHUNK, 3)))
    map.add_observations(0, ids, np.full(len(ids), -1))
    seen = sketch(map, LandmarkSample())
    assert len(seen.shown.points) == 3 * CHUNK
    assert max(map.asked) <= CHUNK


def test_reading_changes_nothing():
    map = make_map()
    map.remove_landmarks([3, 60])
    path = LivePath(np.zeros(3))
    path.add(estimate(0, 1, pose(9)))
    before = map.dump()
    sketch(map, LandmarkSample())
    path.positions(map)
    after = map.dump()
    for name, column in before.columns.items():
        np.testing.assert_array_equal(after.columns[name], column)
    assert (before.version, before.epoch) == (after.version, after.epoch)


def test_a_path_moves_with_its_keyframes():
    map, lever = make_map(), np.array([0.1, -0.2, 0.3])
    path = LivePath(lever)
    frames = [(0, pose(20)), (1, pose(21)), (1, pose(22)), (2, pose(23))]
    for n, (k, T) in enumerate(frames):
        path.add(estimate(n, k, T, Status.LOST if n == 2 else Status.TRACKING))

    def expected():
        Ts = [map.place(k, T) for k, T in frames]
        return np.array([T[:3, :3] @ lever + T[:3, 3] for T in Ts])

    positions, is_lost = path.positions(map)
    np.testing.assert_allclose(positions, expected(), atol=1e-12)
    assert is_lost.tolist() == [False, False, True, False]
    snapshot = map.snapshot([0, 1, 2], landmarks=False)
    map.apply(snapshot.solved(np.array([pose(30), pose(31), pose(32)]), np.zeros((0, 3))))
    map.cull_keyframes([1])
    np.testing.assert_allclose(path.positions(map)[0], expected(), atol=1e-12)


def test_a_path_is_scaled_with_its_keyframes():
    map = Map()
    for k, scale in enumerate((1.0, 2.5)):
        map.add_keyframe(Keyframe(k, k), pose(k), scale=scale)
    path = LivePath(np.zeros(3))
    T = pose(5)
    path.add(estimate(0, 1, T))
    np.testing.assert_allclose(path.positions(map)[0][0], map.place(1, T)[:3, 3], atol=1e-12)


def test_frames_before_the_first_keyframe_have_no_place():
    path = LivePath(np.zeros(3))
    path.add(estimate(0, -1, np.eye(4), Status.INITIALIZING))
    positions, is_lost = path.positions(Map())
    assert len(path) == len(positions) == len(is_lost) == 0


def test_a_path_is_kept_as_it_was_told():
    map, lever = make_map(), np.array([0.1, -0.2, 0.3])
    path = LivePath(lever)
    told = [pose(20), pose(21)]
    for n, T in enumerate(told):
        path.add(estimate(n, n, T))
    snapshot = map.snapshot([0, 1, 2], landmarks=False)
    map.apply(snapshot.solved(np.array([pose(30), pose(31), pose(32)]), np.zeros((0, 3))))
    np.testing.assert_allclose(path.told, [T[:3, :3] @ lever + T[:3, 3] for T in told], atol=1e-12)
    assert np.abs(path.positions(map)[0] - path.told).max() > 0.1


def test_loops_are_where_the_camera_was_also_at_culled_keyframes():
    map, lever = make_map(4), np.array([0.1, -0.2, 0.3])
    map.add_edge(0, 3, pose(7), np.eye(6), "loop")
    map.add_edge(1, 2, pose(8), np.eye(6), "odometry")
    before = sketch(map, LandmarkSample(), lever)
    expected = [pose(k)[:3, :3] @ lever + pose(k)[:3, 3] for k in (3, 0)]
    np.testing.assert_allclose(before.loops, [expected], atol=1e-12)
    assert before.gaps.shape == (0, 2, 3)
    map.cull_keyframes([0])
    np.testing.assert_allclose(sketch(map, LandmarkSample(), lever).loops, [expected], atol=1e-9)


def test_a_gap_is_there_until_a_loop_has_closed_it():
    map = make_map(2)
    begun = map.new_keyframe_id()
    map.add_keyframe(Keyframe(begun, 500), pose(5))
    map.begin_piece(begun)
    (gap,) = sketch(map, LandmarkSample()).gaps
    np.testing.assert_allclose(gap, [pose(1)[:3, 3], pose(5)[:3, 3]], atol=1e-12)
    map.add_edge(0, begun, pose(7), np.eye(6), "loop")
    assert len(sketch(map, LandmarkSample()).gaps) == 0
