"""Candidates: followed from keyframe to keyframe until two rays tell where they are."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.association import Candidates, Reference, View
from odomap.system.candidates import CandidateConfig, Followed, Follower, no_candidates
from odomap.system.config import preset
from odomap.system.depthbias import DepthBias
from odomap.system.eye import Eye
from odomap.system.keyframing import Keyframes
from odomap.vision.features import Corners, Features

CAMERA = Camera(intrinsics=(300.0, 300.0, 199.5, 149.5), resolution=(400, 300))
T_BODY_CAMERA = se3_exp(np.array([0.05, -0.02, 0.1, 0.2, -0.4, 0.1]))
CONFIG = CandidateConfig(follow=True)

NO_BIAS = DepthBias(np.zeros(3))


def view_of(frame_id):
    none = Corners(np.empty((0, 2), np.float32), np.empty(0), np.empty(0, np.uint8))
    image = np.zeros((300, 400), np.uint8)
    return View(frame_id, 10**8 * frame_id, (image,), none, np.empty((0, 0), np.uint8))


class Oracle:
    """An association that knows where points are: it answers for what is near its guess."""

    count, follows = 300, False

    def __init__(self, points, poses, reach_px=15.0):
        self.points, self.poses, self.reach_px = points, poses, reach_px
        self.noise_px, self.wrong, self.asked = 0.0, np.zeros(len(points), bool), []
        self._rng = np.random.default_rng(0)

    def at(self, frame_id):
        T_camera_world = se3_inverse(self.poses[frame_id] @ T_BODY_CAMERA)
        local = self.points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        return CAMERA.project(local)

    def find(self, known, keypoints, descriptors, view, guess, warp):
        assert warp.shape == (len(keypoints), 2, 2)
        apart = np.linalg.norm(keypoints[:, None] - self.at(known.frame_id)[None], axis=2)
        who = apart.argmin(axis=1)
        true = self.at(view.frame_id)[who]
        found = np.linalg.norm(guess - true, axis=1) < self.reach_px
        self.asked.append((guess, true))
        noise = self.noise_px * self._rng.normal(size=true.shape)
        return true + noise + 40.0 * self.wrong[who][:, None], found

    def extend(self, view, occupied, count):
        return np.empty((0, 2)), np.empty((0, 0), np.uint8)

    def levels_at(self, view, keypoints):
        return np.zeros(len(keypoints), np.uint8)

    def descriptors_at(self, view, keypoints):
        return np.empty((len(keypoints), 0), np.uint8)


class Walk:
    """A map of keyframes with landmarks all around, and candidates between them."""

    def __init__(self, step=0.12, count=40, seed=0, views=8):
        rng = np.random.default_rng(seed)
        rays = np.column_stack([rng.uniform(-0.45, 0.45, (count, 2)), np.ones(count)])
        self.poses = [
            se3_exp(np.array([step * k, 0.01 * k, 0, 0, 0, 0.0])) @ se3_inverse(T_BODY_CAMERA)
            for k in range(views)
        ]
        self.points = rays * rng.uniform(3.0, 4.0, (count, 1))
        self.landmarks = rays[: count // 2] * 3.5 + rng.uniform(-0.1, 0.1, (count // 2, 3))
        self.map, self.oracle = Map(), Oracle(self.points, self.poses)
        self.follower = Follower(self.map, CAMERA, T_BODY_CAMERA, self.oracle, None, CONFIG)

    def keyframe(self, k, pixels):
        """Add a keyframe that saw pixels; return its id."""
        keyframe_id = self.map.new_keyframe_id()
        n = len(pixels)
        features = Features(
            pixels.astype(np.float32),
            np.empty((n, 0), np.uint8),
            CAMERA.unproject(pixels),
            np.full(n, np.nan),
            np.zeros(n, np.uint8),
        )
        self.map.add_keyframe(Keyframe(keyframe_id, 10**8 * k, features), self.poses[k])
        return keyframe_id

    def reference(self, k, candidates, keyframe_id):
        """Return keyframe k with the landmarks as they are seen there."""
        T_camera_world = se3_inverse(self.poses[k] @ T_BODY_CAMERA)
        local = self.landmarks @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        body = (self.landmarks - self.poses[k][:3, 3]) @ self.poses[k][:3, :3]
        ids = self.map.add_landmarks(keyframe_id, body)
        n = len(ids)
        return Reference(
            keyframe_id,
            view_of(k),
            ids,
            CAMERA.project(local),
            np.empty((n, 0), np.uint8),
            np.zeros(n, bool),
            np.full(n, 0.1),
            np.full(n, keyframe_id),
            CAMERA.project(local),
            candidates,
        )

    def first(self):
        """Return keyframe 0, all points its candidates."""
        pixels = self.oracle.at(0)
        keyframe_id, n = self.keyframe(0, pixels), len(pixels)
        keyframes, rows = np.full((n, CONFIG.views), -1), np.full((n, CONFIG.views), -1)
        keyframes[:, 0], rows[:, 0] = keyframe_id, np.arange(n)
        candidates = Candidates(pixels, np.empty((n, 0), np.uint8), pixels, keyframes, rows)
        return self.reference(0, candidates, keyframe_id)


def test_two_rays_tell_the_point():
    walk = Walk()
    followed = walk.follower.follow(walk.first(), view_of(1), walk.poses[1])
    assert len(followed.pixels) == len(walk.points)
    np.testing.assert_allclose(followed.points_world, walk.points, atol=1e-5)
    np.testing.assert_allclose(followed.pixels, walk.oracle.at(1), atol=1e-9)


def test_they_are_expected_at_the_depth_of_the_landmarks_around_them():
    walk = Walk()
    walk.follower.follow(walk.first(), view_of(1), walk.poses[1])
    guess, true = walk.oracle.asked[0]
    off = np.linalg.norm(guess - true, axis=1)
    moved = np.linalg.norm(walk.oracle.at(1) - walk.oracle.at(0), axis=1)
    # Points move by ten pixels, and are guessed to two: depth differs by a seventh at most.
    assert np.median(moved) > 8
    assert np.median(off) < 2
    assert off.max() < 4


def test_below_the_least_parallax_they_stay_candidates():
    walk = Walk(step=0.02)  # a third of a degree
    followed = walk.follower.follow(walk.first(), view_of(1), walk.poses[1])
    assert len(followed.pixels) == len(walk.points)
    assert np.isnan(followed.points_world).all()
    assert (followed.history.keyframes[:, 0] == 0).all()
    # Seven steps are more than a degree.
    followed = walk.follower.follow(walk.first(), view_of(7), walk.poses[7])
    assert np.isfinite(followed.points_world).all()


def test_the_threshold_is_the_angle_between_rays():
    walk = Walk(step=0.05)
    reference = walk.first()
    centres = [(T @ T_BODY_CAMERA)[:3, 3] for T in walk.poses[:2]]
    a, b = (walk.points - c for c in centres)
    cosine = np.sum(a * b, axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    angle = np.degrees(np.arccos(cosine))
    middle = float(np.median(angle))
    walk.follower._config = replace(CONFIG, min_parallax_deg=middle)
    followed = walk.follower.follow(reference, view_of(1), walk.poses[1])
    clear = np.abs(angle - middle) > 1e-3
    np.testing.assert_array_equal(
        np.isfinite(followed.points_world[clear, 0]), angle[clear] > middle
    )


def test_rays_that_do_not_meet_are_dropped():
    walk = Walk()
    walk.oracle.wrong[:10] = True
    followed = walk.follower.follow(walk.first(), view_of(1), walk.poses[1])
    # Shifted along and across the epipolar line: most are caught, and no right one is lost.
    right = followed.history.rows[:, 0] >= 10
    assert right.sum() == len(walk.points) - 10
    assert (~right).sum() <= 1


def test_what_is_not_found_is_dropped():
    walk = Walk()
    walk.oracle.reach_px = -1.0
    followed = walk.follower.follow(walk.first(), view_of(1), walk.poses[1])
    assert len(followed.pixels) == len(followed.history) == 0
    assert followed.points_world.shape == (0, 3)


def test_noise_of_pixels_is_that_of_depth():
    """σ_z / z = σ_x / (f α) for two views, √2 of it since both are unsure."""
    walk = Walk(step=0.2, count=300)
    reference = walk.first()
    walk.oracle.noise_px = 0.3
    followed = walk.follower.follow(reference, view_of(1), walk.poses[1])
    who = followed.history.rows[:, 0]
    depth = np.linalg.norm(walk.points[who], axis=1)
    off = np.linalg.norm(followed.points_world, axis=1) / depth - 1
    alpha = 0.2 / np.median(depth)
    expected = 0.3 / CAMERA.fx / alpha
    assert 0.5 * expected < 1.48 * np.nanmedian(np.abs(off)) < 1.5 * expected


def test_candidates_out_of_sight_and_none_at_all():
    walk = Walk()
    reference = walk.first()
    away = walk.poses[0] @ T_BODY_CAMERA @ se3_exp(np.array([0, 0, 0, 0, np.pi, 0]))
    away = away @ se3_inverse(T_BODY_CAMERA)
    assert len(walk.follower.follow(reference, view_of(1), away).pixels) == 0
    empty = replace(reference, candidates=no_candidates(CONFIG.views))
    assert len(walk.follower.follow(empty, view_of(1), walk.poses[1]).pixels) == 0
    nobody = replace(reference, landmark_ids=np.empty(0, np.int64), keypoints=np.empty((0, 2)))
    assert len(walk.follower.follow(nobody, view_of(1), walk.poses[1]).pixels) == 0
    none = Followed.none(3)
    assert none.history.keyframes.shape == (0, 3)


def test_keyframes_whose_features_are_forgotten_are_passed_over():
    walk = Walk(step=0.05)
    history = walk.first().candidates
    keyframes, rows = history.keyframes.copy(), history.rows.copy()
    keyframes[:, 1], rows[:, 1] = walk.keyframe(1, walk.oracle.at(1)), np.arange(len(history))
    history = replace(history, keypoints=walk.oracle.at(1), keyframes=keyframes, rows=rows)
    reference = walk.reference(1, history, 1)
    walk.map.retire_keyframes([0])
    assert walk.map.keyframe(0).features is None
    followed = walk.follower.follow(reference, view_of(4), walk.poses[4])
    np.testing.assert_allclose(followed.points_world, walk.points, atol=1e-5)


def test_some_of_them_and_some_afresh():
    candidates = Walk().first().candidates
    few = candidates.at(np.array([3, 1]))
    assert len(few) == 2
    np.testing.assert_array_equal(few.rows[:, 0], [3, 1])
    afresh = few.afresh(np.array([True, False]))
    np.testing.assert_array_equal(afresh.keyframes[0], -1)
    np.testing.assert_array_equal(afresh.keyframes[1], few.keyframes[1])


# ---- as keyframes are made of them ----


class Line:
    """Keyframes made one after the other of what an oracle follows."""

    def __init__(self, step, views):
        self.walk = Walk(step=step, views=views)
        config = preset("mono-flow")
        self.config = config
        eye = replace(Eye.of_camera(CAMERA), T_body_camera=T_BODY_CAMERA)
        self.map = self.walk.map
        self.keyframes = Keyframes(self.map, eye, None, NO_BIAS, self.walk.oracle, self.config)
        pixels = self.walk.oracle.at(0)
        points = np.array(self.walk.points)
        points[20:] = np.nan  # half of them have a place from the start
        self.reference = self._add(0, self.keyframes.seen_first(view_of(0), pixels, points), -1)

    def _add(self, k, seen, parent):
        return self.keyframes.add(view_of(k), self.walk.poses[k], seen, parent, np.eye(6) * 1e-6)

    def advance(self, k):
        reference, oracle = self.reference, self.walk.oracle
        rows = np.arange(len(reference.landmark_ids))
        pixels, _ = oracle.find(
            reference.view,
            reference.keypoints,
            reference.descriptors,
            view_of(k),
            oracle.at(k)[:1].repeat(len(rows), 0),
            np.tile(np.eye(2), (len(rows), 1, 1)),
        )
        seen = self.keyframes.measure(None, view_of(k), self.walk.poses[k], reference, rows, pixels)
        self.reference = self._add(k, seen, reference.keyframe_id)


def test_a_triangulated_candidate_is_a_landmark_that_all_its_views_observe():
    line = Line(step=0.03, views=4)  # half a degree per step: told at the second or third
    born = set(line.map.landmark_ids.tolist())
    counts = {}
    for k in range(1, 4):
        line.advance(k)
        new = sorted(set(line.map.landmark_ids.tolist()) - born)
        counts[k] = line.map.count_observers(new).tolist()
        born |= set(new)
    assert counts[1] == []
    assert sum(len(c) for c in counts.values()) == 20
    for k, seen in counts.items():
        assert set(seen) <= {k + 1}
    np.testing.assert_allclose(
        np.sort(line.map.points_world(line.map.landmark_ids)[:, 2]),
        np.sort(line.walk.points[:, 2]),
        atol=1e-4,
    )


def test_a_candidate_told_at_the_end_of_its_history_keeps_it():
    """Five views remembered, and the sixth tells: the landmark has all their rays, not one."""
    views = CONFIG.views
    line = Line(step=0.003, views=views + 1)
    before = line.map.num_landmarks
    for k in range(1, views):
        line.advance(k)
    waiting = len(line.reference.candidates)
    assert line.map.num_landmarks == before
    assert (line.reference.candidates.keyframes[:, -1] >= 0).all()
    line.keyframes._follower._config = replace(CONFIG, min_parallax_deg=0.5)
    line.advance(views)
    new = line.map.landmark_ids[before:]
    assert len(new) == waiting == 20
    # The first views and the one at hand.
    assert line.map.count_observers(new).tolist() == [views + 1] * 20
    # And depth is known to what the parallax says, not unknown altogether.
    of_new = np.isin(line.reference.landmark_ids, new)
    assert (line.reference.relative[of_new] < 0.5).all()
    assert (line.reference.first_keyframe[of_new] == 0).all()


def test_a_candidate_followed_for_long_starts_afresh():
    views = CONFIG.views
    line = Line(step=0.0, views=views + 2)
    for k in range(1, views):
        line.advance(k)
    assert (line.reference.candidates.keyframes >= 0).all()
    line.advance(views)
    kept = line.reference.candidates
    assert len(kept) == 20
    assert (kept.keyframes[:, 0] == line.reference.keyframe_id).all()
    assert (kept.keyframes[:, 1:] == -1).all()
    np.testing.assert_allclose(kept.first_at, kept.keypoints, atol=1e-3)


@pytest.mark.parametrize("follow", [True, False])
def test_without_following_there_are_none(follow):
    line = Line(step=0.1, views=2)
    config = replace(line.config, candidates=replace(CONFIG, follow=follow))
    eye = replace(Eye.of_camera(CAMERA), T_body_camera=T_BODY_CAMERA)
    keyframes = Keyframes(line.map, eye, None, NO_BIAS, line.walk.oracle, config)
    rows = np.arange(len(line.reference.landmark_ids))
    seen = keyframes.measure(
        None,
        view_of(1),
        line.walk.poses[1],
        line.reference,
        rows,
        line.walk.oracle.at(1)[:20],
    )
    assert len(seen.followed.pixels) == (20 if follow else 0)
