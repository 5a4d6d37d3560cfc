"""Freed memory goes back to the system between stages."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

from pipeline import memory
from pipeline.memory import give_back

HOLES = """
import numpy as np
from pathlib import Path
from pipeline.memory import give_back
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096
arrays = [np.ones(8000) for _ in range(4000)]   # 64 kB each, 256 MB: too small to be mapped alone
kept = arrays[-1]  # the top of the heap is in use, so that nothing is returned by itself
before = resident()
del arrays
between = resident()
give_back()
print(before, between, resident(), kept.sum())
"""
GLIBC = hasattr(ctypes.CDLL(None), "malloc_trim") if sys.platform == "linux" else False


@pytest.mark.skipif(not GLIBC, reason="only glibc has malloc_trim")
def test_freed_pages_are_returned() -> None:
    told = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True).stdout.split()
    before, between, after, kept = (float(t) for t in told)
    assert kept == 8000
    assert between > before - 50e6, "the C library gave them back on its own: the test shows nothing"
    assert after < before - 200e6


def test_another_c_library_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda _: object())
    give_back()
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda _: (_ for _ in ()).throw(OSError("none")))
    give_back()
