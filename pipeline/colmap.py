"""pycolmap, less its handler of signals.

Its import installs a handler for SIGTERM that prints a stack of C++ functions and kills the process, in place of the
handler that stops a run in order. `from pipeline.colmap import pycolmap` puts the handlers back that were there.
"""

from __future__ import annotations

import ctypes
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_SIZE = 1024  # bytes, more than any platform's struct sigaction


@contextmanager
def kept_handlers() -> Iterator[None]:
    """Restore, as the C library knows them, the handlers of the signals that stop a run."""
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
