from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from missions.lines.cells import cell_corners, chains, followers
from missions.lines.tour import Cells, exact_tour, good_tour, nearest_tour, tour_cost
from tests.oracles_lines import best_tour_by_trial


def problem(cells: int, seed: int) -> tuple[Cells, np.ndarray]:
    """Cells at random places, and the cost of the finish by the corner first entered."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 10, (4 * cells, 2))
    hops = np.linalg.norm(places[:, None] - places, axis=2)
    hops = hops * rng.uniform(0.7, 1.3, hops.shape)
    odd = rng.integers(0, 2, cells)
    ways = np.where(odd[:, None], [3, 2, 1, 0], [2, 3, 0, 1])
    exits = (4 * np.arange(cells)[:, None] + ways).ravel()
    inner = rng.uniform(1, 3, 4 * cells)
    start = np.linalg.norm(places, axis=1)
    finish = rng.uniform(1, 9, (4 * cells, 4 * cells))
    return Cells(hops=hops, exits=exits, inner=inner, start=start, finish=finish[0]), finish


@settings(deadline=None, max_examples=25)
@given(cells=st.integers(1, 3), seed=st.integers(0, 10**6), each=st.booleans())
def test_few_cells_are_toured_at_the_least_cost(cells: int, seed: int, each: bool) -> None:
    some, finish = problem(cells, seed)
    if not each:
        finish = np.repeat(finish[:1], 4 * cells, axis=0)
    cost, order = exact_tour(some, finish, each)
    tried = best_tour_by_trial(some.exits, some.inner, some.hops, some.start, finish)
    assert cost == pytest.approx(tried, rel=1e-12)
    assert sorted(order // 4) == list(range(cells))
    again = tour_cost(order, some._replace(finish=finish[order[0]]))
    assert again == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("fixed", [0, 1])
def test_many_cells_are_toured_well_and_each_once(fixed: int) -> None:
    """Against the exact tour where that is still to be had; never worse than where it began."""
    ratios = []
    for seed in range(20):
        some, finish = problem(7, seed)
        first = nearest_tour(some)
        order = good_tour(first, some, fixed)
        assert sorted(order // 4) == list(range(7))
        if fixed:
            assert order[0] == first[0]
        mine = tour_cost(order, some)
        assert mine <= tour_cost(first, some) + 1e-9
        ratios.append(mine / exact_tour(some, finish[:1], False)[0])
    assert min(ratios) >= 1 - 1e-12
    if not fixed:
        assert np.mean(ratios) < 1.03


def pieces_of(*rows: list[tuple[float, float]]) -> np.ndarray:
    return np.array([(i, a, b, 1.0) for i, row in enumerate(rows) for a, b in row])


@pytest.mark.parametrize(
    ("rows", "cells"),
    [
        ([[(0, 9)]] * 4, [[0, 1, 2, 3]]),
        ([[(0, 9)], [(0, 4), (5, 9)], [(0, 4), (5, 9)], [(0, 9)]], [[0], [1, 3], [2, 4], [5]]),
        ([[(0, 4)], [(5, 9)]], [[0], [1]]),
        ([[(0, 4)], [], [(0, 4)]], [[0], [1]]),
        ([[(0, 2), (3, 5)], [(0, 5)], [(4, 5)]], [[0], [1], [2, 3]]),
    ],
)
def test_cells_are_chains_without_a_choice(
    rows: list[list[tuple[float, float]]], cells: list[list[int]]
) -> None:
    begins, listed = chains(followers(pieces_of(*rows)))
    found = [listed[a:b].tolist() for a, b in pairwise(begins)]
    assert sorted(found) == sorted(cells)


@given(count=st.integers(1, 6))
def test_flying_a_cell_back_enters_where_it_was_left(count: int) -> None:
    ends = np.array([[0.0, i, 5.0, i] for i in range(count)])
    corners, exits = cell_corners(np.array([0, count]), np.arange(count), ends, 0.0)
    for k in range(2 if count == 1 else 4):
        assert exits[0, exits[0, k]] == k
        last = count - 1 if k < 2 else 0
        assert corners[0, exits[0, k], 1] == last
        forward = k % 2 == 0
        ends_far = forward == (count % 2 == 1)
        assert corners[0, exits[0, k], 0] == (5.0 if ends_far else 0.0)
