"""k-majority: clusters of binary descriptors, and trees of such clusters.

A mean of bit strings is no bit string. What minimises the summed Hamming distance Σ_i d(x_i, c)
is found for each bit alone: the value that most members have,

    c_b = [Σ_i x_ib > n / 2],       assign x_i to argmin_j d(x_i, c_j),       repeat.

Neither step can raise the sum, so that it ends; centres begin as in k-means++, each drawn from the
members with probability ∝ d², d their distance to the nearest centre so far. Clusters are divided
again, level by level. Members are only ever re-ordered: a cluster is a range of one permutation,
and a member lies in the child whose centre is nearest to it, ties to the first.

Cost: O(n k rounds) for each of the levels, 2 ns a distance: a million descriptors in five levels
of ten take some 10 s. The same members, order and seed give the same tree.

Reference: Grana, Borghesani, Manfredi, Cucchiara, "A fast approach for integrating ORB descriptors
in the bag of words model", SPIE 8667, 2013; Arthur, Vassilvitskii, "k-means++", SODA 2007.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.vision.hamming import NO_DISTANCE, hamming

__all__ = ["cluster", "grow", "warm_up"]

Words = NDArray[np.uint64]
Index = NDArray[np.int64]
Progress = Callable[[int, int, str], None]

ROUNDS = 16
"""Most rounds of a division; most end earlier, and what later ones gain is little."""


def cluster(words: Words, k: int, seed: int = 0) -> tuple[Words, Index]:
    """Divide descriptors into clusters.

    Args:
        words: (N, 4) uint64.
        k: clusters wanted; there are fewer where fewer descriptors differ.
        seed: of the draws.

    Returns:
        (C, 4) centres, no two the same to their members, and the (N,) cluster of each descriptor.
    """
    order = np.arange(len(words))
    centres, sizes = np.empty((k, 4), np.uint64), np.empty(k, np.int64)
    count = _divide(words, order, 0, len(words), k, ROUNDS, _state(seed, 0), centres, sizes)
    labels = np.empty(len(words), np.int64)
    labels[order] = np.repeat(np.arange(count), sizes[:count])
    return centres[:count], labels


def grow(
    words: Words, branching: int, depth: int, seed: int = 0, progress: Progress | None = None
) -> tuple[Words, Index]:
    """Divide descriptors again and again.

    Args:
        words: (N, 4) uint64.
        branching: children of a node, at most.
        depth: levels below the root.
        seed: of the draws.
        progress: told how many of the descriptors, once for each level, are done.

    Returns:
        (M, 4) centres of all nodes, level by level, the root's being 0; and their (M,) numbers of
        children, which follow each other: those of the root, then those of its first child, ...
    """
    order, total = np.arange(len(words)), len(words) * depth
    levels, counts = [np.zeros((1, 4), np.uint64)], []
    spans, node = [(0, len(words))], 0
    centres, sizes = np.empty((branching, 4), np.uint64), np.empty(branching, np.int64)
    for level in range(depth):
        below: list[tuple[int, int]] = []
        for start, end in spans:
            state = _state(seed, node)
            count = _divide(words, order, start, end, branching, ROUNDS, state, centres, sizes)
            node += 1
            if count < 2:  # its members are all the same: nothing to divide
                counts.append(0)
                continue
            counts.append(count)
            levels.append(centres[:count].copy())
            ends = start + np.cumsum(sizes[:count])
            below += zip([start, *ends[:-1].tolist()], ends.tolist())
            if progress is not None:
                progress(level * len(words) + end, total, f"level {level + 1} of {depth}")
        spans = below
    counts += [0] * len(spans)
    return np.concatenate(levels), np.array(counts, np.int64)


def _state(seed: int, node: int) -> Words:
    """Return the state of a generator of its own for each node."""
    state = np.random.SeedSequence([seed, node]).generate_state(1, np.uint64)
    return state.astype(np.uint64, copy=False)


@kernel
def _draw(state: Words) -> float:
    """A number in [0, 1) by xorshift: x ^= x << 13, x ^= x >> 7, x ^= x << 17."""
    x = max(state[0], np.uint64(1))  # of nothing but zeros nothing else follows
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return float(x >> np.uint64(11)) / 9007199254740992.0


@kernel
def _begin(
    words: Words, order: Index, start: int, end: int, k: int, state: Words, centres: Words
) -> int:
    """Centres for a start: the next one is a member i with probability d_i² / Σ d²."""
    nearest = np.full(end - start, NO_DISTANCE, np.int64)
    chosen = order[start + int(_draw(state) * (end - start))]
    for c in range(k):
        for w in range(4):
            centres[c, w] = words[chosen, w]
        total = 0
        for i in range(end - start):
            nearest[i] = min(nearest[i], hamming(words, order[start + i], centres, c))
            total += nearest[i] * nearest[i]
        if total == 0:  # every member is a centre already
            return c + 1
        left = int(_draw(state) * total)
        for i in range(end - start):
            left -= nearest[i] * nearest[i]
            if left < 0:
                chosen = order[start + i]
                break
    return k


@kernel
def _assign(
    words: Words, order: Index, start: int, end: int, centres: Words, count: int, label: Index
) -> int:
    """label_i = argmin_c d(x_i, c); return how many changed."""
    moved = 0
    for i in range(start, end):
        best, at = NO_DISTANCE, 0
        for c in range(count):
            d = hamming(words, order[i], centres, c)
            if d < best:
                best, at = d, c
        moved += label[i - start] != at
        label[i - start] = at
    return moved


@kernel
def _vote(
    words: Words, order: Index, start: int, end: int, label: Index, centres: Words, count: int
) -> None:
    """c_b = [Σ x_ib > n / 2] over the members of each cluster; one without members stays."""
    ones, sizes = np.zeros((count, 256), np.int32), np.zeros(count, np.int64)
    for i in range(start, end):
        votes = ones[label[i - start]]
        sizes[label[i - start]] += 1
        for w in range(4):
            word = words[order[i], w]
            for b in range(64):
                votes[64 * w + b] += np.int32((word >> np.uint64(b)) & np.uint64(1))
    for c in range(count):
        if sizes[c] == 0:
            continue
        for w in range(4):
            word = np.uint64(0)
            for b in range(64):
                if 2 * ones[c, 64 * w + b] > sizes[c]:
                    word |= np.uint64(1) << np.uint64(b)
            centres[c, w] = word


@kernel
def _sort_by_label(
    order: Index, start: int, end: int, label: Index, centres: Words, count: int, sizes: Index
) -> int:
    """Bring members of one cluster together, stably, and drop clusters without members."""
    place, kept = np.zeros(count + 1, np.int64), np.empty(end - start, np.int64)
    for i in range(end - start):
        place[label[i] + 1] += 1
    filled = 0
    for c in range(count):
        if place[c + 1] > 0:
            for w in range(4):
                centres[filled, w] = centres[c, w]
            sizes[filled] = place[c + 1]
            filled += 1
        place[c + 1] += place[c]
    for i in range(end - start):
        kept[place[label[i]]] = order[start + i]
        place[label[i]] += 1
    for i in range(end - start):
        order[start + i] = kept[i]
    return filled


@kernel
def _divide(
    words: Words,
    order: Index,
    start: int,
    end: int,
    k: int,
    rounds: int,
    state: Words,
    centres: Words,
    sizes: Index,
) -> int:
    """Divide the members order[start:end] into at most k clusters, sorted; return how many."""
    if end <= start:
        return 0
    count = _begin(words, order, start, end, k, state, centres)
    label = np.full(end - start, -1, np.int64)
    # The last thing done is an assignment: members lie where they are nearest.
    for done in range(rounds + 1):
        moved = _assign(words, order, start, end, centres, count, label)
        if moved == 0 or done == rounds:
            break
        _vote(words, order, start, end, label, centres, count)
    return _sort_by_label(order, start, end, label, centres, count, sizes)


def warm_up() -> None:
    """Compile the kernels of this module."""
    cluster(np.arange(8, dtype=np.uint64).reshape(2, 4), 2)
