"""On what, and when, something was measured."""

from __future__ import annotations

import datetime
import multiprocessing
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from workflows.run.interrupt import end_with

T = TypeVar("T")


def machine() -> dict[str, Any]:
    """Processor, cores, memory, versions and the day: what a figure means nothing without."""
    import torch

    return {
        "processor": _line(Path("/proc/cpuinfo"), "model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "memory_gb": round(kilobytes("MemTotal") / 1e6, 1),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "load_at_start": round(os.getloadavg()[0], 2),
        "date": datetime.date.today().isoformat(),
    }


def describe(m: dict[str, Any]) -> str:
    """The same in a sentence."""
    busy = f", load average {m['load_at_start']} at the start" if m["load_at_start"] > 0.5 else ""
    gpu = f", {m['gpu']}" if m["gpu"] else ", no GPU"
    return f"{m['cores']} cores of {m['processor']}, {m['memory_gb']} GB{gpu}, torch {m['torch']}, {m['date']}{busy}"


def apart(work: Callable[..., T], *arguments: Any) -> T:
    """What a function of a module returns, called in a process of its own: its peak memory is then its own."""
    with ProcessPoolExecutor(
        1, mp_context=multiprocessing.get_context("spawn"), initializer=end_with, initargs=(os.getpid(),)
    ) as pool:
        return pool.submit(work, *arguments).result()


def _line(path: Path, name: str) -> str:
    try:
        found = (x for x in path.read_text().splitlines() if x.startswith(name))
        return next(found, ":").partition(":")[2].strip()
    except OSError:
        return ""


def kilobytes(name: str) -> float:
    """Of memory, by its name in /proc/meminfo; 0 where the system does not tell."""
    text = _line(Path("/proc/meminfo"), name).split()
    return float(text[0]) if text else 0.0


def seconds_each(work: Callable[[], object], least: float = 1.0, rounds: int = 3) -> float:
    """Least seconds of a call over at least `rounds` calls and `least` seconds, after one call that warms up: whatever
    else the machine does can only add to it."""
    work()
    taken: list[float] = []
    while len(taken) < rounds or sum(taken) < least:
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return min(taken)


def growth(x: list[float], y: list[float]) -> tuple[float, float]:
    """(a, b) of y = a x^b, by least squares of the logarithms; NaN where fewer than two points are positive."""
    return power_law(x, y)[:2]


def power_law(x: list[float], y: list[float]) -> tuple[float, float, float]:
    """(a, b, s) of y = a x^b, and s the standard error of b from the residuals; s is NaN with two points or fewer."""
    points = [(u, v) for u, v in zip(x, y, strict=True) if u > 0 and v > 0]
    if len({u for u, _ in points}) < 2:
        return float("nan"), float("nan"), float("nan")
    u, v = np.log(np.array(points)).T
    b, a = np.polyfit(u, v, 1)
    free, rest = len(points) - 2, v - a - b * u
    error = np.sqrt((rest**2).sum() / free / ((u - u.mean()) ** 2).sum()) if free else np.nan
    return float(np.exp(a)), float(b), float(error)
