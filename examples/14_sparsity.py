"""The normal matrix of a walk through a city is nearly empty: does its factor stay so?

Run it with `python examples/14_sparsity.py`; chapter 5 of docs/lesson explains it.
"""

import numpy as np

from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.ordering import approximate_minimum_degree


def city(num_poses: int, seed: int = 0) -> BlockPattern:
    """Return where the normal matrix has blocks, after a walk on a square grid of streets."""
    rng, side = np.random.default_rng(seed), round(0.72 * num_poses**0.5)
    at, ahead, seen, edges = (side // 2, side // 2), (1, 0), {}, []
    for pose in range(num_poses):
        edges += [(pose - 1, pose)] if pose else []
        edges += [(seen[at], pose)] if at in seen else []  # a place met again
        seen[at] = pose
        left = -ahead[1], ahead[0]
        ways = [ahead] * 3 + [left, (-left[0], -left[1])]
        free = [w for w in ways if 0 <= at[0] + w[0] < side and 0 <= at[1] + w[1] < side]
        ahead = free[rng.integers(len(free))]
        at = at[0] + ahead[0], at[1] + ahead[1]
    first, second = np.array(edges).T
    return BlockPattern.of(np.full(num_poses, 3), first, second)


def orders(pattern: BlockPattern) -> dict[str, np.ndarray]:
    """Return ways to number the poses: which is eliminated first, second, ..."""
    count = len(pattern.sizes)
    return {
        "as they came": np.arange(count),
        "any": np.random.default_rng(1).permutation(count),
        "minimum degree": approximate_minimum_degree(pattern),
    }


def main() -> dict[str, list[float]]:
    pattern = city(1000)
    n, results = pattern.size, {}
    share = (pattern.num_values + 9 * len(pattern.first)) / n**2
    print(
        f"1000 poses, {len(pattern.first)} pairs of them tied: {100 * share:.2f} % of H is filled"
    )
    print(f"{'order':16}thousands in L   million operations")
    print(f"{'H taken as full':16}{n * (n + 1) / 2e3:14.0f} {n**3 / 3e6:14.0f}")
    for name, order in orders(pattern).items():
        factor = BlockCholesky(pattern, order)
        results[name] = [factor.num_nonzeros, factor.flops]
        print(f"{name:16}{factor.num_nonzeros / 1e3:14.0f} {factor.flops / 1e6:14.0f}")
    flops = [BlockCholesky(city(k)).flops / 1e6 for k in (2000, 4000, 8000)]
    print("minimum degree, 2000, 4000, 8000 poses: {:.0f}, {:.0f}, {:.0f} million".format(*flops))
    return results


if __name__ == "__main__":
    main()
