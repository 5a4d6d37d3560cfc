"""Memory of the fuzz tests, and a note of their answers for benchmarks/fuzz_counts.py.

Time and number of their cases are in tests/support/fuzzing.py.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator

import pytest

from tests.support.fuzzing import ANSWERS, READ, REFUSED

MEGABYTES = 512  # by which a module's tests may raise the process's peak


@pytest.fixture(autouse=True, scope="module")
def memory(request: pytest.FixtureRequest) -> Iterator[None]:
    """No case makes room for what a file merely claims. A module may name its own MEGABYTES."""
    most = getattr(request.module, "MEGABYTES", MEGABYTES)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < most * 1024


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """The answers of each test, as properties of its entry in a JUnit file (`--junitxml`)."""
    ANSWERS.clear()
    try:
        yield
    finally:
        item.user_properties += [(kind, ANSWERS[kind]) for kind in (READ, REFUSED)]
