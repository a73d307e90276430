import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from odomap.maps.estimate import Status
from odomap.views.record import Report, environment, length, lost_runs, significant, verdict
from odomap.views.words import cards, flat, value_text

Make = Callable[..., Report]


def test_a_good_run_in_one_sentence(report_of: Make) -> None:
    says = verdict(report_of(110))
    assert says.text == "Tracked 110 of 110 frames; ATE 13 mm over 19 m (0.07 %); 9.3 ms per frame"
    assert says.level == "good"


def test_lost_frames_and_unreadable_images_are_said(report_of: Make) -> None:
    skipped = [(0, "a.png", "truncated"), (1, "b.png", "missing")]
    says = verdict(report_of(110, range(50, 59), skipped=skipped))
    assert says.text.startswith("Tracked 101 of 110 frames; lost once, for 9 frames in all; ATE")
    assert says.text.endswith("; 2 images were unreadable")
    assert says.level == "warn"


def test_a_failed_run_is_bad(report_of: Make) -> None:
    assert verdict(report_of(40, range(10, 30))).level == "bad"
    none = verdict(report_of(12, range(12), trajectory=None, scores={}))
    assert none.level == "bad"
    assert none.text.startswith("None of 12 frames could be tracked")
    assert verdict(Report("x")).text == "No frames were read"


def test_without_truth_accuracy_is_unknown(report_of: Make) -> None:
    says = verdict(report_of(20, truth=None, scores={}))
    assert "no ground truth to judge it" in says.text
    assert "ATE" not in says.text


def test_start_up_frames_are_neither_tracked_nor_lost(report_of: Make) -> None:
    run = report_of(10)
    first = replace(run.estimates[0], status=Status.INITIALIZING)
    starting = replace(run, estimates=[first, *run.estimates[1:]])
    assert run.trajectory is not None
    without = replace(starting, trajectory=run.trajectory.rows(range(1, 10)))
    says = verdict(without)
    assert says.text.startswith("Tracked 9 of 10 frames (1 for start-up)")
    assert says.level == "good"
    # A start's first views are placed afterwards, and then count as the metrics count them.
    assert verdict(starting).text.startswith("Tracked 10 of 10 frames;")


def test_a_path_without_scale_has_no_metres(report_of: Make) -> None:
    run = report_of(20, scale="free", truth=None, scores={})
    number, caption = cards(run)[0]
    assert number.endswith(" units")
    assert caption == "path travelled, without scale"
    assert ", scale fitted;" in verdict(report_of(20, scale="fitted")).text


def test_pace_falls_back_on_the_estimates(report_of: Make) -> None:
    run = report_of(30, metrics={"ms_per_frame": {"median": math.nan}})
    assert "ms per frame" in verdict(run).text
    no_timing = [replace(e, timing={}) for e in run.estimates]
    assert "ms per frame" not in verdict(replace(run, estimates=no_timing)).text


def test_runs_of_lost_frames(report_of: Make) -> None:
    estimates = list(report_of(20, range(3, 6)).estimates)
    estimates[12] = replace(estimates[12], status=Status.LOST, reason="dark")
    first, second = lost_runs(estimates)
    assert (first.first, first.count) == (3, 3)
    assert first.end_ns - first.start_ns == 100_000_000
    assert "motion blur" in first.reason
    assert (second.first, second.count, second.reason) == (12, 1, "dark")


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.00342, "3.4 mm"), (0.0342, "3.4 cm"), (0.6, "0.60 m"), (59.94, "60 m"), (3724.2, "3.7 km"),
     (0.0, "0 mm"), (math.nan, "unknown"), (0.4999, "50 cm")],
)  # fmt: skip
def test_lengths_read_well(metres: float, text: str) -> None:
    assert length(metres) == text


def test_significant_digits() -> None:
    assert [significant(v, 3) for v in (0.012345, 1.5, 123.456, 0.0, math.inf)] == [
        "0.0123", "1.50", "123", "0", "–",
    ]  # fmt: skip
    assert significant(123456.7, 3) == "123,457"


@pytest.mark.parametrize(
    ("name", "value", "label", "text"),
    [
        ("rot_deg_per_m", 0.0051, "rot", "0.00510 °/m"),
        ("rmse_m", 0.0034, "rmse", "3.4 mm"),
        ("path_m", 1234.5, "length of path", "1234 m"),
        ("ms_per_frame median", 14.2, "time per frame, median", "14.2 ms"),
        ("peak_memory_mb", 412.0, "peak memory", "412 MB"),
        ("frames", 3000, "frames", "3,000"),
        ("stopped", True, "stopped", "True"),
        ("ate_rmse_m", None, "ate rmse", "–"),
        ("x", math.nan, "x", "–"),
    ],
)
def test_units_come_from_names(name: str, value: object, label: str, text: str) -> None:
    assert value_text(name, value) == (label, text)


def test_flat_joins_names() -> None:
    assert list(flat({"a": 1, "b": {"c": 2, "d": {"e": 3}}})) == [
        ("a", 1),
        ("b c", 2),
        ("b d e", 3),
    ]


def test_cards_show_only_what_is_known(report_of: Make) -> None:
    captions = [caption for _, caption in cards(report_of(20))]
    assert captions[:2] == ["ATE RMSE", "path travelled"]
    assert "times real time" in captions
    assert cards(Report("x", metrics={"loops": math.nan, "keyframes": None})) == []


def test_environment_names_versions_and_cores() -> None:
    found = environment()
    assert found["numpy"][0].isdigit()
    assert int(found["cores"]) >= 1
