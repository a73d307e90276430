import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.simulation.bundle import bundle_world


@pytest.mark.parametrize("model", ["pinhole", "bal"])
def test_the_truth_explains_the_pixels_to_the_noise(model):
    world = bundle_world(80, 500, model=model, sigma_px=0.5)
    problem, Ts = world.problem, world.Ts_camera_world
    X = np.einsum("nij,nj->ni", Ts[problem.view, :3, :3], world.points_world[problem.point])
    X += Ts[problem.view, :3, 3]
    if model == "pinhole":
        uv = Camera("pinhole", world.intrinsics[0], (), (640, 480)).project(X)
    else:
        q = -X[:, :2] / X[:, 2:]
        s = np.sum(q * q, axis=1)
        f, k1, k2 = world.intrinsics[problem.view].T
        uv = (f * (1 + k1 * s + k2 * s * s))[:, None] * q
        assert (X[:, 2] < 0).all()
    error = uv - problem.pixels
    assert error.std() == pytest.approx(0.5, rel=0.05)
    assert abs(error.mean()) < 0.03
    assert (problem.weights == 2.0).all()


def test_points_are_seen_as_often_as_asked_and_across_laps():
    world = bundle_world(100, 800, tracks=(5, 7))
    problem = world.problem
    times = np.bincount(problem.point, minlength=800)
    assert (times.min(), times.max()) == (5, 7)
    assert np.unique(problem.view * 800 + problem.point).size == problem.num_observations
    laps = np.zeros((800, 2), bool)
    laps[problem.point, problem.view // 50] = True
    assert laps.all(axis=1).mean() > 0.5


def test_the_start_is_off_and_the_same_seed_gives_the_same_bytes():
    a, b, c = (bundle_world(60, 100, seed=seed) for seed in (1, 1, 2))
    assert a.problem.pixels.tobytes() == b.problem.pixels.tobytes()
    assert a.problem.points_world.tobytes() == b.problem.points_world.tobytes()
    assert a.problem.pixels.shape != c.problem.pixels.shape or not np.array_equal(
        a.problem.pixels, c.problem.pixels
    )
    off = a.problem.points_world - a.points_world
    assert off.std() == pytest.approx(0.2, rel=0.2)


def test_what_it_cannot_make_is_refused():
    with pytest.raises(InputError, match="59 views"):
        bundle_world(59, 100)
    with pytest.raises(InputError, match="model 'fisheye'"):
        bundle_world(60, 100, model="fisheye")
