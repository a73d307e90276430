"""loops.json: there and back, and everything that a file from elsewhere may say."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.files.loops import LoopLog, LoopRecord, read_loops, write_loops
from odomap.geometry.lie import se3_exp

START = 1_700_000_000_000_000_000
CLOSED = LoopRecord(
    keyframe_id=120,
    matched_id=3,
    frame=402,
    matched_frame=3,
    stamp_ns=START + 40_200_000_000,
    matched_stamp_ns=START + 300_000_000,
    num_inliers=152,
    is_accepted=True,
    reason="",
    merges=False,
    moved=0.83,
    turned=0.02,
    rescaled=1.0,
    T_matched_keyframe=se3_exp(np.array([0.1, 0.2, 1.0, 0.01, 0.02, 0.5])),
)
REFUSED = replace(
    CLOSED,
    keyframe_id=80,
    is_accepted=False,
    num_inliers=9,
    reason="9 inliers of 30 needed between keyframes 80 and 3",
    moved=0.0,
    turned=0.0,
)
LOG = LoopLog("street", True, START, (REFUSED, CLOSED))


def test_there_and_back(tmp_path: Path) -> None:
    write_loops(tmp_path / "loops.json", LOG)
    found = read_loops(tmp_path / "loops.json")
    assert (found.name, found.is_metric, found.start_ns) == ("street", True, START)
    assert [r.keyframe_id for r in found.closed] == [120]
    assert [r.reason for r in found.rejected] == [REFUSED.reason]
    np.testing.assert_array_equal(found.records[1].T_matched_keyframe, CLOSED.T_matched_keyframe)
    assert found.seconds(found.records[1].stamp_ns) == pytest.approx(40.2)
    write_loops(tmp_path / "again.json", found)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "loops.json").read_bytes()


def test_what_a_loop_makes_doubtful_is_kept_and_an_older_file_says_nothing(tmp_path: Path) -> None:
    file, doubting = tmp_path / "loops.json", replace(CLOSED, keyframe_id=9, doubts=((120, 3),))
    write_loops(file, replace(LOG, records=(CLOSED, doubting)))
    assert [record.doubts for record in read_loops(file).records] == [(), ((120, 3),)]
    content = json.loads(file.read_text())
    for candidate in content["candidates"]:
        del candidate["doubts"]
    file.write_text(json.dumps(content))
    assert [record.doubts for record in read_loops(file).records] == [(), ()]


def test_no_candidate_is_an_empty_list(tmp_path: Path) -> None:
    write_loops(tmp_path / "loops.json", replace(LOG, records=()))
    assert read_loops(tmp_path / "loops.json").records == ()


def test_one_cut_short_is_one_line_wherever(tmp_path: Path) -> None:
    file = tmp_path / "loops.json"
    write_loops(file, LOG)
    whole = file.read_text()
    for n in range(0, len(whole) - 2, 7):
        file.write_text(whole[:n])
        with pytest.raises(InputError, match=r"loops\.json.*not valid JSON") as error:
            read_loops(file)
        assert "\n" not in str(error.value)
    assert "cut short" in str(error.value)


def change(**fields: object) -> dict[str, object]:
    """Fields to put into the second candidate."""
    return fields


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (change(keyframe_id=-1), "keyframe_id must be a whole number >= 0"),
        (change(keyframe_id=True), "keyframe_id"),
        (change(keyframe_id=1.0), "keyframe_id"),
        (change(stamp_ns=1 << 63), "stamp_ns must be a whole number"),
        (change(num_inliers=None), "num_inliers"),
        (change(moved=float("nan")), "moved must be a finite number"),
        (change(moved=float("inf")), "moved"),
        (change(moved=10**400), "moved"),
        (change(moved="1.0"), "moved"),
        (change(rescaled=-1.0), "rescaled"),
        (change(is_accepted=1), "is_accepted must be true or false"),
        (change(is_accepted=False), "reason must be there"),
        (change(reason="because"), "reason must be there"),
        (change(reason="x" * 5000), "reason must be a text"),
        (change(reason=["x"]), "reason must be a text"),
        (change(T_matched_keyframe=[[1.0] * 4] * 4), "no rigid transform"),
        (change(T_matched_keyframe=np.diag([1.0, 1.0, -1.0, 1.0]).tolist()), "no rigid transform"),
        (change(T_matched_keyframe=(2.0 * np.eye(4)).tolist()), "no rigid transform"),
        (change(T_matched_keyframe=[[1.0] * 4] * 3), "four rows"),
        (change(T_matched_keyframe=[[1.0] * 4] * 3 + [[1.0] * 5]), "four rows"),
        (change(T_matched_keyframe=[[1e200] * 4] * 4), "finite numbers"),
        (change(T_matched_keyframe=[[None] * 4] * 4), "finite numbers"),
        (change(T_matched_keyframe=7), "four rows"),
        (change(doubts=7), "doubts must be a list of pairs"),
        (change(doubts=[[1, 2, 3]]), "doubts must be a list of pairs"),
        (change(doubts=[[1, -2]]), "doubts must hold whole numbers"),
        (change(doubts=[[1, True]]), "doubts must hold whole numbers"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, fields: dict[str, object], says: str) -> None:
    file = tmp_path / "loops.json"
    write_loops(file, LOG)
    content = json.loads(file.read_text())
    content["candidates"][1] |= fields
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"loops\.json: candidates\[1\]: ") as error:
        read_loops(file)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not valid JSON"),
        ("[]", "no list of loops"),
        ("{}", "no list of loops"),
        ('{"odomap_loops": true}', "no list of loops"),
        ('{"odomap_loops": 2}', "version 2, this odomap reads 1"),
        ('{"odomap_loops": 1}', "candidates must be a list"),
        ('{"odomap_loops": 1, "candidates": []}', "name must be a text"),
        ('{"odomap_loops": 1, "candidates": [3]}', "name must be a text"),
        ("[" * 100_000, "not valid JSON"),
        ('{"odomap_loops": ' + "1" * 5000 + "}", "not valid JSON"),
        ("\0\1\2", "not valid JSON"),
    ],
)
def test_a_file_of_something_else(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "loops.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"loops\.json") as error:
        read_loops(file)
    assert says in str(error.value)


def test_a_reason_cannot_drive_a_terminal(tmp_path: Path) -> None:
    file = tmp_path / "loops.json"
    write_loops(file, replace(LOG, records=(replace(REFUSED, reason="\x1b[2Jgone\nx"),)))
    assert read_loops(file).records[0].reason == "?[2Jgone?x"


def test_a_large_file_is_not_even_read(tmp_path: Path) -> None:
    with (tmp_path / "loops.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="no list of loops"):
        read_loops(tmp_path / "loops.json")


def test_a_loop_says_if_tracking_had_found_the_place_itself(tmp_path: Path) -> None:
    file, tied = tmp_path / "loops.json", replace(CLOSED, is_tied=True)
    log = LoopLog("x", True, 0, (CLOSED, tied))
    write_loops(file, log)
    again = read_loops(file)
    assert [record.is_tied for record in again.records] == [False, True]
    assert again.remarks(again.records[0]) == ()
    assert again.remarks(again.records[1]) == ("tracking had found the old map again",)
    content = json.loads(file.read_text("utf-8"))
    for candidate in content["candidates"]:
        del candidate["is_tied"]  # as older files have it
    file.write_text(json.dumps(content), "utf-8")
    assert [record.is_tied for record in read_loops(file).records] == [False, False]
