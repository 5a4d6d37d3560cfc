"""How the work tells its progress, and learns that it is to stop."""

from __future__ import annotations

from collections.abc import Callable

from pipeline.contract import Context


def progress_of(context: Context) -> Callable[[int, int, str], None]:
    """A function of done, total and message that stops the stage where its context says so."""

    def progress(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    return progress
