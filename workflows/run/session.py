"""Who watches a run, and what stops it."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any, Protocol

from pipeline.contract import Done


class Observer(Protocol):
    """Is informed of what a run does."""

    def started(self, stage: str, number: int, of: int) -> None:
        """A stage begins; `number` counts from 1."""
        ...

    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None:
        """How far the stage is."""
        ...

    def finished(self, done: Done[Any]) -> None:
        """The stage is done, or its result was found in the store."""
        ...

    def note(self, text: str) -> None:
        """A message for the user."""
        ...


class Silent:
    """An observer that shows nothing."""

    def started(self, stage: str, number: int, of: int) -> None: ...
    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None: ...
    def finished(self, done: Done[Any]) -> None: ...
    def note(self, text: str) -> None: ...


@dataclass(frozen=True, slots=True)
class Session:
    """One run's observer and its stop flags.

    stop: set by the user. late: set by the time limit of the running stage. begun: start, by time.monotonic().
    """

    observer: Observer = field(default_factory=Silent)
    stop: threading.Event = field(default_factory=threading.Event)
    late: threading.Event = field(default_factory=threading.Event)
    begun: float = field(default_factory=time.monotonic)

    def stopped(self) -> bool:
        """Whether the running stage has to end: the user stopped it, or its time is over."""
        return self.stop.is_set() or self.late.is_set()
