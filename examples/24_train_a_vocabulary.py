"""Words from the images of one room, places known again in another: how many words are needed?

Run it with `python examples/24_train_a_vocabulary.py`; docs/lesson/03b_bag_of_words.md explains it.
"""

import tempfile
from pathlib import Path

import numpy as np

import odomap
from odomap.vision.orb import OrbConfig, extract

ROUND, MAPPED = 37, 24  # images once round the room, and those of them that are remembered


def looks_of(uri: str) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the descriptors of each image of a recording, and the true poses."""
    source = odomap.open(uri)
    looks = [extract(frame.images[0], OrbConfig()).descriptors for frame in source]
    return looks, source.truth.Ts_world_body


def recall(words: odomap.Vocabulary, looks: list[np.ndarray], Ts: np.ndarray) -> float:
    """Return the share of revisits that are found before the first wrong place is."""
    away = np.linalg.norm(Ts[:, None, :3, 3] - Ts[:, :3, 3], axis=2)  # metres
    trace = np.einsum("iab,jab->ij", Ts[:, :3, :3], Ts[:, :3, :3])
    turned = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    right, wrong = (away < 1) & (turned < 30), (away > 2) | (turned > 60)
    bags, places = [words.transform(look) for look in looks], odomap.Places(words.num_words)
    for k in range(MAPPED):
        places.add(k, bags[k])
    again = range(ROUND + 1, len(looks))
    best = [(q, places.query(bags[q], most=1)) for q in again]
    best = [(q, c.keyframe_ids[0], c.scores[0]) for q, c in best if len(c)]
    bar = max((score for q, k, score in best if wrong[q, k]), default=0.0)
    found = sum(score > bar and right[q, k] for q, k, score in best)
    return float(found / sum(right[q, :MAPPED].any() for q in again))


def main() -> dict[str, float]:
    training, _ = looks_of("sim:room?seed=11&frames=40&sensors=mono&speed=8")
    looks, Ts = looks_of(f"sim:room?seed=4&frames={2 * ROUND}&sensors=mono&speed=8")
    file, results = Path(tempfile.mkdtemp()) / "words.odomap-vocabulary", {}
    for depth in (2, 3, 4):
        odomap.Vocabulary.train(training, branching=10, depth=depth).save(file)
        words, size = odomap.Vocabulary.load(file), file.stat().st_size / 1000
        results[f"10^{depth}"] = recall(words, looks, Ts)
        print(f"{words.num_words:5} words, {size:4.0f} kB: recall {results[f'10^{depth}']:.2f}")
    words = odomap.Vocabulary.load()  # that which comes with odomap
    results["default"] = recall(words, looks, Ts)
    print(f"{words.num_words:5} words, of 1621 other images: recall {results['default']:.2f}")
    return results


if __name__ == "__main__":
    main()
