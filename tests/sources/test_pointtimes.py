"""What a field of times counts is found out from its values."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.sources.pointtimes import times_of

STAMPS = [1_700_000_000_123_456_789 + k * 100_000_000 for k in range(3)]
UNIT_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


def raw(unit: str, kind: str, begin_ns: int, span_s: float, count: int = 200):
    """Return times of a sweep as a driver writes them."""
    since = (np.linspace(0, span_s, count) * 1e9).astype(np.int64) + begin_ns
    if np.dtype(kind).kind in "iu":
        return (since // UNIT_NS[unit]).astype(kind)
    return (since / UNIT_NS[unit]).astype(kind)


@pytest.mark.parametrize("span", [0.1, 0.03, 0.099])
@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        ("ns", "u4"),
        ("us", "u4"),
        ("us", "f4"),
        ("ms", "f4"),
        ("s", "f4"),
        ("s", "f8"),
        ("ns", "f8"),
    ],
)
@pytest.mark.parametrize("begin", [0.0, -0.5, -1.0])
def test_since_the_stamp(span: float, unit: str, kind: str, begin: float) -> None:
    if begin < 0 and kind == "u4":
        kind = "i4"
    begin_ns = round(begin * span * 1e9)
    columns = [raw(unit, kind, begin_ns, span) for _ in STAMPS]
    found = times_of("t", columns, STAMPS, 0.1)
    assert found is not None
    assert (found.unit, found.since) == (unit, "stamp")
    seconds = found.seconds(columns[0], STAMPS[0], np.ones(200, bool))
    assert seconds is not None
    np.testing.assert_allclose(seconds, begin_ns * 1e-9 + np.linspace(0, span, 200), atol=1.1e-6)


@pytest.mark.parametrize(
    ("unit", "kind", "tolerance"),
    [("ns", "u8", 2e-9), ("ns", "i8", 2e-9), ("us", "u8", 2e-6), ("ns", "f8", 4e-7),
     ("us", "f8", 1e-6), ("s", "f8", 4e-7)],
)  # fmt: skip
@pytest.mark.parametrize("late_s", [0.0, -0.1, 0.02])
def test_absolute(unit: str, kind: str, tolerance: float, late_s: float) -> None:
    """The first point is at the stamp, or the last one is, or the clocks are 20 ms apart."""
    late_ns = round(late_s * 1e9)
    columns = [raw(unit, kind, stamp + late_ns, 0.1) for stamp in STAMPS]
    found = times_of("timestamp", columns, STAMPS, 0.1)
    assert found is not None
    assert (found.unit, found.since) == (unit, "epoch")
    for column, stamp in zip(columns, STAMPS):
        seconds = found.seconds(column, stamp, np.ones(200, bool))
        assert seconds is not None
        np.testing.assert_allclose(seconds, late_s + np.linspace(0, 0.1, 200), atol=tolerance)


def test_of_another_clock() -> None:
    """Microseconds since the hour, or nanoseconds since the sensor was switched on."""
    for unit, kind, begin_ns in (("us", "u4", 1800 * 10**9), ("ns", "u8", 77 * 10**9)):
        columns = [raw(unit, kind, begin_ns + k * 10**8, 0.1) for k in range(3)]
        found = times_of("t", columns, STAMPS, 0.1)
        assert found is not None
        assert (found.unit, found.since) == (unit, "own")
        assert "first point" in str(found)
        seconds = found.seconds(columns[2], STAMPS[2], np.ones(200, bool))
        assert seconds is not None
        np.testing.assert_allclose(seconds, np.linspace(0, 0.1, 200), atol=1.1e-6)


def test_one_sweep_tells_its_unit() -> None:
    found = times_of("t", [raw("us", "u4", 0, 0.1)], STAMPS[:1], 0.0)
    assert found is not None
    assert found.unit == "us"


@pytest.mark.parametrize("step", [0.05, 0.1, 0.2])
def test_no_unit_fits(step: float) -> None:
    """It lasts ten steps, or as little as a thousandth of one."""
    for span in (10 * step, 1e4 * step, 1e-3 * step):
        columns = [np.linspace(0, span, 100) for _ in STAMPS]
        with pytest.raises(InputError, match=rf"'t' go over {span:g} in a sweep, .* in no unit"):
            times_of("t", columns, STAMPS, step)
        forced = times_of("t", columns, STAMPS, step, "us")
        assert forced is not None
        assert forced.unit == "us"


def test_numbers_that_say_nothing() -> None:
    assert times_of("t", [np.zeros(50) for _ in STAMPS], STAMPS, 0.1) is None
    assert times_of("t", [np.full(50, s) for s in STAMPS], STAMPS, 0.1) is None
    assert times_of("t", [np.zeros(0)], STAMPS[:1], 0.1) is None
    with pytest.raises(InputError, match="are no numbers: leave them out by"):
        times_of("t", [np.full(50, np.nan)], STAMPS[:1], 0.1)


def test_a_sweep_with_times_that_are_not_its_own() -> None:
    columns = [raw("us", "u4", 0, 0.1) for _ in STAMPS]
    found = times_of("t", columns, STAMPS, 0.1)
    assert found is not None
    late = columns[0] + np.uint32(3_600_000_000)
    assert found.seconds(late, STAMPS[0], np.ones(200, bool)) is None
    # Where nothing returned, a time may be anything.
    lost = np.zeros(200, bool)
    lost[:5] = True
    mixed = np.where(lost, late, columns[0])
    seconds = found.seconds(mixed, STAMPS[0], ~lost)
    assert seconds is not None
    assert seconds[:5].tolist() == [0] * 5
    assert found.seconds(late, STAMPS[0], np.zeros(200, bool)) is not None
