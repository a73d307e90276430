"""Stamps: exact, in order, in pairs, in whatever unit they come."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.sensors.sync import (
    format_stamp,
    guess_unit,
    order_stamps,
    pair_stamps,
    parse_stamp,
    read_stamps,
)

EPOCH_NS = 1403636584763555584
STEP_NS = 50_000_000


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("1403636584763555584", "ns", 1403636584763555584),
        ("1311868164.363181", "s", 1311868164363181000),
        ("1.000000e-01", "s", 100_000_000),
        ("1403636584763.555584", "ms", 1403636584763555584),
        ("1403636584763555.584", "us", 1403636584763555584),
        (" 0 ", "s", 0),
        ("-1.5", "s", -1_500_000_000),
        (".5", "s", 500_000_000),
        ("5.", "s", 5_000_000_000),
        ("1.4036365847635556e18", "ns", 1403636584763555600),
        ("0e99", "s", 0),
        ("0.0000000005", "s", 0),
        ("0.0000000015", "s", 2),
    ],
)
def test_parse_stamp_is_exact(text: str, unit: str, expected: int) -> None:
    assert parse_stamp(text, unit) == expected


@pytest.mark.parametrize(
    "text", ["nan", "NaN", "inf", "", "-", ".", "1e999", "1,5", "0x10", "1e30", "abc", "9" * 25]
)
def test_parse_stamp_refuses_what_is_no_stamp(text: str) -> None:
    with pytest.raises(ValueError, match="stamp"):
        parse_stamp(text, "s")


@settings(deadline=None, derandomize=True)
@given(st.integers(-(2**62), 2**62))
def test_format_and_parse_are_inverse(stamp_ns: int) -> None:
    assert parse_stamp(format_stamp(stamp_ns), "s") == stamp_ns


@settings(deadline=None, derandomize=True)
@given(
    st.decimals(-4_000_000_000, 4_000_000_000, allow_nan=False, allow_infinity=False, places=12),
    st.sampled_from([("s", 9), ("ms", 6), ("us", 3), ("ns", 0)]),
)
def test_parse_stamp_rounds_half_to_even(value: object, unit: tuple[str, int]) -> None:
    name, exponent = unit
    assert parse_stamp(f"{value:f}", name) == round(Fraction(str(value)) * 10**exponent)


@pytest.mark.parametrize("actual", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("expected", ["s", "ns"])
@pytest.mark.parametrize("start_ns", [0, EPOCH_NS])
@pytest.mark.parametrize("rate_hz", [20.0, 0.0])
def test_unit_is_found(actual: str, expected: str, start_ns: int, rate_hz: float) -> None:
    scale = {"s": 9, "ms": 6, "us": 3, "ns": 0}[actual]
    stamps = [start_ns + i * STEP_NS for i in range(10)]
    texts = [f"{Decimal(stamp).scaleb(-scale):f}" for stamp in stamps]
    column = read_stamps(texts, expected, rate_hz)
    assert column.unit == actual
    assert column.stamps_ns.tolist() == stamps
    assert (column.note == "") == (actual == expected)


def test_a_plausible_column_is_never_reinterpreted() -> None:
    # 200 Hz in seconds, announced; one second apart in nanoseconds, announced.
    assert guess_unit(np.arange(100) * 0.005, "s") == "s"
    assert guess_unit(np.arange(100) * 1e9, "ns", 1.0) == "ns"
    # Nanoseconds from 1 s to 4 s on look like an epoch in seconds by size alone.
    assert guess_unit(1e9 + np.arange(60) * 5e7, "ns") == "ns"
    # A frame a minute: nothing fits, so what was announced stands.
    assert guess_unit(np.arange(10) * 60e9, "ns") == "ns"


def test_unit_of_one_or_no_stamp() -> None:
    assert guess_unit(np.array([1.4036e18]), "ns") == "ns"
    assert guess_unit(np.array([1.4036e9]), "ns") == "s"
    assert guess_unit(np.array([]), "ns") == "ns"
    assert guess_unit(np.array([np.nan, np.nan]), "ns") == "ns"
    assert guess_unit(np.array([7.0]), "ns") == "ns"


def test_rows_that_are_no_stamp_are_masked() -> None:
    column = read_stamps(["0", "NaN", "100000000", "x"], "ns", 10.0)
    assert column.valid.tolist() == [True, False, True, False]
    assert column.stamps_ns[[0, 2]].tolist() == [0, 100000000]


def test_order_drops_repeated_and_counts_disordered() -> None:
    order = order_stamps(np.array([10, 30, 20, 20, 40, 10]))
    assert order.order.tolist() == [0, 2, 1, 4]
    assert order.repeated.tolist() == [3, 5]
    assert order.disordered == 2


def test_order_of_an_ordered_stream_is_itself() -> None:
    order = order_stamps(np.arange(5))
    assert order.order.tolist() == [0, 1, 2, 3, 4]
    assert len(order.repeated) == 0
    assert order.disordered == 0


def test_pairs_are_nearest_and_mutual() -> None:
    left = np.array([0, 100, 200, 300])
    right = np.array([2, 96, 104, 299, 500])
    ours, theirs = pair_stamps(left, right, 5)
    # 96 and 104 are equally near to 100: the earlier one is taken, and 200 has none.
    assert ours.tolist() == [0, 1, 3]
    assert theirs.tolist() == [0, 1, 3]


@settings(deadline=None, derandomize=True)
@given(
    st.lists(st.integers(0, 1000), unique=True, min_size=1),
    st.lists(st.integers(0, 1000), unique=True, min_size=1),
    st.integers(0, 30),
)
def test_pairs_use_each_stamp_once_within_tolerance(
    first: list[int], second: list[int], tolerance: int
) -> None:
    a, b = np.sort(first), np.sort(second)
    ours, theirs = pair_stamps(a, b, tolerance)
    assert np.all(np.diff(ours) > 0)
    assert np.all(np.diff(theirs) > 0)
    assert np.all(np.abs(a[ours] - b[theirs]) <= tolerance)
    # What both have exactly is always paired.
    assert set(first) & set(second) <= set(a[ours].tolist())


def test_pairs_of_nothing() -> None:
    ours, theirs = pair_stamps(np.zeros(0, np.int64), np.arange(3))
    assert len(ours) == len(theirs) == 0
