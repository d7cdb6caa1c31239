"""Maximum clique against brute force."""

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from docking.pose.clique import adjacency, bits, largest_clique, rival_clique


def random_graph(seed: int, n: int, density: float) -> np.ndarray:
    upper = np.triu(np.random.default_rng(seed).random((n, n)) < density, 1)
    return upper | upper.T


def is_clique(graph: np.ndarray, rows: list[int]) -> bool:
    return all(graph[i, j] for i, j in combinations(rows, 2))


def brute_force(graph: np.ndarray) -> int:
    n = len(graph)
    return max(k for k in range(1, n + 1) if any(is_clique(graph, list(c)) for c in combinations(range(n), k)))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 9), st.floats(0.2, 0.95))
def test_size_equals_brute_force(seed: int, n: int, density: float) -> None:
    graph = random_graph(seed, n, density)
    found = bits(largest_clique(adjacency(graph)))
    assert is_clique(graph, found)
    assert len(found) == brute_force(graph)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(4, 9), st.floats(0.3, 0.9))
def test_rivals_share_at_most_two(seed: int, n: int, density: float) -> None:
    graph = random_graph(seed, n, density)
    adj = adjacency(graph)
    best = largest_clique(adj)
    k = best.bit_count()
    rival = rival_clique(adj, best, k)
    exist = any(
        is_clique(graph, list(c)) and sum(best >> i & 1 for i in c) <= 2 for c in combinations(range(n), k)
    )  # fmt: skip
    assert bool(rival) == exist
    if rival:
        assert is_clique(graph, bits(rival))
        assert (rival & best).bit_count() <= 2
        assert rival.bit_count() >= k


def test_planted_clique_in_a_large_graph() -> None:
    graph = random_graph(3, 198, 0.3)
    rows = np.arange(0, 198, 4)
    graph[np.ix_(rows, rows)] = True
    np.fill_diagonal(graph, False)
    assert set(rows) <= set(bits(largest_clique(adjacency(graph))))


def test_bits_of_wide_masks() -> None:
    assert bits((1 << 300) | 5) == [0, 2, 300]
    assert largest_clique(adjacency(np.zeros((3, 3), dtype=bool))).bit_count() == 1
