"""A stage that hangs must not cost the night: a time limit for each stage.

When the time is over the stage is asked to stop at its next checkpoint. One that never comes to a checkpoint is ended
with its process, after every thread's stack went to stderr. That second part is a thread of C inside `faulthandler`:
it needs neither Python's lock nor the wall clock, so that a library that never returns can't hold it up.

While the user paused the run the stage waits at a checkpoint, and its time does not go on.
"""

from __future__ import annotations

import faulthandler
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from pipeline.errors import Cancelled, TimeLimitError
from workflows.run.steering import Steering


def grace(seconds: float) -> float:
    """Seconds between the request to stop and the end of the process."""
    return min(60.0, max(2.0, seconds / 4))


class _Limit:
    """The clock of one stage. It runs from `go` to `halt`, and again; `late` is set when it ran for `seconds`."""

    def __init__(self, seconds: float, late: threading.Event) -> None:
        self.left, self.grace, self.late = seconds, grace(seconds), late
        self._timer: threading.Timer | None = None
        self._since = 0.0

    def go(self) -> None:
        """Let it run."""
        self._since = time.monotonic()
        self._timer = threading.Timer(self.left, self.late.set)
        self._timer.daemon = True
        self._timer.start()
        last = self.left + self.grace
        faulthandler.dump_traceback_later(last, exit=True, file=sys.__stderr__ or sys.stderr)

    def halt(self) -> None:
        """Let it stand still."""
        faulthandler.cancel_dump_traceback_later()
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()
            self._timer = None
            self.left = max(self.left - (time.monotonic() - self._since), 0.0)

    def pause(self, waits: bool) -> None:
        """The stage waits, or goes on."""
        if waits:
            self.halt()
        else:
            self.go()


@contextmanager
def time_limit(
    stage: str, seconds: float | None, late: threading.Event, steering: Steering | None = None
) -> Iterator[None]:
    """Set `late` after `seconds` (none: no limit); end the process some time after that. steering: tells of pauses,
    which do not count.

    Raises:
        TimeLimitError: the stage stopped at a checkpoint because its time was over.
    """
    if seconds is None:
        yield
        return
    limit = _Limit(seconds, late)
    limit.go()
    try:
        with steering.telling(limit.pause) if steering is not None else nullcontext():
            yield
    except Cancelled as e:
        if not late.is_set():
            raise
        raise TimeLimitError(
            "the stage took longer than it may",
            where=stage,
            value=f"not done after {seconds:g} s",
            limit=f"{seconds:g} s for one stage",
            remedy="raise --stage-limit; the stage resumes from its last checkpoint",
        ) from e
    finally:
        limit.halt()
        late.clear()
