import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.ransac import draw_samples, ransac, samples_needed


def line_data(n=200, outliers=0.5, seed=1):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-5, 5, n)
    y = 0.7 * x - 2.0 + 0.01 * rng.normal(size=n)
    bad = rng.permutation(n) < outliers * n
    y[bad] = rng.uniform(-10, 10, bad.sum())
    return x, y, bad


def fit_line(x, y, seed, polished=True, **options):
    def fit(rows):
        slope = (y[rows[:, 1]] - y[rows[:, 0]]) / (x[rows[:, 1]] - x[rows[:, 0]])
        return list(np.stack([slope, y[rows[:, 0]] - slope * x[rows[:, 0]]], axis=1))

    def polish(model, rows):
        return np.polyfit(x[rows], y[rows], 1)

    return ransac(
        len(x),
        2,
        fit,
        lambda m: np.abs(m[0] * x + m[1] - y),
        0.05,
        seed,
        polish=polish if polished else None,
        **options,
    )


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5, 0.7])
def test_a_line_is_found_among_outliers(outliers):
    x, y, bad = line_data(outliers=outliers)
    for seed in range(5):
        found = fit_line(x, y, seed)
        np.testing.assert_allclose(found.model, [0.7, -2.0], atol=0.01)
        assert found.inliers[~bad].mean() > 0.99
        assert found.num_inliers == found.inliers.sum()
        r = np.minimum(np.abs(found.model[0] * x + found.model[1] - y), 0.05)
        assert found.cost == pytest.approx(np.sum(r * r))


def test_the_seed_decides_everything():
    x, y, _ = line_data()
    np.random.seed(0)  # noqa: NPY002
    first = fit_line(x, y, 7)
    np.random.seed(1)  # noqa: NPY002
    second = fit_line(x, y, 7)
    np.testing.assert_array_equal(first.model, second.model)
    assert first.iterations == second.iterations
    # Without polishing each seed keeps the noise of its own sample.
    models = {tuple(fit_line(x, y, seed, polished=False).model) for seed in range(4)}
    assert len(models) == 4


def test_polishing_lowers_the_cost():
    x, y, _ = line_data()
    for seed in range(5):
        assert fit_line(x, y, seed).cost <= fit_line(x, y, seed, polished=False).cost


def test_it_stops_early_when_the_data_are_clean_and_late_when_not():
    assert fit_line(*line_data(outliers=0.0)[:2], 1, batch=1).iterations == 1
    dirty = fit_line(*line_data(outliers=0.8)[:2], 1, batch=8).iterations
    assert 50 < dirty <= 400


def test_no_model_is_said():
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-5, 5, 50), rng.uniform(-500, 500, 50)
    found = fit_line(x, y, 1, min_inliers=10, max_iterations=100)
    assert found.model is None
    assert found.num_inliers == 0
    assert found.iterations == 100
    assert fit_line(x[:1], y[:1], 1).model is None
    nothing = ransac(9, 2, lambda rows: [], lambda m: np.zeros(9), 1.0, 0, max_iterations=5)
    assert nothing.model is None


@pytest.mark.parametrize(("n", "k"), [(5, 5), (6, 3), (9, 4), (1000, 5)])
def test_samples_have_no_repetition_and_reach_every_row(n, k):
    samples = draw_samples(n, k, 4000, np.random.default_rng(1))
    assert samples.shape == (4000, k)
    ordered = np.sort(samples, axis=1)
    assert np.all(ordered[:, 1:] > ordered[:, :-1])
    assert np.array_equal(np.unique(samples), np.arange(n))
    counts = np.bincount(samples.ravel(), minlength=n) / (4000 * k / n)
    assert 0.3 < counts.min() <= counts.max() < 2.5


def test_samples_needed_is_the_textbooks():
    assert samples_needed(0.5, 4, 0.99, 10000) == 72
    assert samples_needed(1.0, 5, 0.99, 10000) == 1
    assert samples_needed(0.0, 5, 0.99, 10000) == 10000
    assert samples_needed(0.1, 8, 0.99, 500) == 500
    assert samples_needed(1e-6, 5, 0.99, 500) == 500
    assert samples_needed(1e-3, 4, 0.99, 10**15) == pytest.approx(4.605e12, rel=1e-3)


@pytest.mark.parametrize(
    ("threshold", "confidence", "words"), [(0.0, 0.9, "threshold"), (1.0, 1.0, "confidence")]
)
def test_wrong_input_is_named(threshold, confidence, words):
    with pytest.raises(InputError, match=words):
        ransac(5, 2, lambda rows: [], lambda m: np.zeros(5), threshold, 0, confidence)
