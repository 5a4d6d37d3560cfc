"""What a failure is, when it is tried again, and how."""

from __future__ import annotations

import pytest

from pipeline.errors import Cancelled, DiskError, MemoryLimitError, StageError, TimeLimitError, UsageError
from workflows.batch.failures import failure_in, failure_of, smaller
from workflows.cli.options import seconds


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (StageError("x", where=1, value=1, limit=1, remedy="x"), "capture"),
        (UsageError("x", where=1, value=1, limit=1, remedy="x"), "capture"),
        (DiskError("x", where=1, value=1, limit=1, remedy="x"), "disk"),
        (MemoryLimitError("x", where=1, value=1, limit=1, remedy="x"), "memory"),
        (TimeLimitError("x", where=1, value=1, limit=1, remedy="x"), "limit"),
        (Cancelled("x"), "stopped"),
        (MemoryError("x"), "memory"),
        (RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), "memory"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate"), "memory"),
        (ZeroDivisionError("x"), "bug"),
    ],
)
def test_kinds_of_faults(error: Exception, kind: str) -> None:
    assert failure_of(error).kind == kind
    in_state = failure_in(f"Flow run encountered an exception: {type(error).__name__}: {error}")
    assert in_state.kind == kind  # as Prefect words it
    assert in_state.passes == (kind in ("memory", "lost"))


@pytest.mark.parametrize("name", ["ConnectError", "ReadTimeout", "RemoteProtocolError", "PrefectHTTPStatusError"])
def test_a_server_that_was_away_may_be_back(name: str) -> None:
    assert failure_in(f"Flow run encountered an exception: {name}: all connection attempts failed").kind == "lost"


def test_half_the_rays_until_it_makes_no_sense() -> None:
    assert smaller(4096) == "inverse_rendering.batch=2048"
    assert smaller(512) == "inverse_rendering.batch=256"
    assert smaller(511) is None


@pytest.mark.parametrize(("text", "value"), [("90", 90), ("90s", 90), ("1.5h", 5400), ("7d", 604800), ("2m", 120)])
def test_times(text: str, value: float) -> None:
    assert seconds(text) == value


@pytest.mark.parametrize("text", ["", "0", "-1", "1w", "h", "1e3", "nan", "inf"])
def test_times_that_are_none(text: str) -> None:
    with pytest.raises(ValueError):
        seconds(text)
