"""The least cut against every other cut of small graphs."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.least_cut import ENDLESS, least_cut

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]


def costs(a: I64, b: I64, cost: I32, pull: I32, first: npt.NDArray[np.bool_]) -> int:
    """What a division costs, by the definition."""
    against = np.where(first, np.minimum(pull, 0), np.maximum(pull, 0))
    return int(cost[first[a] != first[b]].sum()) + int(np.abs(against).sum())


@pytest.mark.parametrize("seed", range(8))
def test_no_division_costs_less(seed: int) -> None:
    random = np.random.default_rng(seed)
    pairs = np.array(list(itertools.combinations(range(9), 2)))
    a, b = pairs[random.random(len(pairs)) < 0.4].T.astype(np.int64)
    cost, pull = (random.integers(low, 50, n).astype(np.int32) for low, n in ((0, len(a)), (-50, 9)))
    found = costs(a, b, cost, pull, least_cut(a, b, cost, pull))
    every = (np.array(s) for s in itertools.product([False, True], repeat=9))
    assert found == min(costs(a, b, cost, pull, s) for s in every)


def test_an_endless_pull_is_followed() -> None:
    chain = np.arange(4)
    pull = np.array([ENDLESS, 0, 0, 0, -ENDLESS], np.int32)
    cost = np.array([7, 7, 1, 7], np.int32)
    assert least_cut(chain, chain + 1, cost, pull).tolist() == [True, True, True, False, False]


@pytest.mark.parametrize("pull", [0, -3, 3])
def test_nodes_without_edges(pull: int) -> None:
    none = np.zeros(0, np.int64)
    assert least_cut(none, none, none.astype(np.int32), np.full(2, pull, np.int32)).tolist() == [pull > 0] * 2
