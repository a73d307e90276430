"""A cell that is looked at again and again: log-odds, and adding 0.1 to a probability.

Run it with `python examples/34_log_odds.py`; docs/lesson/04_lidar_slam.md explains it.
"""

from itertools import accumulate

import numpy as np

Array = np.ndarray
HIT_WALL, HIT_FREE = 0.4, 0.05  # how often a beam that gets there comes back from a cell
L_HIT, L_MISS = np.log(HIT_WALL / HIT_FREE), np.log((1 - HIT_WALL) / (1 - HIT_FREE))


def by_tenths(p: Array, hit: Array) -> Array:
    return np.clip(p + np.where(hit, 0.1, -0.1), 0.0, 1.0)


def by_bayes(p: Array, hit: Array) -> Array:
    wall, free = (np.where(hit, h, 1 - h) for h in (HIT_WALL, HIT_FREE))
    return wall * p / (wall * p + free * (1 - p))


def by_log_odds(log_odds: Array, hit: Array) -> Array:
    return log_odds + np.where(hit, L_HIT, L_MISS)


def with_limit(log_odds: Array, hit: Array) -> Array:
    return np.clip(by_log_odds(log_odds, hit), -4.0, 4.0)


RULES = {"tenths": by_tenths, "Bayes": by_bayes, "log-odds": by_log_odds, "with limit": with_limit}


def believed(name: str, hits: Array) -> Array:
    """Return the probabilities of (N, looks) cells before the first look and after each."""
    is_sum = name in ("log-odds", "with limit")
    start = np.full(len(hits), 0.0 if is_sum else 0.5)
    states = np.stack(list(accumulate(hits.T, RULES[name], initial=start)), axis=1)
    return 1 / (1 + np.exp(-states)) if is_sum else states


def main() -> dict[str, list[float]]:
    rng, is_wall, results = np.random.default_rng(0), np.arange(4_000) % 2 == 0, {}
    hits = rng.random((4_000, 100)) < np.where(is_wall, HIT_WALL, HIT_FREE)[:, None]
    door = np.arange(1000)[None] < 100  # closed, a hit with each look; then open, a miss with each
    for name in RULES:
        p, door_p = believed(name, hits), believed(name, door)[0]
        wrong = [np.mean((p[:, n] > 0.5) != is_wall) for n in (5, 20, 100)]
        looks = np.flatnonzero(door_p[101:] < 0.5) + 1
        results[name] = [*wrong, looks[0] if len(looks) else np.inf]
        shown = ", ".join(f"{100 * w:4.1f} %" for w in wrong)
        opens = f"after {looks[0]} looks" if len(looks) else "never"
        print(f"{name:10}: wrong after 5, 20, 100 looks {shown}; sees a door open {opens}")
    return results


if __name__ == "__main__":
    main()
