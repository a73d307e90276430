"""Clouds are found in each other however they lie, and what could be another way is said."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import odomap
from lidarworlds import ROOM, ROOM_2D, Outline, Walls, X, Y, Z
from odomap.errors import InputError
from odomap.geometry.horn_kernels import horn_into
from odomap.lidar import globalalign
from odomap.lidar.descriptors import BINS, describe
from odomap.lidar.globalalign import candidates

PLAN = (
    (3 * Y, 4 * X, 0 * Z), (-3 * Y + X, 3 * X, 0 * Z), (4 * X + Y, 2 * Y, 0 * Z),
    (-4 * X, 3 * Y, 0 * Z), (X, Y, 0 * Z),
)  # fmt: skip
FLAT = Outline(Walls(*PLAN, each=500))
HALL = Walls(
    (3 * Y, 4 * X, 1.5 * Z), (-3 * Y, 4 * X, 1.5 * Z), (-1.5 * Z, 4 * X, 3 * Y),
    (4 * X, 3 * Y, 1.5 * Z), (-4 * X, 3 * Y, 1.5 * Z), (2 * X + Y, 0.6 * Y, 1.0 * Z),
    (2 * X + Y - 0.5 * Z, 0.8 * X, 0.6 * Y), (-2 * X - 2 * Y, 0.5 * X + 0.5 * Y, 1.2 * Z),
    each=3000,
)  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_a_room_turned_and_moved_anyhow_is_found(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.uniform(-50, 50, 3)
    source = HALL.seen(rng) @ T[:3, :3].T + T[:3, 3]
    found = odomap.register(source, HALL.seen(rng), initial="global")
    off = found.T_target_source @ T
    assert found.converged
    assert np.abs(off[:3, 3]).max() < 0.02
    assert np.abs(off[:3, :3] - np.eye(3)).max() < 0.005


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", ["gicp", "icp"])
def test_a_plan_turned_and_moved_anyhow_is_found(seed, method):
    rng = np.random.default_rng(seed)
    T = odomap.SE2.from_parts(rng.uniform(-np.pi, np.pi), rng.uniform(-20, 20, 2)).matrix
    source = FLAT.seen(rng) @ T[:2, :2].T + T[:2, 2]
    found = odomap.register(source, FLAT.seen(rng), method, initial="global", voxel=0.1)
    off = found.se2 @ T
    assert np.abs(off[:2, 2]).max() < (0.05 if method == "icp" else 0.01)
    assert np.abs(off[:2, :2] - np.eye(2)).max() < 0.01


def test_a_part_of_a_plan_is_found():
    rng = np.random.default_rng(3)
    source = FLAT.seen(rng)
    source = source[source[:, 0] > 0] @ [[0.0, 1.0], [-1.0, 0.0]] + [7.0, -9.0]
    found = odomap.register(source, FLAT.seen(rng), initial="global", voxel=0.1)
    expected = np.linalg.inv([[0, -1, 7.0], [1, 0, -9.0], [0, 0, 1]])
    np.testing.assert_allclose(found.se2, expected, atol=0.03)


def test_what_fits_two_ways_is_said():
    rng = np.random.default_rng(4)
    found = odomap.register(ROOM_2D.seen(rng), ROOM_2D.seen(rng), initial="global", voxel=0.1)
    assert found.reason.startswith("ambiguous")
    assert "180°" in found.reason
    plain = odomap.register(FLAT.seen(rng), FLAT.seen(rng), initial="global", voxel=0.1)
    assert not plain.reason


def test_the_same_seed_gives_the_same_bytes():
    rng = np.random.default_rng(5)
    pair = HALL.seen(rng) + 30.0, HALL.seen(rng)
    a, b = (odomap.register(*pair, initial="global") for _ in range(2))
    assert a.T_target_source.tobytes() == b.T_target_source.tobytes()


def test_descriptors_do_not_change_with_the_frame_or_the_signs_of_normals():
    rng = np.random.default_rng(6)
    points = rng.normal(size=(300, 3))
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    plain = describe(points, normals, 1.0)
    R = Rotation.random(random_state=1).as_matrix()
    flipped = normals * rng.choice([-1.0, 1.0], (300, 1))
    moved = describe(points @ R.T + 4.0, flipped @ R.T, 1.0)
    assert (np.abs(plain - moved).max(axis=1) < 1e-9).mean() > 0.99  # a bin's edge may be crossed
    sums = plain.reshape(300, 3, BINS).sum(axis=2)
    assert np.all(np.isclose(sums, 1.0) | (sums == 0.0))


def test_a_sample_is_scored_by_the_pairs_that_agree_with_it():
    rng = np.random.default_rng(7)
    p = rng.uniform(-5, 5, (40, 3))
    R = Rotation.random(random_state=2).as_matrix()
    q = p @ R.T + [1.0, 2.0, 3.0]
    q[20:] += rng.normal(size=(20, 3)) * 5.0
    samples = np.array([[0, 5, 9], [0, 25, 9], [3, 3, 4]])
    scores = np.zeros(3)
    globalalign._score_kernel(samples, p, q, 0.9, 0.1, 0.25, scores)
    assert scores[0] == pytest.approx(20.0, abs=1.0)
    assert scores[1] == scores[2] == 0.0
    R2, t2 = np.empty((3, 3)), np.empty(3)
    horn_into(p, q, samples[0], False, R2, t2, np.empty((4, 4)), np.empty((4, 4)))
    np.testing.assert_allclose(R2, R, atol=1e-9)


def test_clouds_without_surfaces_have_no_candidates():
    rng = np.random.default_rng(8)
    cloud = rng.uniform(-1, 1, (100, 3)), np.zeros((100, 3))
    assert candidates(cloud, cloud, 0.1, False, 0) == []
    found = odomap.register(
        np.outer(np.arange(50.0), [1, 1, 0]), ROOM.seen(rng), initial="global", voxel=0.3
    )
    assert not found.converged or found.reason


def test_another_word_is_refused():
    with pytest.raises(InputError, match="'local' is unknown"):
        odomap.register(np.eye(9, 3), np.eye(9, 3), initial="local", voxel=0.0)


def test_warm_up_compiles_all():
    globalalign.warm_up()
    assert globalalign._score_kernel.signatures
