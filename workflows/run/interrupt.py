"""Ctrl-C (SIGINT), SIGTERM and SIGHUP, all alike: the first asks the stage to stop at its next checkpoint, the second
ends the program at once. The exit code is 128 plus the signal's number: 130, 143, 129.

Python's own handler runs only when the main thread comes back to Python, which a library may take minutes to do. So
the handler does nothing, and a thread reads the byte that the interpreter writes for each signal as it arrives.

The module imports nothing but the standard library: it is the first that `neuface` loads.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PARENT = "NEUFACE_PARENT"  # the process without which a run's process must not go on
AGAIN = 0.05  # seconds until an exception is raised again that Python dropped
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class Interrupted(KeyboardInterrupt):
    """A signal that ends a command outside of a run. number: the signal's."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def code_of(number: int) -> int:
    """Exit code of a program that a signal ended, as a shell counts it."""
    return 128 + number


@dataclass(slots=True)
class Caught:
    """The signal that stopped a run, if one did."""

    number: int | None = None


_asked = Caught()  # of the command: outside of its runs


@contextmanager
def interruptible(
    stop: threading.Event, notify: Callable[[str], None], at_once: Callable[[], None] = lambda: None
) -> Iterator[Caught]:
    """Set `stop` at the first signal; at the second call `at_once` and exit. A `Cancelled` gets the exit code.

    Outside the main thread Python can set no handlers: then signals do what they did before.
    """
    caught = Caught()
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return
    if _asked.number is not None:  # it came before, and its exception was lost in a library
        raise Interrupted(_asked.number)
    numbers = _heeded()
    ours, interpreters = socket.socketpair()
    interpreters.setblocking(False)

    def wait() -> None:
        while byte := ours.recv(1):
            if byte[0] not in numbers:
                continue
            if caught.number is not None:
                with suppress(Exception):
                    at_once()
                leave(byte[0])
            caught.number = byte[0]
            stop.set()
            with suppress(Exception):  # with SIGHUP the terminal is gone
                notify("\nstopping at the next checkpoint; press Ctrl-C again to stop at once")

    handlers = {n: signal.signal(n, lambda number, frame: None) for n in numbers}
    descriptor = signal.set_wakeup_fd(interpreters.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=wait, name="signals", daemon=True)
    thread.start()
    try:
        yield caught
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        interpreters.close()  # the thread reads the end and goes
        thread.join()
        ours.close()
        error = sys.exc_info()[1]
        if caught.number is not None and error is not None and hasattr(error, "exit_code"):  # a Cancelled
            error.exit_code = code_of(caught.number)


@contextmanager
def as_exceptions() -> Iterator[Caught]:
    """Around a whole command: a signal outside of a run raises `Interrupted`, so that folders are tidied on the way.

    The second signal ends the program at once. Where an exception can't be raised, such as in a `__del__`, Python drops
    it; it is then raised again a moment later. An error that follows from it leaves as `Interrupted` too. The `Caught`
    tells whether one came, should a library have caught it.
    """
    _asked.number = None
    if threading.current_thread() is not threading.main_thread():
        yield _asked
        return

    def first(number: int, frame: FrameType | None) -> None:
        if _asked.number is not None:
            leave(number)
        _asked.number = number
        raise Interrupted(number)

    def again(number: int, frame: FrameType | None) -> None:
        if _asked.number is not None:
            raise Interrupted(_asked.number)

    def dropped(what: Any) -> None:
        if not isinstance(what.exc_value, Interrupted):
            hook(what)
        elif signal.getsignal(signal.SIGALRM) is again:
            signal.setitimer(signal.ITIMER_REAL, AGAIN)

    hook, sys.unraisablehook = sys.unraisablehook, dropped
    handlers = {n: signal.signal(n, first) for n in _heeded()} | {signal.SIGALRM: signal.signal(signal.SIGALRM, again)}
    try:
        yield _asked
    except Exception as e:
        if _asked.number is None:
            raise
        raise Interrupted(_asked.number) from e  # a library made it an error of its own: pydantic does on import
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook


def from_the_start() -> None:
    """While the program is still being imported: end it without a traceback."""
    for number in _heeded():
        signal.signal(number, lambda n, frame: leave(n))


def leave(number: int) -> None:
    """End this process now, as one that a signal ended."""
    with suppress(Exception):
        sys.stderr.flush()
    os._exit(code_of(number))


def end_with(parent: int) -> None:
    """Have the kernel kill this process when its parent dies; exit if the parent is already dead.

    Raises:
        OSError: the kernel refuses.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl")
    if os.getppid() != parent:  # it died before the kernel was set to
        leave(signal.SIGKILL)


def _heeded() -> tuple[signal.Signals, ...]:
    """All three; not SIGHUP where the user chose to ignore it (nohup)."""
    return tuple(n for n in SIGNALS if n != signal.SIGHUP or signal.getsignal(n) is not signal.SIG_IGN)
