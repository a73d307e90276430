import io
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from odomap.geometry.lie import se3_exp
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Tracks
from odomap.views.patherror import PathError
from odomap.views.plots import (
    error_figure,
    figure_jpeg,
    figure_png,
    figure_svg,
    frame_figure,
    inlier_figure,
    path_3d_figure,
    path_figure,
    timing_figure,
)
from odomap.views.record import Report
from odomap.views.scene import gaps_as_nan, scene, thin, unit_of
from odomap.views.style import PALETTE, STAGES
from odomap.views.timelines import stage_colours, stage_times

Make = Callable[..., Report]


def labels(figure: Figure) -> set[str]:
    return {
        label
        for ax in figure.axes
        for label in ax.get_legend_handles_labels()[1]
        if not label.startswith("_")
    }


def test_path_against_truth_is_coloured_by_its_error(report: Report) -> None:
    keyframes = np.array([e.stamp_ns for e in report.estimates if e.is_keyframe])
    figure = path_figure(report.trajectory, report.truth, keyframes)
    above, side, bar = figure.axes
    assert labels(figure) == {"truth", "estimate", "keyframe", "start", "end"}
    lines = next(c for c in above.collections if isinstance(c, LineCollection))
    error = PathError.of(report.trajectory, report.truth)
    assert error is not None
    assert lines.get_array().max() == pytest.approx(error.distances[1:].max())
    assert (above.get_xlabel(), above.get_ylabel()) == ("x [m]", "y [m]")
    assert side.get_ylabel() == "z [m]"
    assert "[mm]" in bar.get_ylabel()


def test_no_line_is_drawn_across_lost_frames(report: Report) -> None:
    assert report.trajectory is not None
    lines = next(
        c
        for c in path_figure(report.trajectory, report.truth).axes[0].collections
        if isinstance(c, LineCollection)
    )
    assert len(lines.get_segments()) == len(report.trajectory) - 2
    steps = [np.linalg.norm(np.diff(s, axis=0)) for s in lines.get_segments()]
    assert max(steps) < 3 * np.median(steps)


def test_path_alone_and_no_path(report: Report) -> None:
    assert "truth" not in labels(path_figure(report.trajectory))
    for nothing in (None, Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))):
        figure = path_figure(nothing, report.truth)
        assert "no frame was tracked" in figure.texts[0].get_text()
        assert not figure.axes


def test_one_pose_is_a_path_too(report: Report) -> None:
    assert report.trajectory is not None
    one = report.trajectory.rows([0])
    for figure in (path_figure(one, report.truth), path_3d_figure(one), error_figure(one)):
        assert figure_png(figure, dpi=50).startswith(b"\x89PNG")


def test_camera_axes_are_drawn_with_up_upwards() -> None:
    n = 50
    Ts = np.tile(np.eye(4), (n, 1, 1))
    Ts[:, 2, 3], Ts[:, 0, 3] = np.arange(n), 10 * np.sin(np.arange(n) / 9)
    street = Trajectory(np.arange(n, dtype=np.int64) * 10**8, Ts)
    place = scene(street, None)
    assert place is not None
    assert (place.up_axis, place.up_sign, place.ground) == (1, -1.0, (0, 2))
    above, side = path_figure(street).axes
    assert (above.get_xlabel(), above.get_ylabel()) == ("x [m]", "z [m]")
    assert side.yaxis_inverted()


def test_a_straight_road_keeps_its_heights_apart() -> None:
    """Sideways and up differ little on a straight road; the direction of travel tells."""
    Ts = np.tile(np.eye(4), (40, 1, 1))
    s = np.arange(40.0)
    Ts[:, :3, 3] = np.c_[-0.02 * s, -0.03 * s, 1.5 * s]
    place = scene(Trajectory(np.arange(40, dtype=np.int64) * 10**8, Ts), None)
    assert place is not None
    assert (place.up_axis, place.up_sign) == (1, -1.0)


def test_a_world_with_gravity_has_z_up(report: Report) -> None:
    """Also where a drone climbs: the camera's first pose is not the world's."""
    assert report.truth is not None
    Ts = report.truth.Ts_world_body.copy()
    Ts[:, 2, 3] *= 20
    Ts[:, 1, 3] *= 0.01
    place = scene(Trajectory(report.truth.stamps_ns, Ts), None)
    assert place is not None
    assert (place.up_axis, place.up_sign) == (2, 1.0)


def test_errors_lie_inside_the_band_they_claim(report: Report) -> None:
    figure = error_figure(report.trajectory, report.truth)
    assert len(figure.axes) == 6
    assert labels(figure) == {"error", "±3σ claimed"}
    assert figure.axes[0].get_title(loc="left") == "Position error [mm]"
    error = PathError.of(report.trajectory, report.truth)
    assert error is not None
    assert error.sigmas is not None
    line = figure.axes[0].lines[1].get_ydata()
    np.testing.assert_allclose(np.asarray(line, float)[:50], 1000 * error.errors[:50, 0])
    known = error.sigmas > 0
    assert np.mean(np.abs(error.errors[known]) < 3 * error.sigmas[known]) > 0.9


def test_the_error_does_not_depend_on_the_world(report: Report) -> None:
    assert report.truth is not None
    T = se3_exp(np.array([5.0, -3, 2, 0.4, 0.2, -1.0]))
    moved = Trajectory(report.truth.stamps_ns, T @ report.truth.Ts_world_body)
    here = PathError.of(report.trajectory, report.truth)
    there = PathError.of(report.trajectory, moved)
    assert here is not None
    assert there is not None
    np.testing.assert_allclose(here.errors, there.errors, atol=1e-9)
    np.testing.assert_allclose(here.distances, there.distances, atol=1e-9)


def test_without_truth_the_claimed_uncertainty_is_shown(report: Report) -> None:
    figure = error_figure(report.trajectory)
    assert [ax.get_title(loc="left").split(",")[0] for ax in figure.axes] == [
        "Position uncertainty",
        "Rotation uncertainty",
    ]
    assert report.trajectory is not None
    bare = Trajectory(report.trajectory.stamps_ns, report.trajectory.Ts_world_body)
    assert "no covariances" in error_figure(bare).texts[0].get_text()


def test_a_truth_of_another_time_counts_as_none(report: Report) -> None:
    assert report.truth is not None
    later = Trajectory(report.truth.stamps_ns + 10**15, report.truth.Ts_world_body)
    assert PathError.of(report.trajectory, later) is None
    assert "truth" not in labels(path_figure(report.trajectory, later))


def test_inliers_with_keyframes_and_lost_frames(report: Report) -> None:
    figure = inlier_figure(report.estimates)
    assert labels(figure) == {"inliers", "keyframe", "recovered", "lost"}
    ax = figure.axes[0]
    assert max(ax.lines[0].get_ydata()) == max(e.num_inliers for e in report.estimates)


def test_a_dip_survives_thousands_of_frames(report_of: Make) -> None:
    estimates = list(report_of(3000, samples=()).estimates)
    estimates[1501] = replace(estimates[1501], num_inliers=3)
    drawn = inlier_figure(estimates).axes[0].lines[0].get_ydata()
    assert len(drawn) <= 500
    assert min(drawn) == 3


def test_stages_are_stacked_to_the_whole_time(report: Report) -> None:
    figure = timing_figure(report.estimates)
    stages = stage_times(report.estimates)
    assert list(stages) == ["images", "flow", "pose", "detect", "stereo", "bundle"]
    assert labels(figure) == {*stages, "camera period 50 ms"}
    top = max(c.get_paths()[0].vertices[:, 1].max() for c in figure.axes[0].collections)
    assert top == pytest.approx(np.sum(list(stages.values()), axis=0).max())


def test_one_slow_frame_does_not_flatten_the_rest(report: Report) -> None:
    estimates = list(report.estimates)
    estimates[0] = replace(estimates[0], timing={"images": 4000.0})
    ax = timing_figure(estimates).axes[0]
    assert ax.get_ylim()[1] < 200
    assert any("4000 ms" in t.get_text() for t in ax.texts)


def test_many_stages_are_summed_and_nan_counts_as_nothing(report: Report) -> None:
    timing = {f"stage {k}": float(k) for k in range(12)} | {"odd": float("nan"), "total": 66.0}
    estimates = [replace(e, timing=timing) for e in report.estimates]
    costliest = {f"stage {k}" for k in range(6, 12)}
    assert labels(timing_figure(estimates)) >= costliest | {"other"}
    assert "total" not in labels(timing_figure(estimates))


def test_names_of_stages_may_be_anything(report: Report) -> None:
    timing = {"$x_{$": 1.0, "_hidden": 2.0, "\x00": 3.0, "a<b>&": 4.0}
    figure = timing_figure([replace(e, timing=timing) for e in report.estimates])
    assert len(labels(figure)) == 4
    assert "a&lt;b&gt;&amp;" in figure_svg(figure, "timing")


def test_nothing_recorded_is_said() -> None:
    for figure in (timing_figure([]), inlier_figure([])):
        assert figure.axes[0].texts[0].get_text() == "nothing was recorded"


def test_frame_keeps_the_pixels_and_draws_each_track(report: Report) -> None:
    sample = report.samples[0]
    tracks = sample.estimate.tracks
    assert tracks is not None
    figure = frame_figure(sample.image, tracks)
    ax = figure.axes[0]
    shadow_in, trails_in, shadow_out, trails_out = ax.collections
    assert isinstance(trails_in, LineCollection)
    assert isinstance(trails_out, LineCollection)
    assert len(trails_in.get_segments()) == int(tracks.inlier.sum())
    assert len(trails_out.get_segments()) == int((~tracks.inlier).sum())
    np.testing.assert_allclose(trails_in.get_segments()[0][1], tracks.keypoints[tracks.inlier][0])
    assert [line.get_marker() for line in ax.lines] == ["o", "x"]
    opened = Image.open(io.BytesIO(figure_jpeg(figure)))
    assert opened.size == (752, 480)
    assert shadow_in.get_alpha() == shadow_out.get_alpha() == 0.45


@pytest.mark.parametrize("shape", [(370, 1226), (48, 64, 3), (1, 1)])
def test_frames_of_any_shape(shape: tuple[int, ...]) -> None:
    empty = np.zeros((0, 2), np.float32)
    for tracks in (None, Tracks(empty, empty, np.zeros(0, bool))):
        data = figure_jpeg(frame_figure(np.full(shape, 90, np.uint8), tracks))
        width = Image.open(io.BytesIO(data)).size[0]
        assert width == min(shape[1], 960)


def test_tracks_that_are_no_numbers_are_left_out() -> None:
    points = np.array([[1, 2], [np.nan, 3]], np.float32)
    figure = frame_figure(np.zeros((10, 10), np.uint8), Tracks(points, points, np.ones(2, bool)))
    trails = figure.axes[0].collections[1]
    assert isinstance(trails, LineCollection)
    assert len(trails.get_segments()) == 1


def test_svg_has_css_colours_and_nothing_outside(report: Report) -> None:
    svg = figure_svg(inlier_figure(report.estimates), 'a "label" <b>')
    assert svg.startswith("<svg viewBox=")
    assert svg.rstrip().endswith("</svg>")
    assert 'aria-label="a &quot;label&quot; &lt;b&gt;"' in svg
    assert "var(--estimate)" in svg
    assert "var(--lost)" in svg
    assert "http" not in svg
    assert not any(colour in svg for colour in PALETTE.values())
    assert "nan" not in svg.lower()


def test_same_figure_same_bytes(report: Report) -> None:
    pngs, svgs = set(), set()
    for _ in range(2):
        figure = path_figure(report.trajectory, report.truth)
        svgs.add(figure_svg(figure, "path"))
        pngs.add(figure_png(figure, dpi=60))
    assert len(pngs) == len(svgs) == 1


def test_palette_colours_differ() -> None:
    assert len(set(PALETTE.values())) == len(PALETTE)


def test_thin_keeps_both_ends() -> None:
    assert thin(3, 5).tolist() == [0, 1, 2]
    assert thin(1000, 10)[[0, -1]].tolist() == [0, 999]
    assert len(thin(1000, 10)) == 10
    assert thin(0, 5).tolist() == []


def test_gaps_break_lines() -> None:
    stamps = np.array([0, 1, 2, 50, 51]) * 10**8
    values = gaps_as_nan(stamps, np.arange(5.0))
    assert np.isnan(values).tolist() == [False, False, False, True, False]


def test_units_of_axes() -> None:
    assert [unit_of(v)[1] for v in (12.0, 0.3, 0.004)] == ["m", "cm", "mm"]


def test_stages_of_the_most_frames_come_first_and_keep_their_colours(report: Report) -> None:
    first = replace(report.estimates[0], timing={"keyframe": 9.0})
    rest = [replace(e, timing={"track": 3.0, "map": 1.0}) for e in report.estimates[1:]]
    stages = stage_times([first, *rest])
    assert list(stages) == ["track", "map", "keyframe"]
    assert list(stage_colours(stages).values()) == list(STAGES[:3])
    many = {f"stage {k}": np.full(3, float(k)) for k in range(12)}
    colours = stage_colours(many)
    assert [colours[f"stage {k}"] for k in range(6, 12)] == list(STAGES[:6])
    assert {colours[f"stage {k}"] for k in range(6)} == {STAGES[6]}


def test_a_long_legend_stays_inside_the_figure(report: Report) -> None:
    timing = {f"a rather long stage {k}": 1.0 for k in range(12)}
    figure = timing_figure([replace(e, timing=timing) for e in report.estimates])
    figure.canvas.draw()
    ax = figure.axes[0]
    box = ax.get_legend().get_window_extent()
    assert box.y1 <= figure.bbox.y1
    assert box.x0 >= figure.bbox.x0
