"""Memory of the fuzz tests; time and number of their cases are in tests/support/fuzzing.py."""

from __future__ import annotations

import resource
from collections.abc import Iterator

import pytest

MEGABYTES = 512  # by which a test may raise the process's peak


@pytest.fixture(autouse=True, scope="module")
def memory() -> Iterator[None]:
    """No case makes room for what a file merely claims."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEGABYTES * 1024
