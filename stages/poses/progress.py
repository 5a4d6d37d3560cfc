"""Progress and cancellation."""

from __future__ import annotations

from collections.abc import Callable

from pipeline.contract import Context


def progress_of(context: Context) -> Callable[[int, int, str], None]:
    """A function (done, total, message) that reports progress, and raises if the run was cancelled."""

    def progress(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    return progress
