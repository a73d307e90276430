import numpy as np
import pytest

from bundleworlds import LENSES, model_of, project
from odomap.backend.adjustment.lenses import WIDTH, lens_arrays, reaches
from odomap.backend.adjustment.lenses import project as project_kernel
from odomap.backend.adjustment.problem import BAL, Adjustment, num_parameters
from odomap.errors import InputError


def lenses_of(name, theta=None):
    theta = LENSES[name] if theta is None else theta
    return lens_arrays(
        Adjustment(np.eye(4)[None], np.ones((1, 3)), [0], [0], [[0, 0]], theta, model_of(name))
    )


def look(lenses, X, theta=None, reach=None):
    """Return whether a point is seen, its pixel, and its derivatives by the point and the lens."""
    out = np.zeros((2, 16))
    theta = lenses.theta if theta is None else theta
    reach = lenses.reach[0] if reach is None else reach
    seen = project_kernel(lenses.kind[0], theta, 0, reach, *X, True, out)
    return seen, out[:, 0], out[:, 1:4], out[:, 4:]


POINTS = np.random.default_rng(3).normal((0.0, 0.0, 0.4), 1.0, (60, 3))


@pytest.mark.parametrize("name", LENSES)
def test_pixels_are_those_of_the_cameras(name):
    lenses = lenses_of(name)
    expected = project(name, LENSES[name], POINTS)
    for X, uv in zip(POINTS, expected):
        seen, pixel, _, _ = look(lenses, X)
        assert seen == np.isfinite(uv[0])
        if seen:
            np.testing.assert_allclose(pixel, uv, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_derivatives_by_point_and_lens_are_those_of_differences(name):
    lenses, checked = lenses_of(name), 0
    for X in POINTS:
        seen, uv, G, H = look(lenses, X)
        if not seen or np.abs(uv).max() > 2000:
            continue
        checked += 1
        for j in range(3):
            step = 1e-6 * np.eye(3)[j]
            ends = [look(lenses, X + sign * step, reach=np.inf)[1] for sign in (1, -1)]
            np.testing.assert_allclose(G[:, j], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=2e-3)
        for j in range(lenses.used[0]):
            h = 1e-6 * max(1.0, abs(lenses.theta[0, j]))
            step = h * np.eye(WIDTH)[j]
            ends = [look(lenses, X, lenses.theta + sign * step, np.inf)[1] for sign in (1, -1)]
            np.testing.assert_allclose(H[:, j], (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-2)
    assert checked > 10


def test_the_axis_of_a_fisheye_is_no_singularity():
    for name in ("kannala_brandt", "double_sphere"):
        seen, uv, G, H = look(lenses_of(name), (0.0, 0.0, 2.0))
        assert seen
        np.testing.assert_allclose(uv, LENSES[name][2:4])
        assert np.isfinite(G).all()
        assert np.isfinite(H).all()


def test_bal_counts_what_is_behind_as_its_data_do():
    seen, uv, _, _ = look(lenses_of(BAL), (0.1, 0.2, 2.0))
    assert seen
    np.testing.assert_allclose(uv, project(BAL, LENSES[BAL], np.array([[0.1, 0.2, 2.0]]))[0])
    assert not look(lenses_of(BAL), (0.1, 0.2, 0.0))[0]


def test_a_lens_that_is_none_has_no_reach():
    for name, at, value in (("pinhole", 0, -1.0), ("double_sphere", 5, 1.5)):
        lenses = lenses_of(name)
        lenses.theta[0, at] = value
        assert np.isnan(reaches(lenses, np.array([0]))).all()


def test_lenses_of_several_models_stand_side_by_side():
    theta = np.zeros((3, 8))
    theta[0, :8], theta[1, :6] = LENSES["radtan"], LENSES["double_sphere"]
    theta[2, :8] = LENSES["kannala_brandt"]
    problem = Adjustment(
        np.tile(np.eye(4), (3, 1, 1)),
        [[0.1, 0.2, 1.0]],
        [0, 1, 2],
        [0, 0, 0],
        np.zeros((3, 2)),
        theta,
        ("pinhole", "double_sphere", "kannala_brandt"),
    )
    lenses, out = lens_arrays(problem), np.zeros((2, 16))
    assert lenses.used.tolist() == [8, 6, 8]
    for q, name in enumerate(("radtan", "double_sphere", "kannala_brandt")):
        project_kernel(lenses.kind[q], lenses.theta, q, lenses.reach[q], 0.1, 0.2, 1.0, True, out)
        expected = project(name, LENSES[name], np.array([[0.1, 0.2, 1.0]]))[0]
        np.testing.assert_allclose(out[:, 0], expected)


def test_how_many_numbers_a_model_has():
    assert [num_parameters("pinhole", width) for width in (4, 7, 8, 9, 12)] == [4, 4, 8, 9, 12]
    with pytest.raises(InputError, match="did you mean 'pinhole'"):
        num_parameters("pinhol", 4)
    with pytest.raises(InputError, match="3 numbers per lens, double_sphere has 6"):
        num_parameters("double_sphere", 3)
