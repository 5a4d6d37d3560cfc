"""Who watches a run, and what stops it."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from pipeline.contract import Done, Show, no_show
from workflows.run.steering import Steering

if TYPE_CHECKING:
    from workflows.run.request import RunRequest


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

    def paused(self, waits: bool) -> None:
        """The stage at work waits, because the user paused the run; or it goes on."""
        ...

    def replanned(self, seconds: Mapping[str, float | None], request: RunRequest) -> None:
        """The user chose another preset or budget: the stages begin again. seconds: expected of each."""
        ...

    def note(self, text: str) -> None:
        """A message for the user."""
        ...


class Silent:
    """An observer that shows nothing."""

    def started(self, stage: str, number: int, of: int) -> None: ...
    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None: ...
    def finished(self, done: Done[Any]) -> None: ...
    def paused(self, waits: bool) -> None: ...
    def replanned(self, seconds: Mapping[str, float | None], request: RunRequest) -> None: ...
    def note(self, text: str) -> None: ...


@dataclass(frozen=True, slots=True)
class Session:
    """One run's observer, what the user asks of it, and its stop flags.

    stop: set by the user. late: set by the time limit of the running stage. begun: start, by time.monotonic(). show:
    takes pictures of the stages' work.
    """

    observer: Observer = field(default_factory=Silent)
    stop: threading.Event = field(default_factory=threading.Event)
    late: threading.Event = field(default_factory=threading.Event)
    begun: float = field(default_factory=time.monotonic)
    steering: Steering = field(default_factory=Steering)
    show: Show = no_show

    def stopped(self) -> bool:
        """Whether the running stage has to end: the user stopped it, its time is over, or it is to
        go on with another setting. Waits while it is paused."""
        self.steering.wait(self._ended)
        return self._ended() or self.steering.stops or self.steering.change is not None

    def _ended(self) -> bool:
        return self.stop.is_set() or self.late.is_set()

    def asked_to_stop(self) -> bool:
        """Whether the user stopped the run; waits for nothing."""
        return self.stop.is_set() or self.steering.stops

    def elapsed(self) -> float:
        """Seconds since the start, without those for which the run was paused."""
        return time.monotonic() - self.begun - self.steering.waited()
