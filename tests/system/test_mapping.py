"""The window mapper on a map whose truth is known: a walk along a wall of points."""

import numpy as np
import pytest

from odomap.backend.bundle import BundleConfig
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.depthbias import DepthBias
from odomap.system.mapping import WindowConfig, WindowMapper
from odomap.system.uncertainty import NoiseConfig
from odomap.vision.features import Features

BASELINE = 0.12
CAMERA = Camera("pinhole", [400.0, 400.0, 319.5, 239.5], [], (640, 480))
T_BODY_CAMERA = se3_exp(np.array([0.03, -0.02, 0.05, 0.3, -0.2, 0.1]))
NOISE = NoiseConfig(position_px=0.4)
SIGMA = 0.4 / (CAMERA.fx * BASELINE)


class Walk:
    """Keyframes 0.35 m apart that share landmarks; poses come in wrong, as from a tracker."""

    def __init__(self, seed=0, pose_noise=0.02, window=None, pixel_noise=1.0):
        self.rng = np.random.default_rng(seed)
        self.map, self.pose_noise, self.pixel_noise = Map(), pose_noise, pixel_noise
        self.points = self.rng.uniform([-3, -1.5, 2.5], [25, 1.5, 6], (1500, 3))
        self.id_of = np.full(len(self.points), -1)
        window = WindowConfig() if window is None else window
        config = BundleConfig(iterations=8)
        bias = DepthBias(np.zeros(3))
        sections = window, config, NOISE, bias
        self.mapper = WindowMapper(self.map, T_BODY_CAMERA, CAMERA, *sections, SIGMA)
        self.truth = []

    def step(self, far=False):
        """Add the next keyframe; `far` away from all that was seen. Return its job."""
        k = len(self.truth)
        wobble = self.rng.normal(0, 0.02, 6) * (k > 0)
        x = 0.35 * k + (10 if far else 0)
        T_world_camera = se3_exp(np.array([x, 0, 0, 0, 0, 0.0])) @ se3_exp(wobble)
        true = T_world_camera @ se3_inverse(T_BODY_CAMERA)
        if k == 0:
            T = true
        else:
            relative = se3_inverse(self.truth[-1]) @ true
            noise = se3_exp(self.rng.normal(0, self.pose_noise, 6))
            T = self.map.T_world_body(k - 1) @ relative @ noise
        self.truth.append(true)
        if far:
            self.id_of[:] = -1
        return self.mapper.add(self._add(T, true @ T_BODY_CAMERA))

    def _add(self, T, T_world_camera):
        local = (self.points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        pixels = CAMERA.project(local)
        seen = np.flatnonzero(CAMERA.is_inside(np.nan_to_num(pixels, nan=-1.0)))
        seen = self.rng.permutation(seen)[:150]
        z = local[seen, 2]
        pixels = pixels[seen] + self.pixel_noise * self.rng.normal(0, 0.4, (len(seen), 2))
        fb = CAMERA.fx * BASELINE
        depth = fb / (fb / z + self.pixel_noise * self.rng.normal(0, 0.4, len(z)))
        bearings = CAMERA.unproject(pixels)
        none = np.zeros((len(seen), 0), np.uint8)
        features = Features(
            pixels.astype(np.float32), none, bearings, depth, np.zeros(len(seen), np.uint8)
        )
        k = self.map.new_keyframe_id()
        keyframe = Keyframe(k, 10**8 * k, features)
        self.map.add_keyframe(keyframe, T, covariance=1e-8 * np.eye(6))
        alive = np.isin(self.id_of[seen], self.map.landmark_ids)
        new = seen[~alive]
        local = bearings[~alive] / bearings[~alive, 2:] * depth[~alive, None]
        body = local @ T_BODY_CAMERA[:3, :3].T + T_BODY_CAMERA[:3, 3]
        self.id_of[new] = self.map.add_landmarks(k, body)
        self.map.add_observations(k, self.id_of[seen], np.arange(len(seen)))
        return keyframe

    def run(self, steps):
        for _ in range(steps):
            job = self.step()
            if job is not None:
                job.solve().write(self.map)

    def errors(self):
        found = np.array([self.map.T_world_body(k) for k in range(len(self.truth))])
        return se3_log(se3_inverse(np.array(self.truth)) @ found)


def test_the_window_mends_what_the_tracker_got_wrong():
    walk = Walk()
    walk.run(12)
    translation = np.linalg.norm(walk.errors()[:, :3], axis=1)
    # The tracker's errors alone would add up to 2 cm sqrt(3 * 11) = 11 cm.
    assert translation.max() < 0.02
    assert np.linalg.norm(walk.errors()[:, 3:], axis=1).max() < 0.01
    unmended = Walk()
    for _ in range(12):
        unmended.step()
    assert np.linalg.norm(unmended.errors()[-1, :3]) > 2 * translation[-1]


def test_without_noise_the_truth_is_found():
    walk = Walk(pixel_noise=0.0)
    walk.run(8)
    assert np.abs(walk.errors()).max() < 1e-4


def test_the_first_keyframe_has_nothing_to_be_adjusted_with():
    walk = Walk()
    assert walk.step() is None
    assert walk.step() is not None


def test_solving_leaves_the_map_alone_until_it_is_written():
    walk = Walk()
    walk.run(4)
    job = walk.step()
    version = walk.map.version
    before = walk.map.T_world_body(4)
    change = job.solve()
    assert walk.map.version == version
    np.testing.assert_array_equal(walk.map.T_world_body(4), before)
    change.write(walk.map)
    assert walk.map.version > version
    assert np.abs(se3_log(se3_inverse(before) @ walk.map.T_world_body(4))).max() > 1e-3
    assert change.newest_id == 4
    assert change.solution.cost_after < change.solution.cost_before
    assert change.loops == ()


def test_keyframes_held_fixed_stay():
    walk = Walk()
    walk.run(14)
    job = walk.step()
    held = job.snapshot.keyframe_ids[job.snapshot.is_fixed]
    newest_held = 14 - WindowConfig().size  # the newest of all is 14
    assert held.tolist() == [newest_held - 1, newest_held]
    assert sorted(job.snapshot.keyframe_ids.tolist()) == list(range(newest_held - 1, 15))
    before = [walk.map.T_world_body(k) for k in range(newest_held + 1)]
    job.solve().write(walk.map)
    for k, T in enumerate(before):
        np.testing.assert_allclose(walk.map.T_world_body(k), T, atol=1e-12)


def test_memory_stays_flat():
    walk = Walk(window=WindowConfig(size=4, fixed=1))
    sizes = []
    for _ in range(10):
        walk.run(4)
        snapshot = walk.map.snapshot(walk.map.keyframe_ids)
        sizes.append((walk.map.num_landmarks, len(snapshot.obs_keyframe)))
    landmarks, observations = np.array(sizes)[2:].T
    assert landmarks.max() < 1.3 * landmarks.min()
    assert observations.max() <= 150 * 6
    # Keyframes that left the window keep their place, not what they saw.
    with_payload = [k for k in range(40) if walk.map.keyframe(k).features is not None]
    assert with_payload == list(range(40 - len(with_payload), 40))
    assert 5 <= len(with_payload) <= 6


def test_observations_that_disagree_are_dropped():
    walk = Walk()
    walk.run(5)
    job = walk.step()
    rows = np.flatnonzero(job.snapshot.obs_keyframe == job.snapshot.keyframe_ids.tolist().index(5))
    seen = np.bincount(job.snapshot.obs_landmark)  # two sights can be made to agree, four not
    wrong = rows[seen[job.snapshot.obs_landmark[rows]] >= 4][:6]
    assert len(wrong) == 6
    job.bundle.xy[wrong] += 0.1  # forty pixels
    change = job.solve()
    change.write(walk.map)
    dropped = set(
        zip(change.update.dropped_keyframes.tolist(), change.update.dropped_landmarks.tolist())
    )
    landmarks = job.snapshot.landmark_ids[job.snapshot.obs_landmark[wrong]].tolist()
    assert {(5, m) for m in landmarks} <= dropped
    assert len(dropped) < 0.05 * len(job.snapshot.obs_keyframe) + 6
    after = walk.map.snapshot([5])
    assert not set(landmarks) & set(after.landmark_ids.tolist())


def test_a_new_window_begins_where_nothing_is_shared():
    walk = Walk()
    walk.run(5)
    before = [walk.map.T_world_body(k) for k in range(5)]
    assert walk.step(far=True) is None
    assert all(walk.map.keyframe(k).features is None for k in range(5))
    job = walk.step()
    assert job.snapshot.keyframe_ids.tolist() == [6, 5]
    assert job.snapshot.is_fixed.tolist() == [False, True]
    job.solve().write(walk.map)
    for k, T in enumerate(before):
        np.testing.assert_allclose(walk.map.T_world_body(k), T, atol=1e-12)


def test_uncertainty_grows_along_the_path():
    walk = Walk()
    walk.run(20)
    covariances = np.array([walk.map.covariance(k) for k in range(20)])
    assert (np.linalg.eigvalsh(covariances) > 0).all()
    sigma = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    assert sigma[19] > 1.5 * sigma[4]
    errors = walk.errors()
    for k in (5, 10, 19):
        assert errors[k] @ np.linalg.solve(covariances[k], errors[k]) / 6 < 4
    # It is of the size of the error, not of any size.
    assert sigma[19] < 0.2


def test_a_keyframe_that_hangs_by_a_thread_is_not_called_certain():
    walk = Walk()
    walk.run(4)
    job = walk.step()
    seen = np.bincount(job.snapshot.obs_landmark)
    newest = job.snapshot.keyframe_ids.tolist().index(4)
    rows = np.flatnonzero(job.snapshot.obs_keyframe == newest)
    rows = rows[np.argsort(-seen[job.snapshot.obs_landmark[rows]], kind="stable")]
    job.bundle.weights[rows[1:]] = 0.0  # one point leaves it free to turn
    tracker = 0.01 * np.eye(6)
    walk.map.set_covariance([4], tracker)
    change = job.solve()
    assert change.solution.reason == "the system is singular"
    change.write(walk.map)
    np.testing.assert_array_equal(walk.map.covariance(4), tracker)
    job = walk.step()  # and what follows builds on it
    job.solve().write(walk.map)
    assert np.trace(walk.map.covariance(5)) > 0


@pytest.mark.parametrize("size", [1, 3])
def test_small_windows_work(size):
    walk = Walk(window=WindowConfig(size=size, fixed=1))
    walk.run(8)
    assert np.linalg.norm(walk.errors()[:, :3], axis=1).max() < 0.04
