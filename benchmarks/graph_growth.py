"""Manhattan worlds of any size, and how the time to solve them grows.

A robot walks through a city, a metre per pose, and at every crossing turns left or right or goes
straight on; where it comes to within a metre of a place it has been to, it often measures its pose
relative to that place. The city grows with the walk, so that every size has about as many loops
per pose: the graph gets larger, and not denser.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from graphs import Problem, chained
from numpy.typing import NDArray

from odomap.geometry.lie import se2_exp, se2_inverse
from odomap.views.style import PALETTE, dress, figure_png, legend, new_figure

Array = NDArray[np.float64]
SIZES = (1000, 2000, 5000, 10000, 20000)
BLOCK = 5
"""Metres between crossings."""
SIGMAS = np.array([0.05, 0.05, 0.01])
"""Of what is measured: metres, metres, radians."""
OFTEN = 0.6
"""Share of the poses near an earlier one that are tied to it."""
OLD = 20
"""Poses after which a place counts as been to."""
COLOURS = {"odomap": "estimate", "gtsam": "keyframe", "g2opy": "good"}


def manhattan(poses: int, seed: int = 0) -> Problem:
    """Return a world of that many poses, the same for the same seed; it starts at odometry."""
    rng = np.random.default_rng(seed)
    truth = _walk(poses, rng)
    first, second = _loops(truth, rng)
    first = np.concatenate([np.arange(poses - 1), first])
    second = np.concatenate([np.arange(1, poses), second])
    exact = se2_inverse(truth[first]) @ truth[second]
    measured = exact @ se2_exp(rng.normal(size=(len(first), 3)) * SIGMAS)
    information = np.tile(np.diag(SIGMAS**-2.0), (len(first), 1, 1))
    odometry = chained(poses, first[: poses - 1], second[: poses - 1], measured[: poses - 1])
    return Problem(f"manhattan_{poses}", odometry, first, second, measured, information)


def _walk(poses: int, rng: np.random.Generator) -> Array:
    """Return true poses (N, 3, 3) along the streets of a city that has √N metres to a side."""
    size = BLOCK * max(2, round(np.sqrt(poses) / BLOCK))
    truth = np.tile(np.eye(3), (poses, 1, 1))
    place, ahead = np.array([0, 0]), np.array([1, 0])
    for T in truth:
        if (place % BLOCK == 0).all():
            ways = [np.array(way) for way in ((1, 0), (0, 1), (-1, 0), (0, -1))]
            ways = [way for way in ways if way @ ahead >= 0 and _is_inside(place + way, size)]
            ahead = ways[rng.integers(len(ways))]
        T[:2, 0], T[:2, 1], T[:2, 2] = ahead, (-ahead[1], ahead[0]), place
        place = place + ahead
    return truth


def _is_inside(place: NDArray[np.int64], size: int) -> bool:
    return bool((place >= 0).all() and (place <= size).all())


def _loops(truth: Array, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of poses at, or next to, the same place: for each the one seen there last."""
    places = np.rint(truth[:, :2, 2]).astype(int).tolist()
    is_tied = rng.random(len(places)) < OFTEN
    last: dict[tuple[int, int], int] = {}
    pairs = []
    for now, (x, y) in enumerate(places):
        near = [last.get((x + dx, y + dy)) for dx, dy in ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1))]
        seen = next((k for k in near if k is not None and now - k > OLD), None)
        if seen is not None and is_tied[now]:
            pairs.append((seen, now))
        last[x, y] = now
    ends = np.array(pairs, np.int64).reshape(-1, 2)
    return ends[:, 0], ends[:, 1]


def exponent(times: Mapping[int, float]) -> float:
    """Return b of the power law seconds = a · poses^b that fits best in logarithms."""
    poses, seconds = np.log(list(times)), np.log(list(times.values()))
    return float(np.polyfit(poses, seconds, 1)[0])


def show(times: Mapping[str, Mapping[int, float]], path: Path | None) -> None:
    """Print every solver's exponent, and draw its times if there is a path."""
    for who, several in times.items():
        listed = ", ".join(f"{n}: {seconds:.3f}" for n, seconds in several.items())
        print(f"{who}: seconds ~ poses^{exponent(several):.2f} ({listed})")
    if path is not None:
        path.write_bytes(draw(times))
        print(f"written: {path}")


def draw(times: Mapping[str, Mapping[int, float]]) -> bytes:
    """Return a PNG of seconds over poses, both logarithmic."""
    figure = new_figure(6.4, 3.6)
    ax = dress(figure.add_subplot(), "Time to solve", "poses", "seconds")
    for (who, several), marker in zip(times.items(), "os^v", strict=False):
        ax.loglog(
            list(several),
            list(several.values()),
            marker=marker,
            markersize=4,
            linewidth=1.4,
            color=PALETTE[COLOURS[who]],
            label=f"{who} ~ N^{exponent(several):.2f}",
        )
    sizes: Sequence[int] = list(next(iter(times.values())))
    ax.set_xticks(sizes, [f"{n:,}" for n in sizes])
    ax.minorticks_off()
    legend(ax)
    return figure_png(figure)
