"""A vocabulary of binary features and the bags of words of the map's key-frames: which key-frames look like an image.

The tree is trained on the map's own descriptors by k-majority (k-means of bits: a centre is the majority of every bit).
Distances of bits are inner products: with bits written as +-1, Hamming distance = (256 - a.b) / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.guidance.types import Bytes

BRANCHES = 12
DEPTH = 3
_ROUNDS = 6
_MOST_TRAINED = 40000
_SEED = 3

Signs = NDArray[np.float32]
Words = NDArray[np.intp]


def _signs(descriptors: Bytes) -> Signs:
    """Bits (n, 32 bytes) as +-1 (n, 256)."""
    bits = np.unpackbits(descriptors, axis=1)
    signs: Signs = bits.astype(np.float32) * np.float32(2.0) - np.float32(1.0)
    return signs


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """`levels[k]` (BRANCHES**(k+1), 256): centres of level k; the children of node i are rows i*BRANCHES.. of the next.

    A word is a node of the last level: BRANCHES**DEPTH words.
    """

    levels: tuple[Signs, ...]

    @property
    def size(self) -> int:
        """Number of words."""
        return len(self.levels[-1])

    def words(self, descriptors: Bytes) -> Words:
        """The word (n,) of every descriptor (n, 32): down the tree, at each level to the nearest child."""
        signs = _signs(descriptors)
        nodes = np.zeros(len(signs), dtype=np.intp)
        for centres in self.levels:
            nodes = _descend(signs, nodes, centres)
        return nodes


def _descend(signs: Signs, nodes: Words, centres: Signs) -> Words:
    """The nearest child of every row's node."""
    children = np.empty_like(nodes)
    order = np.argsort(nodes, kind="stable")
    starts = np.flatnonzero(np.diff(nodes[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        if len(rows):
            first = int(nodes[rows[0]]) * BRANCHES
            children[rows] = first + np.argmax(signs[rows] @ centres[first : first + BRANCHES].T, axis=1)
    return children


def train(descriptors: Bytes) -> Vocabulary:
    """The vocabulary of descriptors (n, 32); the same descriptors give the same tree."""
    rng = np.random.default_rng(_SEED)
    if len(descriptors) > _MOST_TRAINED:
        descriptors = descriptors[rng.choice(len(descriptors), _MOST_TRAINED, replace=False)]
    signs = _signs(descriptors)
    nodes = np.zeros(len(signs), dtype=np.intp)
    levels: list[Signs] = []
    for level in range(DEPTH):
        parts = [_k_majority(signs[nodes == node], rng) for node in range(BRANCHES**level)]
        levels.append(np.concatenate(parts))
        nodes = _descend(signs, nodes, levels[-1])
    return Vocabulary(tuple(levels))


def _k_majority(signs: Signs, rng: np.random.Generator) -> Signs:
    """BRANCHES centres (BRANCHES, 256) of rows; where there are fewer rows than that, centres repeat."""
    if len(signs) == 0:
        return np.ones((BRANCHES, 256), dtype=np.float32)
    centres = signs[rng.choice(len(signs), BRANCHES, replace=len(signs) < BRANCHES)]
    for _ in range(_ROUNDS):
        nearest = np.argmax(signs @ centres.T, axis=1)
        members = (nearest == np.arange(BRANCHES)[:, None]).astype(np.float32)
        sums = members @ signs
        centres = np.where(sums != 0.0, np.sign(sums), centres).astype(np.float32)
    return centres


@dataclass(frozen=True, eq=False)
class Bags:
    """The bags of words of key-frames: `weights` (k, words), each row tf-idf of L1 norm 1, and the `idf` (words,)."""

    vocabulary: Vocabulary
    idf: NDArray[np.float32]
    weights: NDArray[np.float32]

    def alike(self, descriptors: Bytes, count: int) -> list[int]:
        """Rows of the `count` key-frames most like an image, best first; those that share no word are left out.

        The score is 1 - |a - b|_1 / 2 = sum min(a, b) of the two bags.
        """
        bag = self._bag(self.vocabulary.words(descriptors))
        used = np.flatnonzero(bag)
        score = np.minimum(self.weights[:, used], bag[used]).sum(axis=1)
        best = np.argsort(-score, kind="stable")[:count]
        return [int(row) for row in best if score[row] > 0.0]

    def _bag(self, words: Words) -> NDArray[np.float32]:
        return _normed(np.bincount(words, minlength=self.vocabulary.size), self.idf)

    def with_frame(self, descriptors: Bytes) -> Bags:
        """The same bags and one more."""
        bag = self._bag(self.vocabulary.words(descriptors))
        return Bags(self.vocabulary, self.idf, np.vstack([self.weights, bag]))


def bags_of(vocabulary: Vocabulary, frames: list[Bytes]) -> Bags:
    """The bags of key-frames given by their descriptors."""
    counts = np.array([np.bincount(vocabulary.words(f), minlength=vocabulary.size) for f in frames])
    idf = np.log((1.0 + len(frames)) / (1.0 + np.count_nonzero(counts, axis=0))).astype(np.float32)
    return Bags(vocabulary, idf, np.array([_normed(row, idf) for row in counts]))


def _normed(counts: NDArray[np.intp], idf: NDArray[np.float32]) -> NDArray[np.float32]:
    weighted = counts.astype(np.float32) * idf
    total = float(weighted.sum())
    result: NDArray[np.float32] = weighted / np.float32(total) if total > 0.0 else weighted
    return result
