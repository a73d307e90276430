"""The plan of a map, and how it grew, as figures and as the report's section."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from odomap.geometry.trajectory import Trajectory
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.views.covisibility import MapView
from odomap.views.growing import growth_figure
from odomap.views.mapsection import map_section
from odomap.views.plan import ALPHAS, plan_axes, plan_figure
from odomap.views.record import Growth, Report
from odomap.views.scene import scene
from odomap.views.style import figure_svg

Make = Callable[..., Report]


def room(sees: dict[int, range], landmarks: int = 100) -> Map:
    """A map of keyframes a metre apart that see given landmarks."""
    m = Map()
    for k in sees:
        T = np.eye(4)
        T[0, 3] = k
        m.add_keyframe(Keyframe(k, k), T)
    ids = m.add_landmarks(next(iter(sees)), np.arange(3.0 * landmarks).reshape(-1, 3))
    for k, seen in sees.items():
        m.add_observations(k, ids[list(seen)], np.arange(len(seen)))
    return m


def drawn(figure: Figure) -> list[PathPatch]:
    return [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]


def test_pairs_are_those_that_share_enough() -> None:
    m = room({2: range(60), 5: range(40, 80), 6: range(46, 61), 9: range(90, 100)})
    view = MapView.of(m, scale=2.0)
    # 2 and 5 share 20, 5 and 6 share 15, 2 and 6 share 14.
    assert view.pairs.tolist() == [[1, 2], [0, 1]]
    assert view.shared.tolist() == [15, 20]
    assert view.num_pairs == 2
    np.testing.assert_array_equal(view.keyframes[:, 0], [4.0, 10.0, 12.0, 18.0])
    np.testing.assert_array_equal(view.landmarks, 2.0 * m.points_world(m.landmark_ids))


def test_of_many_pairs_the_strongest_are_kept() -> None:
    m = room({k: range(20 + 2 * k) for k in range(6)})
    view = MapView.of(m, most=4)
    assert view.num_pairs == 15
    assert view.shared.tolist() == [24, 26, 26, 28]
    assert len(MapView.of(m, most=0).pairs) == 0
    assert MapView.of(m, least=27).num_pairs == 1


def test_culled_keyframes_are_not_drawn() -> None:
    m = room({k: range(50) for k in range(4)})
    m.cull_keyframes([1])
    view = MapView.of(m)
    assert len(view.keyframes) == 3
    assert view.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]


def test_an_empty_map_is_a_view_of_nothing() -> None:
    view = MapView.of(Map())
    assert view.keyframes.shape == view.landmarks.shape == (0, 3)
    assert view.pairs.shape == (0, 2)


@pytest.mark.parametrize(
    ("extents", "axes", "title"),
    [
        ((4.0, 5.0, 0.5), (0, 1), "From above"),
        ((0.1, 60.0, 1.2), (0, 1), "From above"),  # a straight road that rises
        ((3.0, 2.0, 2.5), (0, 1), "From above"),
        ((0.5, 5.0, 4.0), (1, 2), "From the side"),
        ((4.0, 0.5, 9.0), (0, 2), "From the side"),
        ((0.0, 0.0, 0.0), (0, 1), "From above"),
    ],
)
def test_a_plan_is_seen_from_above_unless_the_path_climbs(
    extents: tuple[float, ...], axes: tuple[int, int], title: str
) -> None:
    Ts = np.tile(np.eye(4), (30, 1, 1))
    Ts[:, :3, 3] = extents * np.linspace(0, 1, 30)[:, None] ** [1.0, 2.0, 3.0]
    Ts[:, :3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # not the first camera's own world
    place = scene(Trajectory(np.arange(30, dtype=np.int64) * 10**8, Ts), None)
    assert place is not None
    assert plan_axes(place) == axes
    ax = plan_figure(place, MapView.of(room({0: range(5)}))).axes[0]
    assert ax.get_title(loc="left") == title


def test_in_camera_axes_a_side_has_up_upwards() -> None:
    """A lift, seen by a camera whose first pose is the world: y is down."""
    Ts = np.tile(np.eye(4), (30, 1, 1))
    s = np.linspace(0, 1, 30)
    Ts[:, :3, 3] = np.c_[0.1 * s, -2.0 * np.sin(6 * s), 4.0 * s]
    place = scene(Trajectory(np.arange(30, dtype=np.int64) * 10**8, Ts), None)
    assert place is not None
    assert (place.up_axis, plan_axes(place)) == (1, (2, 1))
    assert plan_figure(place, MapView.of(room({0: range(5)}))).axes[0].yaxis_inverted()


def test_a_plan_shows_map_path_and_truth_to_scale(report_of: Make, report: Report) -> None:
    whole = report_of(160, samples=())
    place = scene(whole.trajectory, whole.truth)
    assert place is not None
    assert report.map is not None
    figure = plan_figure(place, report.map)
    ax = figure.axes[0]
    names = [t.get_text() for t in ax.get_legend().get_texts()]
    assert names == [
        "landmark",
        "keyframe",
        "15 or more landmarks shared",
        "truth",
        "path",
        "start",
        "end",
    ]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    figure.canvas.draw()
    (x0, y0), (x1, y1) = ax.transData.transform([(0, 0), (1, 1)])
    assert x1 - x0 == pytest.approx(y1 - y0)
    # The walls, five and four metres away, are inside.
    assert ax.get_xlim()[0] < -5 < 5 < ax.get_xlim()[1]
    assert ax.get_ylim()[0] < -4 < 4 < ax.get_ylim()[1]
    # The keyframes were moved onto the truth, like the path.
    dots = drawn(figure)[-1].get_path().vertices[::2]
    nearest = [np.linalg.norm(place.positions[:, :2] - dot, axis=1).min() for dot in dots]
    assert max(nearest) < 1e-6


def test_the_more_is_shared_the_stronger_the_line(report: Report) -> None:
    place = scene(report.trajectory, report.truth)
    assert place is not None
    assert report.map is not None
    shared = np.array([15, 29, 30, 60, 119, 120, 5000])
    pairs = np.stack([np.arange(7), np.arange(1, 8)], axis=1)
    view = replace(report.map, pairs=pairs, shared=shared, num_pairs=7)
    joins = [patch for patch in drawn(plan_figure(place, view)) if patch.get_zorder() == 2]
    assert [patch.get_alpha() for patch in joins] == list(ALPHAS)
    assert [len(patch.get_path().vertices) // 2 for patch in joins] == [2, 1, 2, 2]


def test_far_landmarks_do_not_press_the_path_into_a_dot(report: Report) -> None:
    place = scene(report.trajectory, report.truth)
    assert place is not None
    assert report.map is not None
    far = np.array([[1e6, 0, 0], [0, -1e7, 0], [np.nan, 0, 0], [0, 0, np.inf]])
    view = replace(report.map, landmarks=np.r_[report.map.landmarks, far])
    ax = plan_figure(place, view).axes[0]
    assert np.ptp(ax.get_xlim()) < 40


def test_a_large_map_is_a_small_drawing(report: Report) -> None:
    place = scene(report.trajectory, report.truth)
    assert place is not None
    rng = np.random.default_rng(1)
    keyframes = rng.normal(size=(3000, 3))
    pairs = rng.integers(0, 3000, (3000, 2))
    view = MapView(keyframes, rng.normal(size=(200_000, 3)), pairs, np.full(3000, 20), 9000)
    svg = figure_svg(plan_figure(place, view), "map")
    assert len(svg) < 700_000
    assert svg.count("<path") < 100


def test_one_pose_and_no_landmark_make_a_plan(report: Report) -> None:
    assert report.trajectory is not None
    place = scene(report.trajectory.rows([0]), None)
    assert place is not None
    svg = figure_svg(plan_figure(place, MapView.of(room({0: range(0)}, 0))), "map")
    assert "nan" not in svg.lower()


def test_growth_begins_at_zero_and_shows_what_was_made(report: Report) -> None:
    assert report.growth is not None
    figure = growth_figure(report.estimates, report.growth)
    assert figure is not None
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles == ["Keyframes", "Landmarks", "Memory held [MB]"]
    assert all(ax.get_ylim()[0] == 0.0 for ax in figure.axes)
    assert len({ax.get_xlim() for ax in figure.axes}) == 1
    kept, made = figure.axes[0].lines
    np.testing.assert_array_equal(kept.get_ydata(), report.growth.keyframes)
    assert np.asarray(made.get_ydata())[-1] == sum(e.is_keyframe for e in report.estimates)


def test_growth_of_thousands_of_frames_keeps_its_peaks(report_of: Make) -> None:
    run = report_of(3000, samples=())
    counts = np.full(3000, 10)
    counts[1501] = 99
    memory = np.array([5.0])
    figure = growth_figure(run.estimates, Growth(counts, counts, np.array([0]), memory))
    assert figure is not None
    line = np.asarray(figure.axes[1].lines[0].get_ydata())
    assert len(line) <= 500
    assert line.max() == 99


def test_growth_without_counts_is_memory_alone_or_nothing(report: Report) -> None:
    none = np.zeros(0, np.int64)
    memory = Growth(none, none, np.array([0, 10]), np.array([300.0, 310.0]))
    figure = growth_figure(report.estimates, memory)
    assert figure is not None
    assert len(figure.axes) == 1
    assert growth_figure([], memory) is None
    assert growth_figure(report.estimates, replace(memory, memory_mb=np.zeros(2))) is None
    assert "<h3>Memory</h3>" in map_section(replace(report, map=None, mapping={}, growth=memory))


def test_the_section_says_what_is_seen(report: Report) -> None:
    shown = map_section(report)
    assert "Seen from above, along z. Green lines join" in shown
    assert report.map is not None
    assert f"the more they share ({report.map.num_pairs} pairs)" in shown
    made, left = sum(e.is_keyframe for e in report.estimates), 12
    assert f"Keyframes: made, {made}; in the map after the last frame, {left}." in shown
    assert "<td>landmarks created</td>" in shown
    assert ">15,321</td>" in shown
    few = replace(report.map, num_pairs=5000)
    assert f"5,000 pairs, the strongest {len(few.pairs):,} drawn" in map_section(
        replace(report, map=few)
    )
    lone = replace(report.map, pairs=few.pairs[:0], shared=few.shared[:0], num_pairs=0)
    assert "No two keyframes share 15 landmarks." in map_section(replace(report, map=lone))


def test_a_loaded_map_is_told_from_what_was_made(report: Report) -> None:
    assert report.growth is not None
    loaded = replace(report.growth, keyframes=report.growth.keyframes + 40)
    assert "Keyframes: in the map before, 40; made," in map_section(replace(report, growth=loaded))


def test_a_start_of_two_views_makes_two_keyframes(report: Report) -> None:
    estimates = [replace(e, is_keyframe=k in (3, 5)) for k, e in enumerate(report.estimates[:8])]
    counts = np.array([0, 0, 0, 2, 2, 2, 1, 1])  # one is culled as another is made, one later
    growth = Growth(counts, counts, np.zeros(0, np.int64), np.zeros(0))
    assert growth.made(estimates).tolist() == [0, 0, 0, 2, 2, 3, 3, 3]
    assert growth.before(estimates) == 0


def test_nothing_told_is_no_section(report: Report) -> None:
    assert map_section(replace(report, map=None, growth=None, mapping={})) == ""
    empty = MapView.of(Map())
    assert map_section(replace(report, map=empty, growth=None, mapping={})) == ""
    assert map_section(replace(report, trajectory=None, growth=None, mapping={})) == ""


def test_names_of_counts_cannot_act(report: Report) -> None:
    shown = map_section(replace(report, mapping={"<b>x_y": 1}))
    assert "&lt;b&gt;x y" in shown
