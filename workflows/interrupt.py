"""Ctrl-C: the first one asks the stage to stop at its next checkpoint, the second ends the program at once.

SIGINT is blocked in every thread, and in the server that Prefect starts (a terminal sends it to all of them), and one
thread waits for it. So it is answered even while a library works for minutes without coming back to Python.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPED = 130


@contextmanager
def interruptible(stop: threading.Event, at_once: Callable[[], None], said: Callable[[str], None]) -> Iterator[None]:
    """Set `stop` at the first SIGINT; at the second call `at_once` and exit with 130. Call from the main thread."""
    over = threading.Event()

    def wait() -> None:
        while True:
            signal.sigwait({signal.SIGINT})
            if over.is_set():
                return
            if stop.is_set():
                at_once()
                sys.stderr.flush()
                os._exit(STOPPED)
            stop.set()
            said("\nstopping at the next checkpoint; press Ctrl-C again to stop at once")

    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    thread = threading.Thread(target=wait, name="ctrl-c", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        signal.pthread_kill(thread.ident or 0, signal.SIGINT)
        thread.join()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
