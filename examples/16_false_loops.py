"""One false loop, forty false loops: what they do to a map, and what helps.

Run it with `python examples/16_false_loops.py`; chapter 5 of docs/lesson explains it.
"""

import numpy as np

from odomap import Loss, PoseGraph, solve
from odomap.geometry.lie import se2_exp, se2_inverse

POSES, REACH = 500, 12  # of a walk on a grid of streets
LOSSES = "quadratic", "huber", "cauchy", "geman_mcclure"
WAYS = {n: {"loss": Loss(n), "initial": "chordal"} for n in LOSSES} | {"gnc": {"robust": "gnc"}}


def city(seed: int, num_false: int) -> tuple[PoseGraph, np.ndarray]:
    """Return a walk through streets, its loops true and false, and the true poses."""
    rng, at, ahead, seen, loops, walk = np.random.default_rng(seed), 0j, 1 + 0j, {}, [], []
    for pose in range(POSES):
        loops += [(seen[at], pose)] if at in seen else []
        seen[at] = pose
        ways = at + ahead * np.array([1, 1, 1, 1j, -1j])  # the plane is that of complex numbers
        ways = ways[np.maximum(abs(ways.real), abs(ways.imag)) <= REACH]
        onward = complex(ways[rng.integers(len(ways))])
        walk.append((at.real, at.imag, np.angle(onward - at)))
        at, ahead = onward, onward - at
    Ts = se2_exp(np.array(walk) * [0, 0, 1])
    Ts[:, :2, 2] = np.array(walk)[:, :2]
    false = np.random.default_rng(seed).integers((0, 20), POSES - 20, (num_false, 2))
    false = false @ [[1, 1], [0, 1]] % POSES  # places that look alike, taken for one
    first, second = np.array([(k, k + 1) for k in range(POSES - 1)] + loops + [*false]).T
    sigma = np.tile([0.05, 0.05, 0.03], (len(first), 1))
    sigma[: POSES - 1, 2] = 0.1  # wheels
    motion = se2_inverse(Ts[first]) @ Ts[second]
    motion[len(first) - num_false :] = np.eye(3)
    measured = motion @ se2_exp(rng.normal(0.0, sigma))
    unknown = np.full_like(Ts, np.nan)
    return PoseGraph("SE2", unknown, first, second, measured, np.eye(3) / sigma[:, None] ** 2), Ts


def ate(path: np.ndarray, truth: np.ndarray) -> float:
    """Return the ATE in metres; a turn is a factor of length 1."""
    p, q = ((Ts - Ts.mean(axis=0))[:, :2, 2] @ [1.0, 1.0j] for Ts in (path, truth))
    return float(np.sqrt(np.mean(abs(q - np.exp(1j * np.angle(np.vdot(p, q))) * p) ** 2)))


def main() -> None:
    print("false loops" + "".join(f"{name:>15}" for name in WAYS) + ", leaves out")
    for num_false in (0, 1, 40):
        graph, truth = city(4, num_false)
        solved = [solve(graph, **how) for how in WAYS.values()]
        errors = [ate(found.Ts_world_node, truth) for found in solved]
        shown = f"{num_false:3} of {graph.is_loop.sum()} " + "".join(f"{e:13.2f} m" for e in errors)
        out = np.flatnonzero(solved[-1].is_rejected) >= graph.num_edges - num_false
        print(f"{shown}, {out.sum()} false, {(~out).sum()} true")


if __name__ == "__main__":
    main()
