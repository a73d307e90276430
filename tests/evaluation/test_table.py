import json

import pytest

from odomap.errors import InputError
from odomap.evaluation.table import Row, Table, format_number

RESULTS = {
    "ours": {"ATE": {"rmse_m": 0.0033, "matched": 110, "scale": 1.0}, "RPE": {"rot_deg": 0.5}},
    "peer": {"ATE": {"rmse_m": 0.0041, "matched": 109, "scale": 1.0}, "KITTI": {"trans_pct": 1.2}},
}


@pytest.fixture
def table() -> Table:
    return Table.of(RESULTS, title="MH_01")


def test_rows_keep_groups_together_and_miss_nothing(table: Table) -> None:
    assert [(r.group, r.name) for r in table.rows] == [
        ("ATE", "rmse_m"),
        ("ATE", "matched"),
        ("ATE", "scale"),
        ("RPE", "rot_deg"),
        ("KITTI", "trans_pct"),
    ]
    assert table.rows[3].values == (0.5, None)


def test_best_is_least_for_errors_and_most_for_counts() -> None:
    assert Row("ATE", "rmse_m", (0.2, 0.1)).best == 1
    assert Row("ATE", "matched", (10, 9)).best == 0
    assert Row("ATE", "rmse_m", (0.1, 0.1)).best is None
    assert Row("ATE", "rmse_m", (float("nan"), 0.1)).best is None
    assert Row("ATE", "scale", (0.9, 1.0)).best is None


def test_units_come_from_names() -> None:
    names = ["rot_deg_per_m", "rmse_pct_of_path", "rot_rmse_deg", "rmse_m", "matched"]
    rows = [Row("", name, (1.0,)) for name in names]
    assert [r.unit for r in rows] == ["°/m", "% of path", "°", "m", ""]
    assert rows[2].label == "rot rmse"


def test_text_is_aligned_and_marks_the_best(table: Table) -> None:
    title, blank, head, rule, *lines = table.to_text().splitlines()
    assert (title, blank) == ("MH_01", "")
    assert head.split() == ["metric", "unit", "ours", "peer"]
    assert len(rule) >= max(map(len, lines))
    assert lines[0].split() == ["ATE", "rmse", "m", "0.003300*", "0.004100"]
    column = head.index("unit")
    assert all(line[column - 1] == " " and line[column] != " " for line in (head, lines[0]))


def test_one_estimate_has_no_marks() -> None:
    text = Table.of({"ours": RESULTS["ours"]}).to_text()
    assert "*" not in text
    assert "0.003300" in text


def test_markdown_escapes_pipes_and_marks_the_best() -> None:
    text = Table.of({"a|b": RESULTS["ours"], "peer": RESULTS["peer"]}, title="x").to_markdown()
    assert "a\\|b" in text
    assert "| ATE rmse | m | **0.003300** | 0.004100 |" in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.replace("\\|", "").count("|") for line in rows} == {5}


def test_json_is_valid_and_full_precision() -> None:
    value = 0.1 + 0.2
    table = Table.of({"ours": {"ATE": {"rmse_m": value, "scale": float("nan")}}})
    loaded = json.loads(table.to_json())
    assert loaded["estimates"]["ours"]["ATE"] == {"rmse_m": value, "scale": None}


def test_rich_shows_names_as_text_not_markup() -> None:
    from rich.console import Console

    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(Table.of({"[red]x[/red]": RESULTS["ours"]}).to_rich())
    console.file.close()
    text = console.export_text()
    assert "[red]x[/red]" in text
    assert "ATE rmse" in text


def test_no_estimates_is_an_error() -> None:
    with pytest.raises(InputError, match="no estimates"):
        Table.of({})


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (110, "110"), (0.0, "0.000"), (12.3456, "12.35"),
     (1.23456e-6, "1.235e-06"), (123456.7, "1.235e+05"), (-0.012345, "-0.01235")],
)  # fmt: skip
def test_numbers_have_four_digits(value: float | None, text: str) -> None:
    assert format_number(value) == text
