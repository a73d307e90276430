"""A noisy sphere: two ways to start, where each of them ends, and a proof that no end is lower.

Run it with `python examples/15_start_and_proof.py`; chapter 5 of docs/lesson explains it.
"""

import numpy as np

from odomap import PoseGraph, Trajectory, ate, certify, solve
from odomap.geometry.lie import se3_exp, se3_inverse

RINGS, PER_RING, RADIUS_M = 20, 25, 10.0


def sphere(sigma_m: float, sigma_rad: float, seed: int = 0) -> tuple[PoseGraph, Trajectory]:
    """Return the graph of a walk that winds up a sphere, and the truth."""
    k = np.arange(RINGS * PER_RING)
    lon, lat = 2 * np.pi * k / PER_RING, np.clip(np.pi * (k + 0.5) / len(k) - np.pi / 2, -1.4, 1.4)
    out = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    east = np.stack([-np.sin(lon), np.cos(lon), 0 * lon], axis=1)
    Ts = np.tile(np.eye(4), (len(k), 1, 1))
    Ts[:, :3, :3] = np.stack([east, np.cross(out, east), out], axis=2)
    Ts[:, :3, 3] = RADIUS_M * out
    # Each pose knows the next one, and the one above it on the next ring.
    first, second = np.append(k[:-1], k[:-PER_RING]), np.append(k[1:], k[PER_RING:])
    sigma = np.repeat([sigma_m, sigma_rad], 3)
    noise = np.random.default_rng(seed).normal(0.0, sigma, (len(first), 6))
    steps = se3_inverse(Ts[first]) @ Ts[second] @ se3_exp(noise)
    unknown = np.full_like(Ts, np.nan)
    information = np.tile(np.diag(1.0 / sigma**2), (len(first), 1, 1))
    graph = PoseGraph("SE3", unknown, first, second, steps, information)
    return graph, Trajectory(k, Ts)


def main() -> dict[str, float]:
    graph, truth = sphere(0.2, 0.25)
    results = {}
    for start in ("spanning_tree", "chordal"):
        found = solve(graph, initial=start)
        path = Trajectory(truth.stamps_ns, found.Ts_world_node)
        results[start] = error = ate(path, truth).rmse
        print(
            f"{start:13}: cost {found.cost_before:8.0f} at the start, {found.cost_after:.0f} at "
            f"the end after {found.iterations} steps; ATE {error:.2f} m"
        )
    for sigma_rad in (0.25, 0.3):
        graph, _ = sphere(0.2, sigma_rad)
        proof = certify(solve(graph, cost="chordal", initial="chordal").graph)
        results[f"{sigma_rad}"] = proof.certified
        word = "nothing is better" if proof.certified else "not certified"
        print(f"chordal cost {proof.cost:.1f}, none is below {proof.lower_bound:.1f}: {word}")
    return results


if __name__ == "__main__":
    main()
