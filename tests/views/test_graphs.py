"""Pictures of a graph show every kind of edge, from where it can be seen."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.text import Text

from odomap.backend.graphs.posegraph import PoseGraph, Sights
from odomap.geometry.lie import se2_exp, se3_exp
from odomap.views.graphs import graph_figure
from odomap.views.style import figure_png


def ring(space: int, height: float = 0.0) -> PoseGraph:
    n, k = 20, 3 if space == 2 else 6
    xi = np.zeros((n, k))
    angle = np.linspace(0, 2 * np.pi, n)
    xi[:, 0], xi[:, 1] = 10 * np.cos(angle), 10 * np.sin(angle)
    if space == 3:
        xi[:, 2] = height * np.sin(3 * angle)
    Ts = (se2_exp if space == 2 else se3_exp)(xi)
    first, second = np.array([*range(n - 1), 0, 3]), np.array([*range(1, n), n - 1, 15])
    Zs = np.linalg.inv(Ts[first]) @ Ts[second]
    marks = np.array([1])
    sights = Sights(
        np.zeros((1, space)), marks, marks, marks - 1, np.zeros((1, space)), np.eye(space)[None]
    )
    group = "SE2" if space == 2 else "SE3"
    return PoseGraph(
        group, Ts, first, second, Zs, np.tile(np.eye(k), (len(first), 1, 1)), points=sights
    )


@pytest.mark.parametrize(("space", "height"), [(2, 0.0), (3, 0.5), (3, 8.0)])
def test_what_is_drawn(space, height):
    graph = ring(space, height)
    rejected = np.arange(graph.num_edges) == graph.num_edges - 1
    figure = graph_figure(graph, graph.positions + 1.0, rejected, "Before: dead reckoning")
    before, after = figure.axes
    assert before.get_title(loc="left") == "Before: dead reckoning"
    assert after.get_title(loc="left") == "After"
    for ax in figure.axes:
        drawn = {
            lines.get_label(): lines.get_segments()
            for lines in ax.collections
            if isinstance(lines, LineCollection)
        }
        assert {name: len(lines) for name, lines in drawn.items()} == {
            "loop": 1,
            "path": 19,
            "rejected": 1,
        }
        assert "seen obliquely" in ax.get_xlabel() if height > 1 else ax.get_xlabel() == "x [m]"
    if height < 1:
        np.testing.assert_allclose(drawn["rejected"][0], graph.positions[[3, 15], :2])
    assert [text.get_text() for text in after.get_legend().get_texts()] == [
        "loop",
        "rejected",
        "path",
        "landmark",
    ]
    assert figure_png(figure) == figure_png(
        graph_figure(graph, graph.positions + 1.0, rejected, "Before: dead reckoning")
    )


def test_the_legend_stays_on_the_paper():
    figure = graph_figure(ring(2), ring(2).positions, np.arange(21) > 19)
    figure.draw_without_rendering()
    box = figure.axes[-1].get_legend().get_window_extent()
    (title,) = figure.findobj(lambda a: isinstance(a, Text) and a.get_text() == "After")
    assert box.y1 <= figure.bbox.y1
    assert box.x0 > title.get_window_extent().x1


def test_the_end_alone():
    figure = graph_figure(ring(2))
    assert len(figure.axes) == 1


def test_nodes_that_nothing_ties_are_dots():
    graph = ring(2).without(np.ones(21, bool))
    (after,) = graph_figure(graph).axes
    assert [text.get_text() for text in after.get_legend().get_texts()] == ["node", "landmark"]
