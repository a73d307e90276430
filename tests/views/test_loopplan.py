"""Loops as a person sees them: the path before and after, and the report's section."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from odomap.files.loops import LoopLog, LoopRecord
from odomap.geometry.trajectory import Trajectory
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.views.covisibility import MapView
from odomap.views.loopplan import loops_figure
from odomap.views.loopsection import loops_section
from odomap.views.loopview import LoopView
from odomap.views.mapsection import map_section
from odomap.views.plan import plan_axes, plan_figure
from odomap.views.plots import path_figure
from odomap.views.record import Report
from odomap.views.report import render_report
from odomap.views.scene import scene
from odomap.views.style import PALETTE, figure_svg

Make = Callable[..., Report]
PERIOD = 10**8
FRAMES = 200
RADIUS = 30.0


def circuit(drift: tuple[float, float, float]) -> tuple[Trajectory, Trajectory]:
    """A round of 30 m radius that goes on a little, as it was told with its drift, and as it is."""
    s = 2.1 * np.pi * np.arange(FRAMES) / FRAMES
    Ts = np.tile(np.eye(4), (FRAMES, 1, 1))
    Ts[:, :3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # not the first camera's own world
    Ts[:, :3, 3] = np.c_[RADIUS * (np.cos(s) - 1), RADIUS * np.sin(s), np.zeros(FRAMES)]
    told = Ts.copy()
    grows = np.where(np.arange(FRAMES) < 198, np.arange(FRAMES) / FRAMES, 0.0)
    told[:, :3, 3] += grows[:, None] * drift
    stamps = PERIOD * np.arange(FRAMES, dtype=np.int64)
    return Trajectory(stamps, Ts), Trajectory(stamps, told)


def closed(frame: int = 195, matched: int = 5, **changes: object) -> LoopRecord:
    usual = LoopRecord(
        keyframe_id=frame,
        matched_id=matched,
        frame=frame,
        matched_frame=matched,
        stamp_ns=PERIOD * frame,
        matched_stamp_ns=PERIOD * matched,
        num_inliers=152,
        is_accepted=True,
        reason="",
        merges=False,
        moved=0.8,
        turned=0.02,
        rescaled=1.0,
        T_matched_keyframe=np.eye(4),
    )
    return replace(usual, **changes)  # type: ignore[arg-type]


def refused(frame: int, inliers: int) -> LoopRecord:
    reason = f"{inliers} inliers of 30 needed between keyframes {frame} and 0"
    return closed(frame, 0, is_accepted=False, reason=reason, num_inliers=inliers, moved=0.0)


def view_of(
    *records: LoopRecord, drift: tuple[float, float, float] = (0.8, 0, 0), **changes: object
) -> tuple[Trajectory, LoopView]:
    path, live = circuit(drift)
    m = Map()
    for k, (T, stamp) in enumerate(zip(path.Ts_world_body, path.stamps_ns.tolist())):
        m.add_keyframe(Keyframe(k, stamp), T)
    log = LoopLog("circuit", True, 0, records)
    return path, replace(LoopView.of(log, live, m), **changes)  # type: ignore[arg-type]


def figure_of(path: Trajectory, view: LoopView) -> Figure:
    place = scene(path, None)
    assert place is not None
    return loops_figure(place, view, plan_axes(place))


def line(ax: Axes, label: str) -> np.ndarray:
    """Return the (N, 2) points of a line, without its breaks."""
    (found,) = [own for own in ax.lines if own.get_label() == label]
    points = np.asarray(found.get_xydata())
    return points[np.isfinite(points).all(axis=1)]


def test_a_loop_is_long_before_and_short_after() -> None:
    path, view = view_of(closed())
    before, after, close_before, close_after = figure_of(path, view).axes
    for was, now in ((before, after), (close_before, close_after)):
        lengths = [np.linalg.norm(np.diff(line(ax, "loop"), axis=0)) for ax in (was, now)]
        drift = 195 / FRAMES * 0.8
        assert lengths[0] ** 2 == pytest.approx(lengths[1] ** 2, abs=2 * drift * lengths[0])
        np.testing.assert_allclose(
            line(was, "came back here") - line(now, "came back here"), [[drift, 0.0]], atol=1e-12
        )
        np.testing.assert_allclose(line(was, "had been here")[0], view.before[0, 1, :2])


def test_panels_of_a_row_show_the_same_to_the_same_scale() -> None:
    path, view = view_of(closed())
    axes = figure_of(path, view).axes
    for was, now in (axes[:2], axes[2:]):
        assert was.get_xlim() == pytest.approx(now.get_xlim())
        assert was.get_ylim() == pytest.approx(now.get_ylim())
    assert np.ptp(axes[0].get_xlim()) > 2 * RADIUS
    assert np.ptp(axes[2].get_xlim()) < 0.5 * RADIUS
    assert "close up" in axes[2].get_title(loc="left")


def test_a_large_correction_needs_no_close_look() -> None:
    path, view = view_of(closed(moved=15.0), drift=(0.0, -15.0, 0.0))
    axes = figure_of(path, view).axes
    assert [ax.get_title(loc="left") for ax in axes] == ["Before", "After"]


def test_what_moved_upwards_is_seen_from_the_side() -> None:
    path, view = view_of(closed(moved=1.5), drift=(0.1, 0.0, -1.5))
    axes = figure_of(path, view).axes
    assert axes[0].get_ylabel() == "y [m]"
    assert axes[2].get_ylabel() == "z [m]"
    assert "from the side" in axes[3].get_title(loc="left")
    # What lies far behind is left out: the path is 60 m wide.
    assert np.ptp(line(axes[3], "path")[:, 0]) < 0.7 * RADIUS


def test_the_path_before_ends_where_the_loop_was_found() -> None:
    path, view = view_of(closed())
    before, after, *_ = figure_of(path, view).axes
    np.testing.assert_allclose(line(before, "path")[-1], view.live.positions[195, :2])
    np.testing.assert_allclose(line(after, "path")[-1], path.positions[-1, :2])
    np.testing.assert_allclose(line(after, "path as it was before"), line(before, "path"))


def test_several_loops_are_numbered_as_in_the_table(report_of: Make) -> None:
    path, view = view_of(refused(90, 20), closed(190, 2), closed(195, 5, moved=0.9))
    figure = figure_of(path, view)
    assert [t.get_text() for t in figure.axes[0].texts] == ["1", "2"]
    assert "loop 2 close up" in figure.axes[2].get_title(loc="left")
    body = loops_section(report_of(4, trajectory=path, truth=None, loops=view))
    assert "2 loops were closed. Loop 2 moved the path most: at 19.5 s it was back" in body
    assert '<td>2</td><td><span class="unbroken">19.50 s (frame 195)</span></td>' in body


def test_one_that_came_back_to_a_map_before(report_of: Make) -> None:
    path, view = view_of(closed(matched=5, matched_frame=-1))
    np.testing.assert_allclose(view.before[0, 1], path.positions[5])  # where the map has it
    body = loops_section(report_of(4, trajectory=path, truth=None, loops=view))
    assert "in the map before; the path moved by 0.80 m there" in body
    assert "keyframe 5 of the map before" in body


def test_a_loop_that_is_not_believed_any_more_says_so(report_of: Make) -> None:
    path, view = view_of(closed(100, 2), closed(190, 2, doubts=((100, 2),)))
    body = loops_section(report_of(4, trajectory=path, truth=None, loops=view))
    assert "not believed any more: contradicts that at 19.00 s (frame 190)" in body
    assert "contradicts the one at 10.00 s (frame 100)" in body


def test_no_keyframe_is_of_frame_minus_one(report_of: Make) -> None:
    path, view = view_of(closed(), replace(closed(190, 2), frame=-1))
    body = loops_section(report_of(4, trajectory=path, truth=None, loops=view))
    assert "frame -1" not in body
    assert "keyframe 190 of the map before" in body


def test_a_frame_that_nobody_told_is_where_it_is_now() -> None:
    path, view = view_of(closed())
    late = replace(view.live.rows(np.arange(20, FRAMES)))
    m = Map()
    for k, T in enumerate(path.Ts_world_body):
        m.add_keyframe(Keyframe(k, k), T)
    m.cull_keyframes([5])
    seen = LoopView.of(view.log, late, m, scale=2.0)
    np.testing.assert_allclose(
        seen.before[0], [2 * view.live.positions[195], 2 * path.positions[5]]
    )
    np.testing.assert_allclose(seen.after[0, 1], 2 * path.positions[5], atol=1e-9)


# ---- the report ----


def test_nothing_appears_where_nobody_looked(report_of: Make) -> None:
    body = render_report(report_of(20, samples=()))
    assert 'id="loops"' not in body
    assert "#loops" not in body


def test_nothing_found_is_a_sentence(report_of: Make) -> None:
    path, view = view_of()
    body = loops_section(report_of(4, trajectory=path, loops=view))
    assert "No place looked like one seen before, but" in body
    assert "<svg" not in body


def test_only_refused_ones_have_reasons_and_no_picture(report_of: Make) -> None:
    path, view = view_of(refused(90, 20), refused(120, 3))
    body = loops_section(report_of(4, trajectory=path, loops=view))
    assert "No loop was closed." in body
    assert "20 inliers of 30 needed between keyframes 90 and 0" in body
    assert "<svg" not in body
    assert "<details>" not in body


def test_of_many_refused_the_nearest_come_first_and_all_are_there(report_of: Make) -> None:
    many = [refused(k, k % 30) for k in range(1, 180)]
    path, view = view_of(*many, closed())
    body = loops_section(report_of(4, trajectory=path, truth=None, loops=view))
    open_rows, folded = body.split("<details>")
    assert open_rows.count("29 inliers of 30 needed") == 6
    assert "12 inliers of 30 needed" not in open_rows
    assert folded.count("inliers of 30 needed") == 179
    assert "<summary>All 179</summary>" in folded


def test_a_reason_cannot_act(report_of: Make) -> None:
    record = closed(is_accepted=False, reason="<script>1</script>", moved=0.0)
    path, view = view_of(record)
    assert "<script>1" not in loops_section(report_of(4, trajectory=path, loops=view))


def test_a_single_camera_s_loops_tell_the_scale(report_of: Make) -> None:
    path, view = view_of(closed(rescaled=0.97))
    view = replace(view, log=replace(view.log, is_metric=False))
    body = loops_section(report_of(4, trajectory=path, truth=None, loops=view, scale="free"))
    assert "the path moved by 0.80 units there" in body
    assert "-3.0 %" in body


def test_a_report_with_loops_is_whole_and_the_same_bytes(report_of: Make) -> None:
    path, view = view_of(refused(90, 20), closed())
    made = [
        render_report(report_of(20, trajectory=path, truth=None, samples=(), loops=view))
        for _ in range(2)
    ]
    assert made[0] == made[1]
    assert '<a href="#loops">Loops</a>' in made[0]
    assert "nan" not in loops_section(report_of(4, trajectory=path, loops=view)).lower()


# ---- elsewhere ----


def test_paths_and_maps_show_loops_and_gaps() -> None:
    path, view = view_of(closed())
    place = scene(path, None)
    assert place is not None
    gaps = np.array([[[0.0, 0.0, 0.0], [-60.0, 0.0, 0.0]]])
    none = np.zeros((0, 2), np.int64)
    whole = MapView(
        path.positions, np.zeros((0, 3)), none, none[:, 0], 0, loops=view.after, gaps=gaps
    )
    ax = plan_figure(place, whole).axes[0]
    np.testing.assert_allclose(line(ax, "loop"), view.after[0, :, :2])
    names = [t.get_text() for t in ax.get_legend().get_texts()]
    assert {"loop", "not measured"} < set(names)
    assert "came back here" not in names
    figure = path_figure(path, loops=view.after)
    for ax in figure.axes[:2]:
        assert len(line(ax, "loop")) == 2
    assert "var(--loop)" in figure_svg(figure, "path")
    assert PALETTE["loop"] not in figure_svg(figure, "path")


def test_a_map_s_view_has_its_loops_to_scale() -> None:
    m = Map()
    for k in range(3):
        T = np.eye(4)
        T[0, 3] = k
        m.add_keyframe(Keyframe(k, k), T)
    m.add_edge(0, 2, np.eye(4), np.eye(6), "loop")
    assert MapView.of(m, scale=2.0).loops[:, :, 0].tolist() == [[4.0, 0.0]]


def test_the_path_of_a_run_shows_its_own_loops_not_those_of_a_map_before(report_of: Make) -> None:
    path, view = view_of(closed())
    none = np.zeros((0, 2), np.int64)
    others = np.array([[[900.0, 0.0, 0.0], [901.0, 0.0, 0.0]]])
    before = MapView(path.positions, np.zeros((0, 3)), none, none[:, 0], 0, loops=others)
    made = [
        render_report(
            report_of(20, trajectory=path, truth=None, samples=(), map=before, loops=loops)
        )
        for loops in (None, view)
    ]
    legend = "loop: a place seen before"
    assert [
        legend in page.split("<h2>Loops</h2>")[0].split("<h2>Map</h2>")[0] for page in made
    ] == [
        False,
        True,
    ]


def test_a_map_says_what_loops_and_gaps_are(report_of: Make) -> None:
    path, view = view_of(closed())
    none = np.zeros((0, 2), np.int64)
    plain = MapView(path.positions, np.zeros((0, 3)), none, none[:, 0], 0)
    tied = replace(plain, loops=view.after, gaps=view.after)
    words = "came back (dot)", "Dotted lines join pieces"
    for shown, is_said in ((plain, False), (tied, True)):
        body = map_section(report_of(4, trajectory=path, truth=None, map=shown))
        assert all((word in body) is is_said for word in words)
