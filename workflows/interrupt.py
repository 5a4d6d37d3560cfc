"""Ctrl-C: the first one asks the stage to stop at its next checkpoint, the second ends the program at once.

Python's own handler runs only when the main thread comes back to Python, which a library may take minutes to do. So
the handler does nothing, and a thread reads the byte that the interpreter writes for each signal as it arrives.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPED = 130


@contextmanager
def interruptible(stop: threading.Event, at_once: Callable[[], None], said: Callable[[str], None]) -> Iterator[None]:
    """Set `stop` at the first SIGINT; at the second call `at_once` and exit with 130. Call from the main thread."""
    ours, interpreters = socket.socketpair()
    interpreters.setblocking(False)

    def wait() -> None:
        while byte := ours.recv(1):
            if byte[0] != signal.SIGINT:
                continue
            if stop.is_set():
                at_once()
                sys.stderr.flush()
                os._exit(STOPPED)
            stop.set()
            said("\nstopping at the next checkpoint; press Ctrl-C again to stop at once")

    handler = signal.signal(signal.SIGINT, lambda number, frame: None)
    descriptor = signal.set_wakeup_fd(interpreters.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=wait, name="ctrl-c", daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(descriptor)
        signal.signal(signal.SIGINT, handler)
        interpreters.close()  # the thread reads the end and goes
        thread.join()
        ours.close()


@contextmanager
def deaf_children() -> Iterator[None]:
    """Processes started in here never get SIGINT: a terminal sends it to all that run in it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
