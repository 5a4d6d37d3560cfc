"""Limits of every fuzz case, and how many cases there are: NEUFACE_FUZZ=10000 for a long run, 200 by default."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from hypothesis import HealthCheck, settings

from pipeline.errors import StageError

SECONDS = 2.0  # of processor time that one case may take
READ, REFUSED = "read", "refused"  # a reader's answers
ANSWERS: Counter[str] = Counter()  # of the test that runs; tests/fuzz/conftest.py notes and clears them
CASES = int(os.environ.get("NEUFACE_FUZZ", "200"))

settings.register_profile(
    "fuzz", max_examples=CASES, derandomize=True, deadline=None, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example,
                           HealthCheck.filter_too_much],
)  # fmt: skip


@contextmanager
def bounded() -> Iterator[None]:
    """A case that ends in time. StageError (UsageError is one) is an answer; all else is a bug and goes on up."""
    start = time.thread_time()
    try:
        yield
        ANSWERS[READ] += 1
    except StageError as e:
        ANSWERS[REFUSED] += 1
        assert e.what and str(e.where) is not None and str(e.limit) and e.remedy
        assert len(str(e)) < 3000, "a message that nobody reads"
        str(e).encode()
    assert time.thread_time() - start < SECONDS


fuzzed = settings.get_profile("fuzz")
halved = settings(fuzzed, max_examples=max(1, CASES // 2))  # of readers that two tests damage
