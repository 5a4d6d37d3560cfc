"""Work side by side: the results of a loop, in its order, and its errors."""

from __future__ import annotations

import threading

import pytest

from pipeline.threads import side_by_side


@pytest.mark.parametrize("threads", ["1", "2", "5"])
def test_results_come_in_order_and_few_wait(monkeypatch: pytest.MonkeyPatch, threads: str) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    begun: list[int] = []
    gate, seen = threading.Lock(), 0

    def square(x: int) -> int:
        with gate:
            begun.append(x)
        return x * x

    for seen, found in enumerate(side_by_side(square, range(50))):
        assert found == seen * seen
        assert len(begun) <= seen + int(threads) + 2
    assert seen == 49 and sorted(begun) == list(range(50))
    assert list(side_by_side(square, [])) == []


@pytest.mark.parametrize("threads", ["1", "3"])
def test_an_error_comes_out_where_its_item_would(monkeypatch: pytest.MonkeyPatch, threads: str) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)

    def work(x: int) -> int:
        if x == 4:
            raise ValueError("four")
        return x

    found = side_by_side(work, range(9))
    assert [next(found) for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="four"):
        next(found)
