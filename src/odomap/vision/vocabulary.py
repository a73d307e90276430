"""Vocabulary trees: an image as the words it contains.

Descriptors are sorted into the leaves of a tree of centres: at each node a descriptor goes to the
nearest child (Hamming distance, ties to the first). A leaf is a word w, weighted by how rare it is
in the N images of training, and an image of n features is a vector over words,

    v_w = (n_w / n) ln(N / N_w),  scaled to Σ v_w = 1;      s(a, b) = 1 − ½ Σ |a_w − b_w|,

which is Σ min(a_w, b_w): 1 for the same words in the same proportions, 0 for none in common. The
nodes that features pass at a level form the direct index: features of two images that are one
point mostly share their node, so that only those have to be compared.

Nodes are numbered level by level, the children of a node one after the other: a tree is an array
of centres and one of numbers of children. Cost: O(k L) distances per feature, some 0.2 µs.

Reference: Gálvez-López, Tardós, "Bags of binary words for fast place recognition in image
sequences", T-RO 28(5), 2012; Nistér, Stewénius, "Scalable recognition with a vocabulary tree",
CVPR 2006.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.kernels import kernel
from odomap.vision.hamming import NO_DISTANCE, as_words, hamming

__all__ = ["BagOfWords", "VocabularyTree", "warm_up"]

Descriptors = NDArray[np.uint8]
Index = NDArray[np.int64]

LEAST_BRANCHING, MOST_BRANCHING, MOST_DEPTH = 2, 255, 16
MOST_NODES = 1 << 22
"""More nodes than any vocabulary in use has; their centres take 128 MB."""
DIRECT_LEVEL = 1
"""Level of the direct index: of what all pairs would match, four fifths share a node of the first
level, half of the second, a third of the third."""


@dataclass(frozen=True, eq=False)
class BagOfWords:
    """The words of an image.

    Attributes:
        words: (W,) int64 words that occur, ascending.
        weights: (W,) float64, their sum is 1; empty where no feature has a word that counts.
        nodes: (N,) int64 of each feature, the node it passes at the level of the direct index.
    """

    words: Index
    weights: NDArray[np.float64]
    nodes: Index

    def __len__(self) -> int:
        return len(self.words)

    def score(self, other: "BagOfWords") -> float:
        """Return how alike two images are, 0 to 1: Σ min(a_w, b_w)."""
        _, mine, theirs = np.intersect1d(
            self.words, other.words, assume_unique=True, return_indices=True
        )
        return min(1.0, float(np.minimum(self.weights[mine], other.weights[theirs]).sum()))


@dataclass(frozen=True, eq=False)
class VocabularyTree:
    """A tree of centres whose leaves are words.

    Attributes:
        centres: (M, 32) uint8 of the nodes, level by level; that of the root means nothing.
        num_children: (M,) int64; the children of a node follow those of the node before it.
        weights: (W,) float64 of the words, which are the leaves in the order of nodes.
        branching: most children that a node may have.
        depth: most levels below the root.
        num_images: it was trained on; 0 where that is not known.
    """

    centres: Descriptors
    num_children: Index
    weights: NDArray[np.float64]
    branching: int
    depth: int
    num_images: int = 0

    def __post_init__(self) -> None:
        """Make sure that it is a tree.

        Raises:
            InputError: it is none, or a weight is no weight.
        """
        _check_sizes(self.branching, self.depth)
        problem = self._problem()
        if problem:
            raise InputError(f"vocabulary: {problem}")
        for array in (self.centres, self.num_children, self.weights):
            array.setflags(write=False)

    def _problem(self) -> str:
        nodes, children = len(self.num_children), self.num_children
        if not 2 <= nodes <= MOST_NODES:
            return f"has {nodes} nodes: from 2 to {MOST_NODES} can be"
        if self.centres.shape != (nodes, 32):
            return f"has centres of shape {self.centres.shape}, not {(nodes, 32)}"
        if children.min() < 0 or children.max() > self.branching:
            return f"a node has not 0 to {self.branching} children"
        before = np.cumsum(children) - children
        if children.sum() != nodes - 1 or (before < np.arange(nodes)).any():
            return "its numbers of children make no tree"
        if len(self._levels) - 2 > self.depth:
            return f"has more than {self.depth} levels"
        if self.weights.shape != (self.num_words,):
            return f"has {self.num_words} words, but weights of shape {self.weights.shape}"
        if not (np.isfinite(self.weights) & (self.weights >= 0)).all():
            return "a weight is negative or not finite"
        return ""

    @classmethod
    def train(
        cls,
        descriptors: Sequence[Descriptors] | Descriptors,
        branching: int = 10,
        depth: int = 5,
        seed: int = 0,
        progress: Callable[[int, int, str], None] | None = None,
    ) -> Self:
        """Find words in the descriptors of images.

        Args:
            descriptors: (n, 32) uint8 of each image; of one array every row is an image of its own.
            branching: children of a node, 2 to 255.
            depth: levels, 1 to 16; at most branching**depth words.
            seed: of the random draws.
            progress: called with done, total and a text.

        Raises:
            InputError: there are less than two images with descriptors, or less than two different
                descriptors; or they are of another length.

        Example:
            >>> images = [np.full((1, 32), k, np.uint8) for k in range(4)]
            >>> len(VocabularyTree.train(images, branching=2, depth=2).weights)
            4
        """
        from odomap.vision.kmajority import grow  # compiled for training alone

        _check_sizes(branching, depth)
        parts = descriptors[:, None] if isinstance(descriptors, np.ndarray) else descriptors
        parts = [_checked(part) for part in parts if len(part)]
        if len(parts) < 2:
            raise InputError(
                f"vocabulary: {len(parts)} images with features to train on, two are needed at "
                "least, and hundreds for one of use"
            )
        together = np.concatenate(parts)
        centres, children = grow(as_words(together), branching, depth, seed, progress)
        if len(children) < 2:
            raise InputError("vocabulary: all features of the images are the same: nothing to tell")
        bare = np.zeros(int((children == 0).sum()))
        blank = cls(centres.view(np.uint8), children, bare, branching, depth, len(parts))
        image_of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        pairs = np.unique(blank.words_of(together) * len(parts) + image_of)
        found = np.bincount(pairs // len(parts), minlength=len(bare))
        weights = np.log(len(parts) / found)  # each word was found in an image: it has members
        return cls(blank.centres, children, weights, branching, depth, len(parts))

    @property
    def num_words(self) -> int:
        """How many words there are."""
        return int((self.num_children == 0).sum())

    @cached_property
    def fingerprint(self) -> str:
        """What tells this vocabulary from others; words of two are not to be compared."""
        digest = hashlib.sha256(self.centres.tobytes())
        digest.update(self.num_children.astype("<i8").tobytes())
        digest.update(self.weights.astype("<f4").tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def first_child(self) -> Index:
        """(M,) the node where the children of each node begin."""
        return 1 + np.cumsum(self.num_children) - self.num_children

    @cached_property
    def word_of_node(self) -> Index:
        """(M,) the word that a leaf is, -1 for other nodes."""
        leaves = self.num_children == 0
        return np.where(leaves, np.cumsum(leaves) - 1, -1)

    @cached_property
    def _levels(self) -> list[int]:
        """Where each level begins, and the end."""
        ends = 1 + np.cumsum(self.num_children)
        bounds = [0, 1]
        while bounds[-1] < len(ends):
            bounds.append(int(ends[bounds[-1] - 1]))
        return bounds

    def words_of(self, descriptors: Descriptors) -> Index:
        """Return the (N,) word of each of (N, 32) descriptors."""
        return self.word_of_node[self._descend(descriptors, 0)[0]]

    def transform(self, descriptors: Descriptors, level: int = DIRECT_LEVEL) -> BagOfWords:
        """Return the words of an image.

        Args:
            descriptors: (N, 32) uint8 of its features.
            level: of the direct index; 0 is the root, which all pass.

        Raises:
            InputError: descriptors are of another length.
        """
        leaves, nodes = self._descend(descriptors, level)
        words, counts = np.unique(self.word_of_node[leaves], return_counts=True)
        weights = counts * self.weights[words]
        counted = weights > 0
        words, weights = words[counted], weights[counted]
        return BagOfWords(words, weights / max(float(weights.sum()), 1e-300), nodes)

    def cut(self, depth: int) -> Self:
        """Return the tree without the levels below one.

        Which images had a word of the new leaves is no longer known. As if the words below one
        occurred independently, it is in N_w = N (1 − Π (1 − N_i / N)) of them.

        Args:
            depth: levels kept.
        """
        if depth >= len(self._levels) - 2:
            return self
        _check_sizes(self.branching, depth)
        # log of the share of images without any word of a node, from the leaves up
        with np.errstate(divide="ignore"):
            without = np.log1p(-np.exp(-self.weights))
        missing = np.zeros(len(self.num_children))
        missing[self.num_children == 0] = without
        bounds = self._levels
        for level in range(len(bounds) - 3, depth - 1, -1):
            begin, end, last = bounds[level : level + 3]
            inner = begin + np.flatnonzero(self.num_children[begin:end])
            missing[inner] = np.add.reduceat(missing[:last], self.first_child[inner])
        kept = self._levels[depth + 1]
        children = self.num_children[:kept].copy()
        children[self._levels[depth] :] = 0
        weights = -np.log(-np.expm1(missing[:kept][children == 0]))
        return type(self)(
            self.centres[:kept].copy(),
            children,
            np.maximum(weights, 0.0),
            self.branching,
            depth,
            self.num_images,
        )

    def _descend(self, descriptors: Descriptors, level: int) -> tuple[Index, Index]:
        words = as_words(_checked(descriptors))
        leaves, nodes = np.empty(len(words), np.int64), np.empty(len(words), np.int64)
        tree = as_words(self.centres), self.num_children, self.first_child
        _descend_kernel(words, *tree, level, leaves, nodes)
        return leaves, nodes


def _checked(descriptors: ArrayLike) -> Descriptors:
    """Return descriptors as they are, or say that they are of another kind."""
    array = np.asarray(descriptors)
    if array.dtype != np.uint8 or array.ndim != 2 or array.shape[1] != 32:
        raise InputError(
            f"vocabulary: descriptors are {array.dtype} {array.shape}: its words are of 256 bits, "
            "(N, 32) uint8"
        )
    return array


def _check_sizes(branching: int, depth: int) -> None:
    if not LEAST_BRANCHING <= branching <= MOST_BRANCHING:
        raise InputError(
            f"vocabulary: branching {branching} must be {LEAST_BRANCHING} to {MOST_BRANCHING}"
        )
    if not 1 <= depth <= MOST_DEPTH:
        raise InputError(f"vocabulary: depth {depth} must be 1 to {MOST_DEPTH}")


@kernel
def _descend_kernel(
    words: NDArray[np.uint64],
    centres: NDArray[np.uint64],
    num_children: Index,
    first_child: Index,
    level: int,
    leaves: Index,
    nodes: Index,
) -> None:
    """From the root to the child with the least Hamming distance, until there is none."""
    for i in range(len(words)):
        node, at = 0, 0
        nodes[i] = 0
        while num_children[node] > 0:
            best, nearest = NO_DISTANCE, 0
            for child in range(first_child[node], first_child[node] + num_children[node]):
                d = hamming(words, i, centres, child)
                if d < best:
                    best, nearest = d, child
            node = nearest
            at += 1
            if at <= level:
                nodes[i] = node
        leaves[i] = node


def warm_up() -> None:
    """Compile the kernels of this module."""
    pair = np.array([[0], [255]], np.uint8).repeat(32, axis=1)
    centres = np.concatenate([pair[:1], pair])
    VocabularyTree(centres, np.array([2, 0, 0]), np.ones(2), 2, 1).transform(pair)
