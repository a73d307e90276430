"""Draw the pictures of chapter 3b: `python docs/lesson/images/make_figures_3b.py [NAME ...]`.

All of them come from simulated worlds and from the examples, so that anyone gets the same.
"""

import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from make_figures import BLUE, GREEN, GREY, INK, ORANGE, RED, example, panels, save_figures
from matplotlib.figure import Figure
from numpy.typing import NDArray

import odomap
from odomap.views.style import dress, new_figure
from odomap.vision.features import Features
from odomap.vision.orb import OrbConfig, extract

TWICE_ROUND = "sim:room?seed=4&frames=74&sensors=mono&speed=8"
ROUND, MAPPED = 37, 24


@cache
def walk() -> tuple[list[NDArray[np.uint8]], list[Features], NDArray[np.float64]]:
    """Return the images, their features, and the true poses of two rounds through a room."""
    source = odomap.open(TWICE_ROUND)
    images = [frame.images[0] for frame in source]
    found = [extract(image, OrbConfig()) for image in images]
    return images, found, source.truth.Ts_world_body


@cache
def compared(Ts_bytes: bytes) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which pairs of views show one place, and which surely do not."""
    Ts = np.frombuffer(Ts_bytes).reshape(-1, 4, 4)
    away = np.linalg.norm(Ts[:, None, :3, 3] - Ts[:, :3, 3], axis=2)
    trace = np.einsum("iab,jab->ij", Ts[:, :3, :3], Ts[:, :3, :3])
    turned = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return (away < 1) & (turned < 30), (away > 2) | (turned > 60)


def similarity(words: odomap.Vocabulary) -> NDArray[np.float64]:
    """Return the scores of all pairs of images of the walk."""
    bags = [words.transform(found.descriptors) for found in walk()[1]]
    return np.array([[a.score(b) for b in bags] for a in bags])


def word_patches() -> Figure:
    """What words look like: patches that got one word, from images of both rounds."""
    images, features, _ = walk()
    words = odomap.Vocabulary.load()
    rows = [words.words_of(found.descriptors) for found in features]
    together = np.concatenate(rows)
    image_of = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    feature_of = np.concatenate([np.arange(len(row)) for row in rows])
    counts = np.bincount(together, minlength=words.num_words)
    often = np.argsort(-counts, kind="stable")[[1, 40, 120, 400, 800]]
    figure = new_figure(9.6, 3.9)
    axes = figure.subplots(len(often), 14, gridspec_kw={"wspace": 0.08, "hspace": 0.08})
    figure.subplots_adjust(left=0.16, right=0.99, top=0.985, bottom=0.015)
    for row, word in zip(axes, often):
        at = np.flatnonzero(together == word)
        at = at[np.linspace(0, len(at) - 1, min(14, len(at))).astype(int)]
        for ax in row:
            ax.axis("off")
        for ax, k in zip(row, at):
            found, n = features[image_of[k]], feature_of[k]
            ax.imshow(patch(images[image_of[k]], found, n), cmap="gray", vmin=0, vmax=255)
        row[0].text(
            -0.2, 0.5, f"word {word}\n{counts[word]} times\nweight {words.weights[word]:.1f}",
            transform=row[0].transAxes, ha="right", va="center", fontsize=8, color=INK,
        )  # fmt: skip
    return figure


def patch(image: NDArray[np.uint8], found: Features, n: int) -> NDArray[np.uint8]:
    """Return the patch that a feature describes, turned by its angle and to one size."""
    scale, angle = 1.2 ** float(found.level[n]), np.radians(found.angle[n])
    v, u = np.mgrid[-15:16, -15:16] * scale
    x = found.keypoints[n, 0] + np.cos(angle) * u - np.sin(angle) * v
    y = found.keypoints[n, 1] + np.sin(angle) * u + np.cos(angle) * v
    x, y = (np.clip(np.rint(c), 0, n - 1).astype(int) for c, n in ((x, 640), (y, 400)))
    return image[y, x]


def similarity_matrix() -> Figure:
    """Every image of two rounds compared with every other, and where it was taken."""
    Ts = walk()[2]
    S, (right, wrong) = similarity(odomap.Vocabulary.load()), compared(Ts.tobytes())
    figure, axes = panels(2, 9.6, 4.3, 0.12)
    shown = axes[0].imshow(S, cmap="Blues", vmin=0.0, vmax=0.2)
    figure.colorbar(shown, ax=axes[0], fraction=0.046, pad=0.03).ax.tick_params(labelsize=8)
    dress(axes[0], "score", "image", "image")
    axes[1].imshow(np.where(right, 2.0, np.where(wrong, 0.0, 1.0)), cmap="Greens", vmin=0, vmax=2.6)
    dress(axes[1], "the truth: near, in between, elsewhere", "image")
    for ax in axes:
        ax.grid(False)
        ax.axhline(ROUND + 0.5, color=ORANGE, lw=0.8)
        ax.axvline(ROUND + 0.5, color=ORANGE, lw=0.8)
    return figure


def precision_recall() -> Figure:
    """Precision over recall as the threshold falls: vocabularies, and the score made relative."""
    names = example("24_train_a_vocabulary")
    training, _ = names["looks_of"]("sim:room?seed=11&frames=40&sensors=mono&speed=8")
    figure, axes = panels(2, 9.6, 3.6, 0.2)
    for depth, colour in ((2, GREY), (3, ORANGE), (4, GREEN)):
        words = odomap.Vocabulary.train(training, 10, depth)
        draw(axes[0], similarity(words), False, colour, f"{words.num_words} words, one room")
    S = similarity(odomap.Vocabulary.load())
    draw(axes[0], S, False, BLUE, "98730 words, 1621 images")
    draw(axes[1], S, False, BLUE, "the score")
    draw(axes[1], S, True, RED, "over that with the image before")
    for ax, title in zip(axes, ("vocabularies", "what the score is compared with")):
        dress(ax, title, "recall", "precision" if ax is axes[0] else "")
        ax.set(xlim=(0, 1.02), ylim=(0.3, 1.02))
        ax.legend(loc="lower left", fontsize=8, frameon=False, labelcolor=INK)
    return figure


def draw(ax: Any, S: NDArray[np.float64], relative: bool, colour: str, label: str) -> None:
    """Draw precision over recall of the second round, asked about two thirds of the first."""
    right, wrong = compared(walk()[2].tobytes())
    new = np.arange(ROUND + 1, len(S))
    best = S[new, :MAPPED].argmax(axis=1)
    score, before = S[new, best], S[new, new - 1]
    score = score / np.maximum(before, 1e-9) if relative else score
    order = np.argsort(-score, kind="stable")
    ok, false = right[new, best][order].cumsum(), wrong[new, best][order].cumsum()
    counted = np.flatnonzero(ok + false > 0)
    answerable = right[new, :MAPPED].any(axis=1).sum()
    precision = ok[counted] / (ok + false)[counted]
    ax.plot(ok[counted] / answerable, precision, "-", color=colour, lw=1.8, label=label)


def exercise_2() -> Figure:
    """What the solution of the exercise finds with its largest vocabulary."""
    names = example("exercise_2_solution")
    (images, Ts), (learnt, _) = names["signs_of"](TWICE_ROUND), names["signs_of"](names["TRAINING"])
    figure: Figure = names["draw"](
        *names["compare"](images, Ts, names["Vocabulary"](learnt, 10, 4))
    )
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    word_patches,
    similarity_matrix,
    precision_recall,
    exercise_2,
)


if __name__ == "__main__":
    save_figures(FIGURES, sys.argv[1:])
