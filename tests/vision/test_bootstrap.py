"""Two views of one camera: motion where it can be told, waiting with a reason where not."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.vision.bootstrap import (
    BetweenView,
    BootstrapConfig,
    rotation_parallax,
    two_view_motion,
)

CAMERA = Camera(intrinsics=(420.0, 425.0, 318.0, 242.0), resolution=(640, 480))
CONFIG = BootstrapConfig()
MOVE = SE3.exp([-0.35, 0.08, 0.1, 0.03, -0.05, 0.02])
"""T_second_first of the motions here: forty centimetres, three degrees."""


class Views:
    """Points seen from the first camera, from the second, and from three between."""

    def __init__(self, points, move=MOVE, noise_px=0.3, outliers=0.0, seed=0, between=3):
        rng = np.random.default_rng(seed)
        self.points, self.move = points, move
        n = len(points)

        def seen(T):
            return CAMERA.project(T @ points) + rng.normal(0, noise_px, (n, 2))

        self.first, self.second = seen(SE3.identity()), seen(move)
        self.wrong = rng.permutation(n) < outliers * n
        self.second[self.wrong] = rng.uniform(0, [640, 480], (self.wrong.sum(), 2))
        twist = move.log()
        # A hand neither moves evenly nor straight.
        self.between = []
        for k in range(between):
            s = (k + 1) / (between + 1)
            bend = 0.02 * np.sin(np.pi * s) * np.array([0, 1, 0, 0, 0, 1])
            rows = np.sort(rng.permutation(n)[: int(0.9 * n)])
            self.between.append(BetweenView(rows, seen(SE3.exp(s**1.2 * twist + bend))[rows]))

    def solve(self, config=CONFIG, seed=1, between=True):
        views = self.between if between else ()
        return two_view_motion(self.first, self.second, CAMERA, config, seed, views)


def cloud(n=300, seed=0, near=2.5, far=9.0):
    rng = np.random.default_rng(seed)
    z = rng.uniform(near, far, n)
    xy = rng.uniform([-0.6, -0.45], [0.6, 0.45], (n, 2))
    return np.column_stack([xy * z[:, None], z])


def wall(n=300, seed=0, normal=(0.3, -0.15, 1.0), distance=3.0):
    """Points on a slanted plane that fills the image."""
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform([-0.6, -0.45], [0.6, 0.45], (n, 2)), np.ones(n)])
    normal = np.array(normal) / np.linalg.norm(normal)
    return rays * (distance / (rays @ normal))[:, None]


def errors_deg(found, move):
    """Return how far rotation and direction of translation are off."""
    turn = np.linalg.norm((found.T_second_first.inverse() @ move).log()[3:])
    along = found.T_second_first.t @ move.t / np.linalg.norm(move.t)
    return np.degrees(turn), np.degrees(np.arccos(np.clip(along, -1, 1)))


@pytest.mark.parametrize("seed", range(6))
def test_a_general_scene_tells_the_motion(seed):
    views = Views(cloud(seed=seed), seed=seed)
    found = views.solve()
    assert found.reason == ""
    assert not found.is_plane
    assert np.linalg.norm(found.T_second_first.t) == pytest.approx(1.0)
    turn, along = errors_deg(found, MOVE)
    assert turn < 0.3
    assert along < 2.0
    # Points are in units of the baseline.
    known = np.isfinite(found.points_first[:, 0])
    assert known.mean() > 0.9
    scaled = found.points_first * np.linalg.norm(MOVE.t)
    relative = np.abs(scaled[known, 2] / views.points[known, 2] - 1)
    assert np.median(relative) < 0.03
    there = np.linalg.norm(views.points - MOVE.inverse().t, axis=1)
    here = np.linalg.norm(views.points, axis=1)
    base = np.linalg.norm(MOVE.t)
    true = np.arccos((here**2 + there**2 - base**2) / (2 * here * there))
    assert np.median(np.abs(found.parallax - true)[known]) < 0.003
    assert (found.parallax[~known] == 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_third_of_outliers(seed):
    views = Views(cloud(seed=seed), outliers=0.3, seed=seed)
    found = views.solve(seed=seed)
    turn, along = errors_deg(found, MOVE)
    assert turn < 0.4
    assert along < 3.0
    known = np.isfinite(found.points_first[:, 0])
    assert known[~views.wrong].mean() > 0.9
    assert known[views.wrong].mean() < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_is_decided_by_the_views_between(seed):
    normal = np.random.default_rng(seed).normal([0, 0, 1.5], 0.35)
    views = Views(wall(seed=seed, normal=normal), seed=seed)
    found = views.solve()
    alone = views.solve(between=False)
    # Two views of a plane may leave two motions; then only the views between tell.
    for answer in (found, alone):
        if answer.T_second_first is None:
            assert "two motions" in answer.reason
        else:
            turn, along = errors_deg(answer, MOVE)
            assert turn < 1.0
            assert along < 8.0
    if found.T_second_first is None:
        assert alone.T_second_first is None


def test_some_planes_wait_without_the_views_between_and_start_with_them():
    """The point of the views between, over many planes and a longer way."""
    move = SE3.exp([-0.9, 0.2, 0.15, 0.02, -0.22, 0.03])
    waited, started = 0, 0
    for seed in range(5):
        normal = np.random.default_rng(100 + seed).normal([0, 0, 1.2], 0.3)
        views = Views(wall(seed=seed, normal=normal), move, noise_px=0.2, seed=seed)
        alone, found = views.solve(between=False), views.solve()
        for answer in (alone, found):
            if answer.T_second_first is not None:
                turn, along = errors_deg(answer, move)
                assert turn < 1.0
                assert along < 5.0
        waited += alone.T_second_first is None
        started += alone.T_second_first is None and found.T_second_first is not None
    assert waited >= 3
    assert started == waited


@pytest.mark.parametrize("turn_deg", [0.0, 2.0, 10.0])
def test_a_camera_that_only_turns_waits(turn_deg):
    turn = SE3.exp(np.radians(turn_deg) * np.array([0, 0, 0, 0.3, 0.9, 0.2]))
    for points in (cloud(), wall()):
        found = Views(points, turn).solve()
        assert found.T_second_first is None
        assert found.reason.startswith("parallax of ")
        assert "1.5 px needed: move the camera sideways" in found.reason
        assert found.points_first.shape == (300, 3)
        assert np.isnan(found.points_first).all()


def test_the_threshold_of_parallax():
    small = SE3.exp(MOVE.log() * 0.4)
    views = Views(cloud(near=4.0), small)
    normalised = [CAMERA.undistort(p) for p in (views.first, views.second)]
    parallax_px = CAMERA.fx * rotation_parallax(*normalised)
    assert parallax_px > 1.5
    above = replace(CONFIG, min_parallax_px=0.95 * parallax_px)
    below = replace(CONFIG, min_parallax_px=1.05 * parallax_px)
    assert views.solve(above).T_second_first is not None
    assert "parallax" in views.solve(below).reason


def test_too_few_matches():
    found = Views(cloud(59)).solve()
    assert found.T_second_first is None
    assert found.reason == "59 matches of 60 needed"
    none = two_view_motion(np.empty((0, 2)), np.empty((0, 2)), CAMERA, CONFIG, 0)
    assert none.reason == "0 matches of 60 needed"


def test_matches_of_nothing_fit_no_motion():
    rng = np.random.default_rng(3)
    first, second = rng.uniform(0, [640, 480], (2, 120, 2))
    found = two_view_motion(first, second, CAMERA, CONFIG, 0)
    assert found.T_second_first is None
    assert "fit one motion" in found.reason


def test_the_same_matches_and_seed_give_the_same_bytes():
    views = Views(cloud(), outliers=0.2)
    a, b, other = views.solve(), views.solve(), views.solve(seed=2)
    np.testing.assert_array_equal(a.points_first, b.points_first)
    np.testing.assert_array_equal(a.T_second_first.matrix, b.T_second_first.matrix)
    # Another seed draws other samples, and means the same motion.
    assert max(errors_deg(other, a.T_second_first)) < 1.5


@pytest.mark.parametrize("seed", range(4))
def test_rotation_parallax_is_zero_for_a_turn(seed):
    rng = np.random.default_rng(seed)
    turn = SE3.exp(np.concatenate([np.zeros(3), rng.normal(0, 0.15, 3)]))
    points = cloud(seed=seed)
    moved = turn @ points
    a, b = (p[:, :2] / p[:, 2:] for p in (points, moved))
    assert rotation_parallax(a, b) < 1e-9
    # With an outlier in four still hardly any.
    wrong = rng.random(len(b)) < 0.25
    b[wrong] += rng.uniform(-0.3, 0.3, (wrong.sum(), 2))
    assert rotation_parallax(a, b) < 2e-3


def test_rotation_parallax_is_that_of_the_median_point():
    """Far points tell the turn; half of them are near and move by b / z."""
    rng = np.random.default_rng(0)
    far, near = cloud(140, near=300.0, far=500.0), cloud(160, seed=1, near=2.0, far=2.0)
    points = np.concatenate([far, near])
    move = SE3.exp([-0.05, 0, 0, 0, 0.1, 0.02])
    moved = move @ points
    a, b = (p[:, :2] / p[:, 2:] for p in (points, moved))
    order = rng.permutation(len(a))
    found = rotation_parallax(a[order], b[order])
    assert 0.0 < found < 0.05 / 2.0 * 1.05
