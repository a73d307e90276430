"""The lesson keeps its word: code that is shown runs or stands in an example, links lead somewhere.

A block of Python after a sentence with a link to an example is a part of that example, dedented.
Every other block of Python runs; the blocks of a chapter share their names, from first to last.
"""

import io
import re
import runpy
import textwrap
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from odomap.sensors.frame import Frame
from odomap.simulation.sweepworld import SweepWorld
from odomap.simulation.world import World
from printed import assert_same_output

ROOT = Path(__file__).parent.parent
LESSON = ROOT / "docs" / "lesson"
ORB_SLAM = LESSON / "03_orb_slam.md"
PLACES = LESSON / "03b_bag_of_words.md"
LOOPS = LESSON / "03c_closing_loops.md"
LASERS = LESSON / "04_lidar_slam.md"
BACK_END = LESSON / "05_loop_closure_and_optimisation.md"
PAGES = sorted(LESSON.glob("*.md"))
CHAPTERS = sorted(LESSON.glob("[0-9]*.md"))
EXAMPLE = re.compile(r"\(\.\./\.\./(examples/\w+\.py)\)")


@pytest.fixture(scope="module", autouse=True)
def _pictures_are_rendered_once():
    """Chapters, exercises and programs look at the same worlds."""
    made: dict[Any, Frame] = {}

    def remembered(render: Any) -> Any:
        def frame(self: Any, index: int) -> Frame:
            key = self.spec, index
            if key not in made:
                made[key] = render(self, index)
            # With depth frames are large, and few of those worlds are looked at twice.
            return made[key] if made[key].depth is None else made.pop(key)

        return frame

    with pytest.MonkeyPatch.context() as patch:
        for world in (World, SweepWorld):
            patch.setattr(world, "frame", remembered(world.frame))
        yield


def python_blocks(page: Path) -> list[tuple[str | None, str, str | None]]:
    """Return blocks of Python, each with the example it is from and the output under it."""
    parts = [*page.read_text().split("```"), "", ""]
    found = []
    for before, block, between, after in zip(*(parts[k::2] for k in range(4))):
        language, _, code = block.partition("\n")
        if language == "python":
            sentence = before.strip().split("\n\n")[-1]
            source = EXAMPLE.findall(sentence) if sentence.endswith(":") else []
            is_output = not between.strip() and after.startswith("text\n")
            output = after.removeprefix("text\n") if is_output else None
            found.append((source[-1] if source else None, code, output))
    return found


def shown_outputs(page: Path) -> dict[str, list[str]]:
    """Return what a page prints under `$ python examples/NAME`, by name."""
    blocks = [block.splitlines() for block in page.read_text().split("```")[1::2]]
    consoles = [lines for lines in blocks if lines[0] == "console"]
    return {lines[1].removeprefix("$ python examples/"): lines[2:] for lines in consoles}


def lines_of(code: str) -> list[str]:
    return [line.rstrip() for line in textwrap.dedent(code).strip().splitlines()]


def test_there_are_chapters():
    assert [page.name for page in CHAPTERS] == [
        "01_what_is_slam.md",
        "02_visual_odometry.md",
        "03_orb_slam.md",
        "03b_bag_of_words.md",
        "03c_closing_loops.md",
        "04_lidar_slam.md",
        "05_loop_closure_and_optimisation.md",
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_quoted_code_stands_in_its_example(page):
    for source, code, _ in python_blocks(page):
        if source is None:
            continue
        wanted, lines = lines_of(code), (ROOT / source).read_text().splitlines()
        starts = range(len(lines) - len(wanted) + 1)
        pieces = (lines_of("\n".join(lines[i : i + len(wanted)])) for i in starts)
        assert wanted in pieces, f"{source} does not hold:\n{code}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_free_code_runs_and_prints_what_is_shown(page, capsys):
    names: dict[str, object] = {}
    for number, (source, code, shown) in enumerate(python_blocks(page)):
        if source is None:
            exec(compile(code, f"{page.name}, block {number}", "exec"), names)
            printed = capsys.readouterr().out
            if shown is not None:
                assert_same_output(printed, shown.splitlines())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_formulas_and_fences_are_closed(page):
    text = page.read_text()
    assert text.count("```") % 2 == 0
    prose = "".join(text.split("```")[0::2])
    assert prose.count("$") % 2 == 0
    # GitHub takes a backslash before punctuation away before it looks for formulas.
    assert not re.findall(r"\\[^a-zA-Z\s]", prose)


def test_pictures_are_small_and_all_used():
    pictures = [p for p in sorted((LESSON / "images").iterdir()) if p.suffix in (".png", ".jpg")]
    text = "".join(page.read_text() for page in PAGES)
    assert pictures
    for picture in pictures:
        assert picture.stat().st_size < 150_000, picture.name
        assert f"images/{picture.name}" in text, picture.name


def test_blocks_are_found():
    blocks = [block for page in CHAPTERS for block in python_blocks(page)]
    assert sum(source is not None for source, _, _ in blocks) >= 8
    assert sum(output is not None for _, _, output in blocks) >= 7


@cache
def ran(name: str) -> tuple[Any, str]:
    """Run an example once; return its results and what it printed."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        results = runpy.run_path(str(ROOT / "examples" / name))["main"]()
    return results, printed.getvalue()


SHOWN = {name: lines for page in CHAPTERS[2:] for name, lines in shown_outputs(page).items()}


@pytest.mark.parametrize("name", SHOWN)
def test_an_example_prints_what_is_shown(name):
    assert_same_output(ran(name)[1], SHOWN[name])


@pytest.mark.parametrize(
    ("page", "numbers"),
    [
        (BACK_END, range(12, 18)),
        (ORB_SLAM, range(18, 24)),
        (PLACES, range(24, 25)),
        (LOOPS, range(25, 30)),
        (LASERS, range(30, 48)),
    ],
)
def test_all_examples_of_a_chapter_are_shown(page, numbers):
    files = {p.name for p in (ROOT / "examples").glob("[0-9]*.py") if int(p.name[:2]) in numbers}
    assert files == set(shown_outputs(page))


def test_only_the_graph_knows_where_the_drift_came_from():
    results = ran("12_spread_the_drift.py")[0]
    names = ("gap spread", "motion spread", "graph, all steps alike", "graph")
    medians = [results[name][1] for name in names]
    assert medians == sorted(medians, reverse=True)
    assert [results[name][2] < 4.0 for name in names] == [False, False, True, True]


def test_a_solver_with_a_line_missing_is_not_a_solver():
    costs = ran("13_gauss_newton.py")[0]
    assert costs["gauge"] == pytest.approx(costs[""], rel=1e-6)
    assert 1.002 * costs[""] < costs["J_r"] < 1.02 * costs[""]
    assert min(costs["wrap"], costs["adjoint"]) > 1e3 * costs[""]


def test_minimum_degree_is_worth_its_name():
    results = ran("14_sparsity.py")[0]
    assert 20 * results["minimum degree"][1] < results["any"][1] < results["as they came"][1]


def test_the_start_decides_and_the_proof_tells():
    results = ran("15_start_and_proof.py")[0]
    assert 2.0 * results["chordal"] < results["spanning_tree"]
    assert (results["0.25"], results["0.3"]) == (True, False)


def test_only_the_bundle_is_honest():
    results = ran("17_where_edges_come_from.py")[0]
    assert results["edges, next"] < 0.4
    assert 0.8 < results["sightings"] < 1.2
    assert results["edges, all"] > 3.0


def test_a_map_is_used_again_and_an_odometry_begins_anew():
    results = ran("18_odometry_forgets.py")[0]
    (odometry_mm, odometry_keyframes, _), (map_mm, map_keyframes, _) = (
        results[name][-1] for name in ("RgbdVO", "Slam")
    )
    assert 2.0 * map_mm < odometry_mm
    assert 2 * map_keyframes < odometry_keyframes


def test_an_angle_makes_bits_that_turn():
    results = ran("19_features_by_hand.py")[0]
    assert 4 * results["with"] < results["without"]


def test_a_third_view_is_worth_more_than_all_other_checks():
    wrong = [percent for _, percent in ran("21_checks_of_new_points.py")[0].values()]
    assert wrong == sorted(wrong, reverse=True)
    assert 10 * wrong[-1] < wrong[-2] < wrong[0] / 2


def test_a_window_is_held_by_those_that_see_its_points():
    results = ran("22_fixed_keyframes.py")[0]
    assert results["others that see it"] < 1.5  # two numbers of standard deviation 1
    assert min(results["its oldest two"], results["its oldest one"]) > 5.0


def test_what_hangs_from_keyframes_has_no_cracks():
    paths = ran("23_hang_from_keyframes.py")[0]
    jumps = {
        name: np.linalg.norm(np.diff(path, axis=0), axis=1).max() for name, path in paths.items()
    }
    assert jumps["hung from keyframes"] < 0.12  # a step is 0.1 m
    assert jumps["stored in the world"] > 0.3


def test_more_words_recognise_more_places():
    recalls = list(ran("24_train_a_vocabulary.py")[0].values())
    assert recalls == sorted(recalls)
    assert recalls[0] < 0.5 < 0.7 < recalls[-1]


def test_a_loop_is_measured_and_makes_the_path_better():
    results = ran("25_close_a_loop.py")[0]
    assert results["loop"] < 0.7 * results["path"]
    assert results["with"] < results["without"]


def test_only_similarities_give_one_camera_its_unit_back():
    results = ran("26_scale_drift.py")[0]
    errors = {name: error for name, (error, _, _) in results.items()}
    assert 10 * errors["Sim3"] < errors["SE3"] < errors["no loop"]
    assert results["Sim3"][1] == pytest.approx(1.0, abs=0.02)
    assert results["SE3"][1] < 0.75


def test_a_loop_makes_surer_once():
    results = ran("27_surer_after_a_loop.py")[0]
    sigma, nees = zip(*results.values())
    assert 20 * sigma[1] < sigma[0]
    assert max(nees[:2]) < 1.3
    assert nees[2] > 10.0


def test_a_camera_finds_itself_in_a_saved_map():
    results = ran("28_localise_in_a_map.py")[0]
    assert results["lost"] == 4
    assert results["off_mm"] < 50.0


def test_two_maps_become_one():
    results = ran("29_merge_maps.py")[0]
    assert results["places"] >= 10
    assert results["off"] < 20.0
    assert results["merged"] < 1.5 * max(results["first"], results["second"])


def test_lines_are_worth_more_than_many_steps():
    off = ran("30_icp_step_by_step.py")[0]
    assert off["onto_lines"][5] < 10.0 < 50.0 < off["onto_points"][40]


def test_motions_are_put_together_in_one_way():
    off = list(ran("31_compose_motions.py")[0].values())
    assert off[0] < 1e-6
    assert min(off[1:]) > 10.0


def test_a_map_drifts_less_than_the_last_scan():
    ate = ran("32_scan_to_map.py")[0]
    assert 5.0 * ate["map"] < ate["keyframe"] < ate["last scan"]


def test_a_corridor_is_left_to_the_wheels():
    off = ran("33_corridor.py")[0]
    believed, blind = "both, scans as sure as they say", "both, scans sure to 1 cm everywhere"
    assert off[f"hall, {believed}"] < off["hall, wheels alone"]
    assert off[f"corridor, {believed}"] < 2.0 * off["corridor, wheels alone"]
    assert off[f"corridor, {blind}"] > 10.0 * off[f"corridor, {believed}"]


def test_probabilities_are_not_added():
    wrong = ran("34_log_odds.py")[0]
    assert wrong["tenths"][2] > 0.4
    assert wrong["log-odds"][2] == 0.0
    assert wrong["log-odds"][:3] == wrong["Bayes"][:3]
    assert wrong["with limit"][3] < 20 < wrong["log-odds"][3] < wrong["Bayes"][3]


def test_rays_take_people_away():
    cases = ran("35_rays.py")[0]
    ghosts = [cases[name][1] for name in ("hits alone", "hits and rays", "nothing back: free")]
    assert ghosts[0] > 3 * ghosts[1] > 0
    assert ghosts[2] == 0
    assert [case[3] > 5.0 for case in cases.values()] == [False, False, False, True]


def test_loops_make_walls_single():
    results = ran("36_laser_slam.py")[0]
    (ate_without, walls_without), (ate_with, walls_with) = results.values()
    assert ate_with < 0.8 * ate_without
    assert walls_with > walls_without + 0.1


def test_bounds_spare_nearly_all_poses():
    score, share, off = ran("37_branch_and_bound.py")[0]
    assert score > 0.9
    assert share < 1e-3
    assert off < 0.1


def test_a_robot_finds_itself_in_a_saved_grid():
    for off in ran("38_localise_in_a_grid.py")[0].values():
        assert max(off) < 40.0


def test_a_sweep_is_straightened_by_its_motion():
    for off in ran("39_deskew.py")[0].values():
        deskewed, back = (off[f"p' = exp({xi} t) p"] for xi in ("xi", "-xi"))
        assert deskewed < 10.0 < off["as they came"] < back
        assert off["the same, xi of the sweep before"] < 1.5 * deskewed


def test_a_sweep_fits_the_cells_best_where_it_belongs():
    scores = ran("40_ndt.py")[0]
    assert [s.argmax() for s in scores.values()] == 3 * [24]
    assert scores[1.0].max() < scores[2.0].max() < scores[4.0].max()


def test_surfaces_are_worth_more_than_points_of_rings():
    medians = {way: 1000 * np.median(off[0]) for way, off in ran("41_four_methods.py")[0].items()}
    assert max(medians["gicp"], medians["ndt"]) < medians["plane"] < medians["icp"]
    assert 3 * medians["ndt"] < medians["icp"]


def test_cars_pull_squares_away():
    off = ran("42_planes_in_voxels.py")[0]
    assert off["robust"][-1] < 5.0 < 30.0 < off["squares"][-1]


def test_the_sharpest_points_are_not_the_edges():
    true = ran("43_edges_and_planes.py")[0]
    assert true["sharpest"] < true["none hidden"] < 0.7
    assert min(true["LOAM"], true["LeGO-LOAM"]) > 0.93


def test_the_ground_and_edges_say_different_things():
    off = {name: np.abs(xi) for name, xi in ran("44_two_steps.py")[0].items()}
    upright, level = [0, 1, 5], [2, 3, 4]  # of x y z, roll pitch yaw
    guess, ground, edges = off["the guess"], off["the ground alone"], off["edges alone"]
    assert np.all(ground[level] < 0.2 * guess[level])
    assert np.all(ground[upright] > 0.7 * guess[upright])
    assert np.all(edges[upright] < 0.2 * guess[upright])
    assert edges[2] > 0.5 * guess[2]
    assert np.linalg.norm(off["in turn, then all"][:3]) < 0.03


def test_all_front_ends_follow_a_lidar_and_want_times():
    ate = ran("45_three_front_ends.py")[0]
    for front_end in {name for name, _ in ate}:
        assert ate[front_end, "deskewed"] < 0.03
        assert 2.0 * ate[front_end, "deskewed"] < ate[front_end, "as they came"]


def test_a_place_is_known_turned_and_from_beside():
    right = ran("46_scan_context.py")[0]
    assert right["as it came"] == right["turned by 180 deg"] >= 10
    assert right["3 m to the left"] < 5 < 8 < right["the same, looked for beside"]


def test_loops_bring_a_street_back_to_itself():
    (ate, off, points), (ate_with, off_with, points_with) = ran("47_cloud_map.py")[0].values()
    assert 2.0 * ate_with < ate
    assert 4.0 * off_with < off
    assert points_with < points


@pytest.mark.parametrize("printed", ["off by 3.2 mm, ok", "off by 2.1 mm, no", "off by 2.1 mm"])
def test_other_output_is_noticed(printed):
    assert_same_output("off by 2.1 mm, ok\n", ["off by 2.2 mm, ok"])
    with pytest.raises(AssertionError):
        assert_same_output(printed, ["off by 2.2 mm, ok"])
