import base64
import io
import json
import math
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from odomap.errors import OutputError
from odomap.geometry.trajectory import Trajectory
from odomap.views.record import Report
from odomap.views.report import render_report, write_report

Make = Callable[..., Report]
VOID = {"meta", "link", "img", "input", "br", "hr"}
EVIL = "</script><script>alert(1)</script>\"><img src=x onerror=alert(2)>'\x00\x1b[31m"


class Reader(HTMLParser):
    """Collects tags and checks that they close in order."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.texts: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self.open[-1] if self.open else "", data))


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return reader


def words(page: str) -> str:
    return " ".join(t for tag, t in read(page).texts if tag not in ("script", "style"))


@pytest.fixture(scope="module")
def page(report: Report) -> str:
    return render_report(report)


def data_of(page: str) -> dict[str, object]:
    return json.loads(next(t for _, t in read(page).texts if t.startswith('{"axes"')))


def floats(packed: object) -> np.ndarray:
    return np.frombuffer(base64.b64decode(str(packed)), "<f4")


def test_all_sections_are_there_and_linked(page: str) -> None:
    reader = read(page)
    names = [a["id"] for tag, a in reader.tags if tag == "section"]
    assert names == ["path", "map", "error", "features", "timing", "frames", "problems", "run"]
    links = [a["href"] for tag, a in reader.tags if tag == "a"]
    assert links == [f"#{name}" for name in names]
    ids = [a["id"] for _, a in reader.tags if "id" in a]
    assert len({*names}) == len(names)
    assert len(re.findall(r"<h1>", page)) == 1
    assert {"path3d", "path3d-data", "path3d-time"} <= set(ids)


def test_the_verdict_stands_first(page: str, report: Report) -> None:
    assert "Tracked 151 of 160 frames; lost once, for 9 frames in all" in words(page)
    assert page.index('class="verdict warn"') < page.index("<nav")


def test_nothing_is_fetched(page: str) -> None:
    assert "http:" not in page
    assert "https:" not in page
    for tag, attributes in read(page).tags:
        for name in ("src", "href", "action", "data"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, value)
    assert not re.findall(r"url\((?!#)", page)
    assert "@import" not in page
    assert "default-src 'none'" in page


def test_the_script_is_the_one_the_policy_allows(page: str) -> None:
    import hashlib

    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert len(scripts) == 1
    digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page


def test_pictures_decode_and_have_words(page: str, report: Report) -> None:
    pictures = [a for tag, a in read(page).tags if tag == "img"]
    assert len(pictures) == len(report.samples)
    for attributes in pictures:
        data = base64.b64decode(str(attributes["src"]).split(",", 1)[1])
        opened = Image.open(io.BytesIO(data))
        opened.load()
        assert opened.size == (752, 480)
        assert "inliers of 280 tracks" in str(attributes["alt"])
    drawings = [a for tag, a in read(page).tags if tag == "svg"]
    assert len(drawings) == 6
    assert all(a["role"] == "img" and a["aria-label"] for a in drawings)


def test_no_number_is_missing(page: str) -> None:
    assert "nan" not in words(page).lower()
    assert not re.search(r"\bnan\b|Infinity|undefined", page.split("<script>")[0], re.IGNORECASE)


def test_the_3d_view_gets_the_path(page: str, report: Report) -> None:
    data = data_of(page)
    assert report.trajectory is not None
    path = floats(data["path"]).reshape(-1, 3)
    assert len(path) == len(report.trajectory) == len(data["colours"])  # type: ignore[arg-type]
    assert floats(data["truth"]).size % 3 == 0
    assert floats(data["times"])[-1] == pytest.approx(7.95)
    assert data["pieces"] == [[0, 60], [61, 150]]
    assert np.isfinite(floats(data["points"])).all()
    assert data["axes"] == ["x", "y", "z"]


def test_landmarks_stand_where_the_room_is(page: str) -> None:
    """The estimate's world is moved onto the truth's, and the landmarks with it."""
    points = floats(data_of(page)["points"]).reshape(-1, 3)
    assert np.abs(points[:, 0]).max() == pytest.approx(5.0, abs=0.1)
    assert np.abs(points[:, 1]).max() == pytest.approx(4.0, abs=0.1)


def test_text_from_outside_cannot_act(report_of: Make) -> None:
    places = ["title", "source", "version", "command", "config", "rig"]
    run = report_of(
        20,
        range(5, 8),
        samples=(),
        skipped=[(1, EVIL, EVIL)],
        scores={EVIL: {EVIL: 1.0}},
        metrics={EVIL: {EVIL: EVIL}},
        environment={EVIL: EVIL},
        **{place: f"{place}{EVIL}" for place in places},
    )
    estimates = [replace(e, reason=EVIL, timing={EVIL: 1.0, **e.timing}) for e in run.estimates]
    page = render_report(replace(run, estimates=estimates))
    check_harmless(page)
    assert all(f"{place}</script><script>alert(1)" in words(page) for place in places)


def check_harmless(page: str) -> None:
    tags = read(page).tags
    assert all(a.get("type") == "application/json" or not a for tag, a in tags if tag == "script")
    assert sum(tag == "script" for tag, _ in tags) == 2
    assert not any(name.startswith("on") for _, a in tags for name in a)
    assert "\x00" not in page
    assert "\x1b" not in page
    assert "alert(1)" in words(page)


def test_problems_are_listed_with_their_reasons(report_of: Make) -> None:
    skipped = [(k * 10**9, f"{k:03}.png", "truncated") for k in range(70)]
    shown = words(render_report(report_of(30, range(4, 9), samples=(), skipped=skipped)))
    assert "9 inliers of 15 needed: motion blur?" in shown
    assert "049.png" in shown
    assert "050.png" not in shown
    assert "… and 20 more." in shown


def test_no_problems_is_said(report_of: Make) -> None:
    assert "no frame was lost, no image skipped" in words(render_report(report_of(9, samples=())))


def test_without_truth(report_of: Make) -> None:
    page = render_report(report_of(30, truth=None, scores={}, samples=()))
    assert "only the claimed uncertainty can be shown" in words(page)
    assert data_of(page)["colours"] == []
    assert "nan" not in words(page).lower()


def test_a_path_without_scale_is_in_units_of_its_own(report_of: Make) -> None:
    free = render_report(report_of(30, truth=None, scores={}, samples=(), scale="free"))
    assert "One camera cannot tell the scale: lengths are in units of their own." in words(free)
    assert data_of(free)["unit"] == "units"
    assert "x [units]" in free
    assert "Position uncertainty, 3σ [units]" in free
    assert " [m]" not in free
    fitted = render_report(report_of(30, samples=(), scale="fitted"))
    assert "the path is drawn at that of the truth" in words(fitted)
    assert data_of(fitted)["unit"] == "m"


def test_warnings_are_shown_as_text(report_of: Make) -> None:
    page = render_report(report_of(9, samples=(), warnings=["is <b> it 5000?"]))
    assert "<li>is &lt;b&gt; it 5000?</li>" in page


def test_truth_of_another_clock(report_of: Make) -> None:
    run = report_of(30, scores={}, samples=())
    assert run.truth is not None
    other = Trajectory(run.truth.stamps_ns + 10**15, run.truth.Ts_world_body)
    assert "shares no times with the path" in words(render_report(replace(run, truth=other)))


@pytest.mark.parametrize("frames", [0, 12])
def test_nothing_tracked(report_of: Make, frames: int) -> None:
    empty = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    run = report_of(12, range(12), trajectory=empty if frames else None, scores={}, points=None)
    page = render_report(replace(run, estimates=run.estimates[:frames], samples=()))
    says = "None of 12 frames could be tracked" if frames else "No frames were read"
    assert says in words(page)
    assert "<script" not in page
    assert "script-src 'none'" in page


def test_no_frames_at_all() -> None:
    page = render_report(Report("empty", environment={}))
    assert "No frames were read" in words(page)


def test_one_frame(report_of: Make) -> None:
    run = report_of(2)
    assert run.trajectory is not None
    one = replace(run, estimates=run.estimates[:1], trajectory=run.trajectory.rows([0]), truth=None)
    page = render_report(one)
    assert floats(data_of(page)["path"]).size == 3
    assert "Tracked 1 of 1 frames" in words(page)


def test_numbers_that_are_none(report_of: Make) -> None:
    run = report_of(
        30,
        samples=(),
        scores={"ATE": {"rmse_m": math.nan, "path_m": math.inf}},
        metrics={"ms_per_frame": {"median": math.nan, "p95": None}, "ate_rmse_m": None},
        points=np.full((5, 3), np.nan),
    )
    assert run.trajectory is not None
    assert run.trajectory.covariances is not None
    P = run.trajectory.covariances.copy()
    P[3:9] = np.nan
    P[12, 0, 0] = -1.0
    path = Trajectory(run.trajectory.stamps_ns, run.trajectory.Ts_world_body, P)
    page = render_report(replace(run, trajectory=path))
    assert "nan" not in words(page).lower()
    assert "inf" not in words(page).lower().replace("inliers", "")
    assert 'd=""' not in page


def test_thousands_of_frames_stay_small(report_of: Make) -> None:
    page = render_report(report_of(3000, range(1000, 1040)))
    assert len(page) < 5_000_000
    assert floats(data_of(page)["path"]).size <= 3 * 2000


def test_same_run_same_bytes(report_of: Make) -> None:
    assert render_report(report_of(25)) == render_report(report_of(25))


def test_written_whole_into_a_folder_or_a_file(tmp_path: Path) -> None:
    run = Report("nothing", environment={})
    assert write_report(tmp_path, run) == tmp_path / "report.html"
    named = write_report(tmp_path / "other.html", run)
    assert named.read_bytes() == (tmp_path / "report.html").read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"report.html", "other.html"}
    with pytest.raises(OutputError, match="nowhere"):
        write_report(tmp_path / "nowhere" / "x.html", run)


def test_matplotlib_is_loaded_late_and_pyplot_never() -> None:
    import subprocess

    program = (
        "import sys; from odomap.views.report import Report, render_report;"
        "assert 'matplotlib' not in sys.modules; render_report(Report('x'));"
        "import odomap.views.plots; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def test_figures_of_a_stage_are_those_of_its_frames(report_of: Make) -> None:
    run = report_of(20, samples=())
    timing = [{"track": 2.0} | ({"map": 8.0} if k == 4 else {}) for k in range(20)]
    estimates = [replace(e, timing=ms) for e, ms in zip(run.estimates, timing)]
    shown = render_report(replace(run, estimates=estimates))
    rows = re.findall(r"<tr><td><i class=.swatch.[^>]*></i>(.*?)</tr>", shown)
    assert "background:var(--stage1)" in shown
    cells = [re.sub(r"<[^>]+>", " ", row).split() for row in rows]
    assert cells == [
        ["track", "20", "2.00", "2.00", "2.00", "83", "%"],
        ["map", "1", "8.00", "8.00", "8.00", "17", "%"],
        ["all", "stages", "20", "2.00", "2.40", "10.0", "100", "%"],
    ]
