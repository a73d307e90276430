"""Bundle adjustment on a real problem of the BAL data sets, whose minimum is known."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.backend.adjustment.adjust import AdjustmentConfig, adjust, view_covariance
from odomap.files.bal import read_bal

BEST = 13_344.4


@pytest.fixture(scope="module")
def ladybug(data_folder):
    problem = read_bal(data_folder / "bundle" / "problem-49-7776-pre.txt.gz")
    return replace(problem, is_free_intrinsic=True)


@pytest.mark.parametrize("method", ["factored", "iterative"])
def test_ladybug_reaches_its_minimum(ladybug, method):
    solution = adjust(ladybug, AdjustmentConfig(method))
    assert solution.cost_before == pytest.approx(850_912.46, rel=1e-7)
    assert solution.cost_after == pytest.approx(BEST, rel=1e-4)
    assert solution.converged
    assert solution.iterations <= 20


def test_ladybug_without_outliers(ladybug):
    solution = adjust(ladybug, AdjustmentConfig(gate=4.0, gauge="hold"))
    assert 0 < np.count_nonzero(solution.is_outlier) < 0.02 * ladybug.num_observations
    assert solution.cost_after < 0.8 * BEST
    assert np.mean(solution.chi2[solution.is_outlier] > 16.0) > 0.97  # the rounds may run out
    joint = view_covariance(solution.problem, [1, 24, 48]).joint
    assert np.linalg.eigvalsh(joint).min() > 0.0
