"""How the tests are spread over processes: as many as the machine has room for, and what they share made once."""

from __future__ import annotations

import fcntl
import os
import pickle
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

T = TypeVar("T")
MOST = 4  # more would wait for each other: a fit uses several threads itself
MEMORY = 2 * 2**30  # bytes that a worker takes at its largest


def workers() -> int:
    """Of `-n auto`: one per core that this process may use, if the memory suffices. 0: all in this process."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    room = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // MEMORY
    count = min(cores, MOST, max(1, room))
    return count if count > 1 else 0


def slow_files_first(items: list[pytest.Item]) -> None:
    """So that no worker is left with a long file when the others have nothing more to do. Each file stays whole."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """What `make` returns for a new folder, for all workers of a run: the first to ask makes it, the others wait.

    Each gets a copy of its own of the result, and the same folder, in which nobody may change anything.
    """
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"shared_{name}"
    folder.mkdir(exist_ok=True)
    result = folder / "result.pickle"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not result.is_file():
            files = folder / "files"
            shutil.rmtree(files, ignore_errors=True)  # of a maker that failed
            files.mkdir()
            content = pickle.dumps(make(files))
            result.write_bytes(content)
    found: T = pickle.loads(result.read_bytes())
    return found
