"""One run at a time into one folder, and a way to see from outside whether that run is still alive.

A run holds a lock in the store, named after its `out`. The kernel releases it when the process ends, in
whatever way; no clock and no heartbeat is involved. If the lock can be taken, no run is active there.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from pipeline.errors import Cancelled, stage_error_from_os_error
from pipeline.store import LOCKS
from workflows.run.output_dirs import writable

POLL = 0.2  # seconds between two attempts


@contextmanager
def exclusive_run(store: Path, out: Path, stopped: Callable[[], bool], notify: Callable[[str], None]) -> Iterator[None]:
    """Check that `out` and the store can be written, wait until no other run writes to `out`, then hold its lock.

    Raises:
        Cancelled: stopped by the user while waiting. StageError: one of the folders can't be written.
    """
    with writable(out, store), _locked(store, out, stopped, notify):
        yield


@contextmanager
def _locked(store: Path, out: Path, stopped: Callable[[], bool], notify: Callable[[str], None]) -> Iterator[None]:
    path = _path(store, out)
    handle, notified = _take(path), False
    while handle is None:
        if not notified:
            notify(f"another run writes to {out}: waiting for its end")
            notified = True
        if stopped():
            raise Cancelled("stopped by the user while another run was at work")
        time.sleep(POLL)
        handle = _take(path)
    try:
        yield
    finally:  # the file stays, as those of the store do
        handle.close()


def is_held(store: Path, out: Path) -> bool:
    """Whether a process, here or on another machine with the same store, runs into `out` now."""
    return not lock_is_free(_path(store, out))


def lock_is_free(path: Path) -> bool:
    """Whether no process holds this lock file; free where there is none."""
    if not path.is_file():
        return True
    handle = _take(path)
    if handle is not None:
        handle.close()
    return handle is not None


def _path(store: Path, out: Path) -> Path:
    return store.absolute() / LOCKS / f"run-{hashlib.sha256(str(out.resolve()).encode()).hexdigest()[:32]}"


def _take(path: Path) -> IO[str] | None:
    """The locked file, or None while another holds it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = path.open("a")
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if path.is_file() and path.stat().st_ino == os.fstat(handle.fileno()).st_ino:
            return handle
        handle.close()  # a failed run swept its new store away while this one waited
    except BlockingIOError:
        handle.close()
    except OSError as e:
        raise stage_error_from_os_error(e, path.parent) or e from e
    return None
