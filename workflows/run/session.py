"""Who watches a run, and who may stop it. Flow parameters have to be plain data, so this travels beside them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Protocol

from pipeline.contract import Done


class Observer(Protocol):
    """Told what a run does."""

    def started(self, stage: str, number: int, of: int) -> None:
        """A stage begins; `number` counts from 1."""
        ...

    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None:
        """How far the stage is."""
        ...

    def finished(self, done: Done[Any]) -> None:
        """The stage is done, or its result was found."""
        ...

    def note(self, text: str) -> None:
        """Something worth a line."""
        ...


class Silent:
    """An observer that shows nothing."""

    def started(self, stage: str, number: int, of: int) -> None: ...
    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None: ...
    def finished(self, done: Done[Any]) -> None: ...
    def note(self, text: str) -> None: ...


@dataclass(frozen=True, slots=True)
class Session:
    """One run's watcher and its stop flags.

    stop: the user's. late: the time limit's, of the stage at work. begun: when, by time.monotonic().
    """

    observer: Observer = field(default_factory=Silent)
    stop: threading.Event = field(default_factory=threading.Event)
    late: threading.Event = field(default_factory=threading.Event)
    begun: float = field(default_factory=time.monotonic)

    def stopped(self) -> bool:
        """Whether the stage at work has to end: the user said so, or its time is over."""
        return self.stop.is_set() or self.late.is_set()


_SESSION: ContextVar[Session | None] = ContextVar("neuface_session", default=None)


def given() -> Session | None:
    """The session that a command of this process made, if one did."""
    return _SESSION.get()


def current() -> Session:
    """The session around this code, or one that is silent and never stopped."""
    return _SESSION.get() or Session()


@contextmanager
def session(value: Session) -> Iterator[Session]:
    """Make `value` the current session."""
    token = _SESSION.set(value)
    try:
        yield value
    finally:
        _SESSION.reset(token)
