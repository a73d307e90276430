"""Places are told by what they look like from above, whichever way one comes."""

import numpy as np
import pytest

from cloudworlds import Street
from odomap.geometry.lie import se3_inverse, so3_exp
from odomap.lidar.scancontext import Contexts, Layout, compare, describe, leveled

LAYOUT = Layout()


def turned(points, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T


@pytest.fixture(scope="module")
def street():
    return Street(3)


@pytest.fixture(scope="module")
def clouds(street):
    """Keyframes once round, and their poses."""
    Ts = street.drive(0, 200, seed=1)
    return [street.cloud(T, k)[:, :3].astype(float) for k, T in enumerate(Ts)], Ts


def plain(points, layout):
    """The formula, bin by bin."""
    out = np.zeros((layout.rings, layout.sectors))
    floor = np.sort(points[:, 2])[int(0.05 * len(points))] - 0.3
    ring = np.hypot(points[:, 0], points[:, 1]) / layout.reach * layout.rings
    sector = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * layout.sectors
    inside = ring < layout.rings
    at = ring[inside].astype(int), np.minimum(sector[inside].astype(int), layout.sectors - 1)
    np.maximum.at(out, at, np.maximum(points[inside, 2] - floor, 1e-3))
    return out / np.maximum(np.linalg.norm(out, axis=0), 1e-12)


def plain_distance(A, B):
    both = lambda n: (A.any(axis=0)) & (np.roll(B, -n, axis=1).any(axis=0))  # noqa: E731
    best = []
    for n in range(A.shape[1]):
        cosines = (A * np.roll(B, -n, axis=1)).sum(axis=0)[both(n)]
        fullest = max(A.any(axis=0).sum(), B.any(axis=0).sum())
        best.append(1 - cosines.sum() / max(len(cosines), 0.5 * fullest))
    return min(best), int(np.argmin(best))


def test_a_description_and_a_comparison_are_what_the_formulas_say(clouds):
    points, others = clouds[0][0], clouds[0][30]
    one, other = describe(points, LAYOUT), describe(others, LAYOUT)
    assert np.allclose(one.columns, plain(points, LAYOUT), atol=1e-6)
    distance, yaw = compare(one, other)
    expected, shift = plain_distance(plain(points, LAYOUT), plain(others, LAYOUT))
    assert distance == pytest.approx(expected, abs=1e-5)
    assert np.cos(yaw - shift / LAYOUT.sectors * 2 * np.pi) == pytest.approx(1.0)


@pytest.mark.parametrize("sectors", [7, -11, 18])
def test_turning_shifts_the_columns_and_leaves_the_key(clouds, sectors):
    points, yaw = clouds[0][5], sectors / LAYOUT.sectors * 2 * np.pi
    one, other = describe(points, LAYOUT), describe(turned(points, yaw + 1e-9), LAYOUT)
    assert np.allclose(one.key, other.key, atol=2e-3)
    distance, found = compare(one, other)
    assert distance < 1e-3
    assert np.cos(found - yaw) == pytest.approx(1.0, abs=1e-6)


def test_no_comparison_is_better_than_the_product_of_the_keys(clouds):
    """What is most alike is among those whose keys say that it may be."""
    looks = [describe(points, LAYOUT) for points in clouds[0][::8]]
    for one in looks:
        for other in looks:
            seen = [c.columns.any(axis=0).sum() for c in (one, other)]
            common = 1.0 - compare(one, other)[0]
            assert common * 0.5 * max(seen) <= one.key @ other.key * LAYOUT.sectors + 1e-3


def test_what_hardly_anything_was_seen_of_is_like_nothing():
    nothing = describe(np.zeros((0, 3)), LAYOUT)
    beyond = describe(np.full((10, 3), 500.0), LAYOUT)
    assert not nothing.columns.any()
    assert not beyond.columns.any()
    assert compare(nothing, nothing)[0] == 1.0
    places = Contexts(LAYOUT)
    assert places.search([nothing]) == []
    places.enter(4, nothing)
    assert [alike.distance for alike in places.search([beyond])] == [1.0]


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("backwards", [False, True])
def test_places_are_recognised_from_either_direction(clouds, street, seed, backwards):
    """In nine of ten, on the other side of the road, and the guess is good for registration."""
    known, Ts = clouds
    places = Contexts(LAYOUT)
    for k, points in enumerate(known):
        places.enter(k, describe(points @ leveled(Ts[k][2, :3]).T, LAYOUT))
    way = (190, 10) if backwards else (10, 190)
    back = street.drive(*way, left=1.75 if backwards else -1.4, seed=10 + seed)[::6]
    right, turns = [], []
    for n, T in enumerate(back):
        points = street.cloud(T, 1000 * seed + n)[:, :3] @ leveled(T[2, :3]).T
        besides = (-4.0, -2.0, 0.0, 2.0, 4.0)
        best = places.search([describe(points, LAYOUT, beside) for beside in besides])[0]
        true = se3_inverse(Ts[best.id]) @ T
        is_right = np.linalg.norm(true[:3, 3]) < 8.0
        right.append(is_right)
        if is_right:
            off = true[:2, 3] - best.T_place_sensor[:2, 3]
            turns.append([abs(np.sin(best.yaw - np.arctan2(true[1, 0], true[0, 0]))), *abs(off)])
    assert np.mean(right) >= 0.9
    assert np.mean(np.array(turns)[:, 0] < 0.25) >= 0.9
    assert np.median(np.linalg.norm(np.array(turns)[:, 1:], axis=1)) < 2.5


def test_only_what_is_allowed_is_found_and_what_is_forgotten_is_not(clouds):
    places = Contexts(LAYOUT)
    for k, points in enumerate(clouds[0]):
        places.enter(100 + k, describe(points, LAYOUT))
    look = describe(clouds[0][20], LAYOUT)
    assert places.search([look])[0].id == 120
    allowed = np.arange(140, 160)
    assert {alike.id for alike in places.search([look], allowed)} == set(allowed.tolist())
    places.keep(np.arange(100, 120))
    assert len(places) == 20
    assert places.ids.max() == 119
    assert 120 not in {alike.id for alike in places.search([look])}


def test_any_direction_is_turned_up_by_the_shortest_way():
    rng = np.random.default_rng(0)
    for up in (*rng.normal(size=(20, 3)), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])):
        R, u = leveled(up), up / np.linalg.norm(up)
        assert np.allclose(R @ u, [0, 0, 1])
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert np.trace(R) == pytest.approx(1 + 2 * u[2])  # by the angle between the two
    yawed = so3_exp(np.array([0.0, 0.0, 2.0]))
    assert np.allclose(leveled(yawed[2]), np.eye(3))
