"""Largest set of mutually consistent points: maximum clique by branch and bound on bit masks.

A graph of n points is a list of n integers: bit j of `adj[i]` is set when the pair (i, j) is consistent. The search is
Bron-Kerbosch's recursion cut by greedy colouring: points of one colour exclude each other, so candidates that need c
colours hold no clique larger than c.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

_NODES = 3000
"""Search nodes after which the largest set found so far is taken; it bounds the time, not the usual result."""
_STARTS = 20
_DEEPEST = 500
"""Largest graph that is searched by recursion; a larger one is left to the greedy pass."""


def bits(mask: int) -> list[int]:
    """Positions of the set bits, ascending."""
    found = []
    while mask:
        low = mask & -mask
        found.append(low.bit_length() - 1)
        mask ^= low
    return found


def adjacency(consistent: NDArray[np.bool_]) -> list[int]:
    """Bit masks of a symmetric (n, n) matrix, the diagonal ignored."""
    rows = np.packbits(consistent, axis=1, bitorder="little")
    return [int.from_bytes(row.tobytes(), "little") & ~(1 << i) for i, row in enumerate(rows)]


def _coloured(adj: list[int], candidates: int) -> list[tuple[int, int]]:
    """(vertex, colours used up to it); the vertices of one colour are mutually inconsistent."""
    order: list[tuple[int, int]] = []
    colour = 0
    while candidates:
        colour += 1
        free = candidates
        while free:
            low = free & -free
            v = low.bit_length() - 1
            order.append((v, colour))
            candidates ^= low
            free &= ~(adj[v] | low)
    return order


class _Search:
    """One branch and bound: the best clique so far, its size, and the nodes left."""

    def __init__(self, adj: list[int], best: int, size: int) -> None:
        self.adj, self.best, self.size, self.nodes = adj, best, size, _NODES

    def expand(self, clique: int, size: int, candidates: int) -> None:
        self.nodes -= 1
        if not candidates:
            if size > self.size:
                self.best, self.size = clique, size
            return
        for v, colours in reversed(_coloured(self.adj, candidates)):
            if size + colours <= self.size or self.nodes <= 0:
                return
            self.expand(clique | 1 << v, size + 1, candidates & self.adj[v])
            candidates &= ~(1 << v)


def _greedy(adj: list[int], allowed: int) -> int:
    """A large clique: from each of the best-connected points, always the candidate that leaves most candidates."""
    best = 0
    starts = sorted(bits(allowed), key=lambda i: -(adj[i] & allowed).bit_count())[:_STARTS]
    for start in starts:
        clique, candidates = 1 << start, adj[start] & allowed
        while candidates:
            v = max(bits(candidates), key=lambda i: (adj[i] & candidates).bit_count())
            clique, candidates = clique | 1 << v, candidates & adj[v]
        if clique.bit_count() > best.bit_count():
            best = clique
    return best


def largest_clique(adj: list[int], allowed: int | None = None, at_least: int = 0) -> int:
    """Mask of a largest clique among the `allowed` vertices (all by default); 0 when none has `at_least` vertices."""
    pool = (1 << len(adj)) - 1 if allowed is None else allowed
    universal = 0
    for v in bits(pool):
        if not pool & ~(adj[v] | 1 << v):
            universal |= 1 << v
    rest = pool & ~universal
    if not rest:
        return universal if universal.bit_count() >= at_least else 0
    start = _greedy(adj, rest)
    search = _Search(adj, start, start.bit_count())
    if rest.bit_count() <= _DEEPEST:
        search.expand(0, 0, rest)
    found = universal | search.best
    return found if found.bit_count() >= at_least else 0


def maximal_cliques(adj: list[int], at_least: int, most: int) -> list[int]:
    """Masks of the cliques of `at_least` vertices or more that no vertex can join; `most` of them at the most.

    Bron-Kerbosch with a pivot: only vertices that the pivot does not see are branched on.
    """
    found: list[int] = []
    nodes = _NODES

    def expand(clique: int, candidates: int, done: int) -> None:
        nonlocal nodes
        nodes -= 1
        if not candidates and not done:
            found.append(clique)
            return
        pivot = max(bits(candidates | done), key=lambda i: (adj[i] & candidates).bit_count())
        for v in bits(candidates & ~adj[pivot]):
            inside = candidates & adj[v]
            if clique.bit_count() + 1 + inside.bit_count() >= at_least and len(found) < most and nodes > 0:
                expand(clique | 1 << v, inside, done & adj[v])
            candidates &= ~(1 << v)
            done |= 1 << v

    expand(0, (1 << len(adj)) - 1, 0)
    return found


def rival_clique(adj: list[int], chosen: int, size: int) -> int:
    """Mask of a clique of at least `size` that shares at most two points with `chosen`; 0 when there is none.

    Two sets that share three points describe the same pose; two that share at most two are rival explanations.
    """
    outside = ((1 << len(adj)) - 1) & ~chosen
    if outside.bit_count() + 2 < size:
        return 0
    shared = [(), *((i,) for i in bits(chosen)), *combinations(bits(chosen), 2)]
    for common in shared:
        mask, candidates = 0, outside
        for i in common:
            mask, candidates = mask | 1 << i, candidates & adj[i]
        connected = len(common) < 2 or bool(adj[common[0]] >> common[1] & 1)
        if connected and candidates.bit_count() + len(common) >= size:
            found = largest_clique(adj, candidates, size - len(common)) if candidates else 0
            if (found | mask).bit_count() >= size:
                return found | mask
    return 0
