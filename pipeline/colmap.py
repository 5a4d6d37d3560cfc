"""pycolmap without its signal handlers.

Importing pycolmap replaces the handler for SIGTERM, which stops a run in order, by one that prints a C++ stack and
kills the process. `from pipeline.colmap import pycolmap` restores the previous handlers.
"""

from __future__ import annotations

import ctypes
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_SIZE = 1024  # bytes, more than any platform's struct sigaction


@contextmanager
def kept_handlers() -> Iterator[None]:
    """Restore the C library's handlers of the signals that stop a run."""
    libc = ctypes.CDLL(None)
    before = {n: ctypes.create_string_buffer(_SIZE) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    for number, action in before.items():
        libc.sigaction(int(number), None, action)
    try:
        yield
    finally:
        for number, action in before.items():
            libc.sigaction(int(number), action, None)


with kept_handlers():
    import pycolmap

__all__ = ["pycolmap"]
