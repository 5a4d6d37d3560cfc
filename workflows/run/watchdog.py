"""A stage that hangs must not cost the night: a time limit for each stage.

When the time is over the stage is asked to stop at its next checkpoint. One that never comes to a checkpoint is ended
with its process, after every thread's stack went to stderr. That second part is a thread of C inside `faulthandler`:
it needs neither Python's lock nor the wall clock, so that a library that never returns can't hold it up.
"""

from __future__ import annotations

import faulthandler
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from pipeline.errors import Cancelled, TimeLimitError


def grace(seconds: float) -> float:
    """Seconds between the request to stop and the end of the process."""
    return min(60.0, max(2.0, seconds / 4))


@contextmanager
def time_limit(stage: str, seconds: float | None, late: threading.Event) -> Iterator[None]:
    """Set `late` after `seconds` (none: no limit); end the process some time after that.

    Raises:
        TimeLimitError: the stage stopped at a checkpoint because its time was over.
    """
    if seconds is None:
        yield
        return
    timer = threading.Timer(seconds, late.set)
    timer.daemon = True
    timer.start()
    faulthandler.dump_traceback_later(seconds + grace(seconds), exit=True, file=sys.__stderr__ or sys.stderr)
    try:
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
        faulthandler.cancel_dump_traceback_later()
        timer.cancel()
        timer.join()
        late.clear()
