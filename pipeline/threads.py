"""Settings of the thread pools, and of torch's temporary files. Import this before torch, numba or scikit-image.

libgomp reads its environment once, when it is loaded. By default idle threads spin: if another process uses the same
cores, a step of the fit takes forty times as long. Passive threads sleep instead, and are as fast on a free machine.
Settings of the user are kept.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Sums in the same order in every run: else the matrix library may choose its number of threads and its code path by the
# load of the machine and the alignment of arrays.
os.environ.setdefault("MKL_DYNAMIC", "FALSE")
os.environ.setdefault("MKL_CBWR", "AUTO")

# torch makes a folder torchinductor_USER in TMPDIR when an optimiser is made, for a compiler that is not used here, and
# leaves it there. This names one that exists, so that none is made.
os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", os.environ.get("TMPDIR") or "/tmp")

# What sets the number of threads of PyTorch (OpenMP), of compiled loops, and of the matrix library.
NAMES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")


def of_compiled_loops() -> int:
    """The number of threads that compiled loops use."""
    return int(in_use()[NAMES.index("NUMBA_NUM_THREADS")])


def in_use() -> list[str]:
    """The number of threads that each of NAMES asks for: its text, or this process's number of cores where it is unset.

    Sums in several threads are added in another order than in one, so that their last digits differ.
    """
    cores = str(len(os.sched_getaffinity(0)))
    return [os.environ.get(name) or cores for name in NAMES]


def side_by_side(work: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
    """work(item) of each item, in their order, made in as many threads as compiled loops have. No more results wait
    than there are threads. For work that leaves Python's lock: decoding, array operations, rays, triangular solves; not
    for compiled loops that are parallel themselves."""
    from collections import deque
    from concurrent.futures import Future, ThreadPoolExecutor

    threads = of_compiled_loops()
    if threads < 2:
        yield from map(work, items)
        return
    pool, waiting = ThreadPoolExecutor(threads), deque[Future[B]]()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
