"""Registration beside peers: the starts, the judge, and what counts as missed."""

import ast
import dataclasses

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp


@pytest.fixture
def bench(load):
    return load("registration")


def test_starts_are_within_a_metre_and_twenty_degrees(bench):
    truth = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    starts = bench.random_starts(truth, 300)
    metres, degrees = bench.errors(truth, starts)
    assert 0.9 < metres.max() <= 1.0
    assert 18.0 < degrees.max() <= 20.0
    assert np.array_equal(starts, bench.random_starts(truth, 300))


def row(bench, who, **changes):
    plain = bench.Row(who, "gicp", 1, 0.05, 0.01, 0.01, 0.1, 1.0)
    return dataclasses.replace(plain, **changes)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({}, None),
        ({"whole_s": 0.06}, "1.20 of the whole_s"),
        ({"align_s": 0.02}, "align_s"),
        ({"error_m": 0.03}, "m off"),
        ({"error_deg": 0.3}, "° off"),
        ({"share": 0.9}, "converge"),
        ({"error_m": float("nan")}, "m off"),
    ],
)
def test_what_counts_as_missed(bench, changes, says):
    rows = [row(bench, "small_gicp"), row(bench, "odomap", **changes)]
    missed = bench.below_bars(rows)
    assert len(missed) == (says is not None)
    assert says is None or says in missed[0]
    assert bench.ratios(rows)["registration/gicp/1"]["seconds"] == pytest.approx(
        rows[1].whole_s / 0.05
    )


def test_the_peers_do_not_import_odomap(folder):
    tree = ast.parse((folder / "registration_peers.py").read_text("utf-8"))
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert not any(name.split(".")[0] == "odomap" for name in names)
