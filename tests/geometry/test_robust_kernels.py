"""Losses inside kernels are those of NumPy."""

import numpy as np
import pytest

from odomap.geometry.robust import LOSSES, Loss
from odomap.geometry.robust_kernels import LOSS_CODES, loss_code, loss_cost, loss_weight


@pytest.mark.parametrize("c", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("name", LOSSES)
def test_a_kernel_is_its_twin(name, c):
    loss = Loss(name, c)
    code, width = loss_code(loss)
    random = np.random.default_rng(0).exponential(4.0 * width**2, 200)
    s = np.concatenate([[0.0, 1e-12, width**2 * (1 - 1e-9), width**2 * (1 + 1e-9), 1e9], random])
    costs = np.array([loss_cost(code, width, one) for one in s])
    weights = np.array([loss_weight(code, width, one) for one in s])
    np.testing.assert_allclose(costs, loss.cost(s), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(weights, loss.weight(s), rtol=1e-12, atol=1e-12)


def test_every_loss_has_a_number_of_its_own():
    assert set(LOSS_CODES) == set(LOSSES)
    assert sorted(LOSS_CODES.values()) == list(range(len(LOSSES)))
    assert loss_code(Loss("tukey", 3.0)) == (LOSS_CODES["tukey"], 3.0)
