"""Locating in a map: a disturbed pose is found again, and no feature belongs to two landmarks."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.maps.views import LandmarkViews
from odomap.system.association import View
from odomap.system.localmap import LocalMap, LocalMapConfig
from odomap.system.maplocating import MapLocator
from odomap.system.uncertainty import NoiseConfig
from odomap.vision.features import Corners
from odomap.vision.matching import MatchConfig
from odomap.vision.orb import OrbConfig
from windowworlds import SCALE, flipped

CAMERA = Camera(intrinsics=(300.0, 300.0, 159.5, 119.5), resolution=(320, 240))
ORB, NOISE, SEARCH = OrbConfig(), NoiseConfig(), LocalMapConfig()
MOUNT = se3_exp(np.array([0.1, -0.05, 0.2, 0.2, -0.3, 0.1]))
NEEDED = 15
T_TRUE = se3_exp(np.array([0.4, -0.1, 0.2, 0.05, -0.08, 0.03]))
"""Where the body is, T_world_body."""


def landmarks(count=300, seed=0, relative=0.0):
    """Return a local map of points in front of a camera at the origin, mounted as here."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(2.0, 7.0, count)
    local = np.stack([*(rng.uniform(-0.6, 0.6, (2, count)) * z), z], axis=1)
    points = local @ MOUNT[:3, :3].T + MOUNT[:3, 3]
    away = points - MOUNT[:3, 3]
    distance = np.linalg.norm(away, axis=1)
    views = LandmarkViews(
        10 * np.arange(count),
        points,
        away / distance[:, None],
        rng.integers(0, 256, (count, 32), np.uint8),
        distance,
        rng.integers(0, 6, count).astype(np.uint8),
    )
    nowhere = np.full((count, 2), np.nan)
    settled = np.ones(count, np.bool_)
    return LocalMap(0, views, nowhere, np.full(count, float(relative)), settled)


def seen(local, T_world_body=T_TRUE, sigma_px=0.4, clutter=150, seed=1, lies=0, hidden=0.0):
    """Return the view of a frame, and the landmark row at each of its features, −1 for none.

    Args:
        local: what there is.
        T_world_body: (4, 4) where the body is.
        sigma_px: noise on the finest level.
        clutter: features of nothing.
        seed: of all that is random.
        lies: landmarks whose features are 5 px off.
        hidden: part of the landmarks that do not show.
    """
    rng = np.random.default_rng(seed)
    T = se3_inverse(T_world_body @ MOUNT)
    points = local.views.points_world @ T[:3, :3].T + T[:3, 3]
    closer = np.log(local.views.distance / np.linalg.norm(points, axis=1)) / np.log(SCALE)
    level = np.rint(local.views.level + closer).astype(int).clip(0, 7)
    pixels = CAMERA.project(points) + sigma_px * SCALE ** level[:, None] * rng.normal(
        size=(len(points), 2)
    )
    who = np.flatnonzero(CAMERA.is_inside(pixels, 3.0) & (points[:, 2] > 0.1))
    who = who[rng.random(len(who)) >= hidden]
    liars = rng.choice(who, lies, replace=False)
    angle = rng.uniform(0, 2 * np.pi, lies)
    pixels[liars] += 5.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    keypoints = np.concatenate([pixels[who], rng.uniform(5, 235, (clutter, 2))])
    descriptors = np.concatenate(
        [
            flipped(local.views.descriptors[who], 0.05, rng),
            rng.integers(0, 256, (clutter, 32), np.uint8),
        ]
    )
    level = np.concatenate([level[who], rng.integers(0, 8, clutter)]).astype(np.uint8)
    who = np.concatenate([who, np.full(clutter, -1)])
    order = rng.permutation(len(who))
    corners = Corners(keypoints[order].astype(np.float32), np.ones(len(who)), level[order])
    blank = np.zeros((240, 320), np.uint8)
    return View(0, 0, (blank,), corners, descriptors[order]), who[order], liars


def locate(local, view, guess, likely=None, needed=NEEDED, search=SEARCH):
    locator = MapLocator(CAMERA, MOUNT, ORB, MatchConfig(), search, NOISE)
    rows = np.arange(len(local)) if likely is None else likely
    return locator.locate(view, local, rows, guess, needed)


def off_by(metres, degrees, seed=3):
    xi = np.random.default_rng(seed).normal(size=6)
    xi[:3] *= metres / np.linalg.norm(xi[:3])
    xi[3:] *= np.radians(degrees) / np.linalg.norm(xi[3:])
    return T_TRUE @ se3_exp(xi)


def error(located):
    return se3_log(se3_inverse(T_TRUE) @ located.T_world_body)


def row_at(view, who, located):
    """Return the landmark row (n,) that is truly at each pixel found."""
    keypoints = view.corners.keypoints.astype(np.float64)
    at = [int(np.flatnonzero((keypoints == p).all(axis=1))[0]) for p in located.pixels]
    return who[at]


@pytest.mark.parametrize("seed", range(5))
def test_a_disturbed_pose_is_found(seed):
    local = landmarks()
    view, who, _ = seen(local, seed=seed)
    located = locate(local, view, off_by(0.05, 0.8, seed))
    off = error(located)
    assert np.linalg.norm(off[:3]) < 0.02
    assert np.linalg.norm(off[3:]) < np.radians(0.3)
    assert located.num_inliers > 0.8 * (who >= 0).sum()
    right = row_at(view, who, located) == located.rows
    assert right[located.inliers].mean() > 0.98


def test_the_covariance_is_that_of_the_error():
    """The factor for errors that observations share is not for those that share none."""
    local, nees = landmarks(), []
    for seed in range(30):
        view, _, _ = seen(local, seed=seed)
        located = locate(local, view, off_by(0.03, 0.5, seed))
        covariance = located.covariance / NOISE.overlap
        nees.append(error(located) @ np.linalg.solve(covariance, error(located)) / 6)
    assert 0.6 < np.mean(nees) < 1.6


def test_lies_are_no_inliers():
    local = landmarks()
    view, who, liars = seen(local, lies=40)
    located = locate(local, view, off_by(0.03, 0.5))
    assert np.linalg.norm(error(located)[:3]) < 0.02
    lied = np.isin(located.rows, liars) & (row_at(view, who, located) == located.rows)
    fine = view.corners.level[[np.flatnonzero(who == r)[0] for r in located.rows[lied]]] <= 2
    assert lied.sum() > 10
    assert not located.inliers[lied][fine].any()


@pytest.mark.parametrize("guess", [(0.0, 0.0), (0.05, 0.8), (0.2, 3.0)])
def test_no_feature_belongs_to_two_landmarks(guess):
    """Also where every landmark has a twin that looks the same, right beside it."""
    local = landmarks()
    rng = np.random.default_rng(7)
    v = local.views
    twice = LandmarkViews(
        np.concatenate([v.ids, v.ids + 1]),
        np.concatenate([v.points_world, v.points_world + 0.002 * rng.normal(size=(300, 3))]),
        np.concatenate([v.normals, v.normals]),
        np.concatenate([v.descriptors, flipped(v.descriptors, 0.02, rng)]),
        np.concatenate([v.distance, v.distance]),
        np.concatenate([v.level, v.level]),
    )
    doubled = LocalMap(0, twice, np.full((600, 2), np.nan), np.zeros(600), np.ones(600, np.bool_))
    view, _, _ = seen(local)
    # Half of them are likely, the twins are looked for afterwards.
    located = locate(doubled, view, off_by(*guess), likely=np.arange(300))
    assert len(located.rows) > 0
    assert len(np.unique(located.rows)) == len(located.rows)
    assert len(np.unique(located.pixels, axis=0)) == len(located.pixels)


def test_what_was_shown_last_leads_to_the_rest():
    local = landmarks()
    view, who, _ = seen(local)
    shown = np.unique(who[who >= 0])
    likely = shown[::4]
    located = locate(local, view, off_by(0.03, 0.5), likely=likely)
    assert located.num_inliers > 0.8 * len(shown)
    assert np.setdiff1d(located.rows[located.inliers], likely).size > 0.5 * len(shown)


def test_it_says_how_many_were_expected():
    local = landmarks()
    view, who, _ = seen(local, hidden=0.5)
    truly = locate(local, view, T_TRUE)
    T = se3_inverse(T_TRUE @ MOUNT)
    points = local.views.points_world @ T[:3, :3].T + T[:3, 3]
    inside = (CAMERA.is_inside(CAMERA.project(points), 2.0) & (points[:, 2] > 0)).sum()
    # Half of them do not show, and are expected all the same.
    assert 0.8 * inside <= truly.expected <= inside
    assert len(truly.rows) < 0.65 * truly.expected
    assert len(truly.rows) > 0.8 * (who >= 0).sum()
    # Where too few of those shown last are found, no others are looked for.
    likely = np.unique(who[who >= 0])[:10]
    alone = locate(local, view, T_TRUE, likely=likely)
    assert alone.expected == len(alone.rows) == 10


def test_a_guess_too_far_off_is_not_believed():
    local = landmarks()
    view, _, _ = seen(local)
    located = locate(local, view, off_by(0.0, 20.0))
    assert located.num_inliers < NEEDED
    assert np.isfinite(located.T_world_body).all()
    turned = T_TRUE @ se3_exp(np.array([0, 0, 0, 0, np.pi, 0]))
    nothing = locate(local, view, turned)
    assert nothing.num_inliers == 0
    assert len(nothing.rows) == len(nothing.pixels) == 0


def test_a_wider_search_reaches_farther():
    local = landmarks()
    view, _, _ = seen(local)
    guess = off_by(0.0, 4.5)
    narrow = locate(local, view, guess, search=replace(SEARCH, first_radius_px=3.0))
    wide = locate(local, view, guess, search=replace(SEARCH, first_radius_px=40.0))
    assert narrow.num_inliers < 0.2 * wide.num_inliers
    assert np.linalg.norm(error(wide)[3:]) < np.radians(0.3)


def test_an_image_without_features():
    local = landmarks()
    view, _, _ = seen(local, clutter=0, hidden=1.0)
    assert len(view.descriptors) == 0
    located = locate(local, view, T_TRUE)
    assert located.num_inliers == 0
    assert located.expected > 100
    assert np.isfinite(located.covariance).all()


def test_an_empty_local_map():
    local = landmarks()
    view, _, _ = seen(local)
    located = locate(landmarks(0), view, T_TRUE)
    assert (located.num_inliers, located.expected) == (0, 0)


def test_landmarks_of_unsure_depth_count_less_across_their_ray():
    """Points pushed along the ray they were seen on mislead, unless they say that they may."""
    local = landmarks()
    view, _, _ = seen(local, sigma_px=0.2)
    rng = np.random.default_rng(2)
    v = local.views
    pushed = v.points_world + 0.1 * rng.normal(size=(300, 1)) * v.distance[:, None] * v.normals
    wrong = replace(v, points_world=pushed)
    sure = replace(local, views=wrong)
    unsure = replace(sure, relative=np.full(300, 0.1))
    search = replace(SEARCH, radius_px=12.0)
    blind, warned = (locate(x, view, T_TRUE, search=search) for x in (sure, unsure))
    assert warned.num_inliers > 1.2 * blind.num_inliers
    assert np.trace(warned.covariance) > 2 * np.trace(locate(local, view, T_TRUE).covariance)
    assert np.linalg.norm(error(warned)[:3]) < 0.1


def test_the_same_view_gives_the_same_bytes():
    local = landmarks()
    view, _, _ = seen(local)
    one, two = (locate(local, view, off_by(0.05, 0.8)) for _ in range(2))
    np.testing.assert_array_equal(one.T_world_body, two.T_world_body)
    np.testing.assert_array_equal(one.rows, two.rows)
