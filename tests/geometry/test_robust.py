import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.geometry.robust import LOSSES, Loss

each_loss = pytest.mark.parametrize("name", LOSSES)


@each_loss
def test_weight_is_the_slope_of_the_cost(name):
    loss = Loss(name, 1.7)
    s = np.random.default_rng(1).uniform(0.0, 30.0, 500)
    s = s[np.abs(s - 1.7**2) > 1e-3]
    slope = (loss.cost(s + 1e-6) - loss.cost(s - 1e-6)) / 2e-6
    np.testing.assert_allclose(loss.weight(s), slope, atol=1e-8)


@each_loss
def test_small_residuals_count_fully_and_large_ones_less(name):
    loss = Loss(name)
    assert loss.cost(0.0) == 0.0
    assert loss.weight(0.0) == 1.0
    assert loss.weight(1e-8) == pytest.approx(1.0, abs=1e-7)
    s = np.linspace(0.0, 400.0, 2000)
    assert np.all(np.diff(loss.cost(s)) >= 0)
    assert np.all(np.diff(loss.weight(s)) <= 0)
    assert np.all(loss.cost(s) <= s + 1e-12)


@pytest.mark.parametrize("name", ["huber", "cauchy", "geman_mcclure", "tukey", "dcs"])
def test_the_default_constant_loses_five_percent_on_gaussian_noise(name):
    x = np.linspace(-12.0, 12.0, 200001)
    p = np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi) * (x[1] - x[0])
    psi = Loss(name).weight(x * x) * x
    assert np.sum(psi * x * p) ** 2 / np.sum(psi * psi * p) == pytest.approx(0.95, abs=2e-4)


def test_which_losses_let_go():
    assert Loss("tukey").weight(1e4) == 0.0
    assert Loss("truncated").weight(9.01) == 0.0
    assert Loss("huber", 1.0).weight(100.0) == pytest.approx(0.1)
    assert Loss("geman_mcclure", 2.0).cost(1e12) == pytest.approx(4.0)


def test_wrong_names_are_mended():
    with pytest.raises(ConfigError, match=r"'hubr' is unknown .did you mean 'huber'"):
        Loss("hubr")
    with pytest.raises(ConfigError, match="c is -1"):
        Loss("huber", -1.0)
