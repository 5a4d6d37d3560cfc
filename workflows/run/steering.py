"""What a user asks of a run while it goes on: pause, go on, stop after this stage, stop now, another time.

A stage asks at its checkpoints whether it has to stop (pipeline.contract.Context.check). While the run is paused it
waits there: the process lives and keeps its locks, and the wait counts for no time limit. A signal ends the wait as it
ends any stage, with its checkpoint.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, get_args

from stages.presets import PRESETS

Wish = Literal["pause", "go on", "stop after stage", "stop"]
WISHES: tuple[str, ...] = get_args(Wish)
PRESET, BUDGET = "preset", "budget"  # "preset studio", "budget 600": see workflows/run/changes.py
SHORTEST, LONGEST = 60.0, 7 * 86400.0  # seconds of a budget
OFFERED_PRESETS = tuple(p for p in PRESETS if p != "paper")  # on the page and by keys; paper is another model
OFFERED_MINUTES = (5, 10, 20, 60)  # of a budget
LOOK = 0.25  # seconds between two looks for wishes
WAIT = 0.1  # seconds between two looks while paused


def is_change(wish: str) -> bool:
    """Whether a wish names another preset, or a budget in seconds."""
    kind, _, value = wish.partition(" ")
    if kind == PRESET:
        return value in PRESETS
    try:
        return kind == BUDGET and SHORTEST <= float(value) <= LONGEST
    except ValueError:
        return False


def is_wish(wish: object) -> bool:
    """Whether a run understands it."""
    return isinstance(wish, str) and (wish in WISHES or is_change(wish))


class Steering:
    """The wishes for one run. All methods may be called from any thread.

    ask: looks elsewhere for a wish, such as in a file; called at most every LOOK seconds by the stage at work.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock, self.ask = clock, _nobody
        self.ends_after_stage = threading.Event()
        self.changeable = False  # whether the run takes another setting of time
        self.change: str | None = None  # the one that is asked for
        self._stop = threading.Event()
        self._pausing = threading.Event()
        self._lock = threading.Lock()
        self._listeners: list[Callable[[bool], None]] = []
        self._waiting, self._since, self._waited, self._looked = 0, 0.0, 0.0, clock() - LOOK

    def wish(self, wish: str) -> None:
        """Take a wish; one that is not known changes nothing."""
        if wish == "pause":
            self._pausing.set()
        elif wish == "go on":
            self._pausing.clear()
            self.ends_after_stage.clear()
        elif wish == "stop after stage":
            self._pausing.clear()
            self.ends_after_stage.set()
        elif wish == "stop":
            self._stop.set()
        elif self.changeable and is_change(wish):
            self._pausing.clear()
            self.change = wish

    @contextmanager
    def open_to_changes(self) -> Iterator[None]:
        """While the block runs, take another preset or budget."""
        self.changeable = True
        try:
            yield
        finally:
            self.changeable, self.change = False, None

    def take_change(self) -> str | None:
        """The latest change that was asked for since the last call."""
        with self._lock:
            change, self.change = self.change, None
        return change

    @property
    def pausing(self) -> bool:
        """Whether a pause is asked for; the stage may not be at a checkpoint yet."""
        return self._pausing.is_set()

    @property
    def paused(self) -> bool:
        """Whether the stage waits."""
        return self._waiting > 0

    @property
    def stops(self) -> bool:
        """Whether the run was asked, otherwise than by a signal, to stop at the next checkpoint."""
        return self._stop.is_set()

    def waited(self) -> float:
        """Seconds so far for which the run was paused."""
        with self._lock:
            return self._waited + (self.clock() - self._since if self._waiting else 0.0)

    def wait(self, stopped: Callable[[], bool]) -> None:
        """At a checkpoint: look for wishes, and while the run is paused, wait. stopped: ends the wait."""
        self._look()
        if not self._pausing.is_set() or stopped():
            return
        with self._as_waiting():
            while self._pausing.is_set() and not (stopped() or self.stops):
                time.sleep(WAIT)
                self._look()

    @contextmanager
    def telling(self, listener: Callable[[bool], None]) -> Iterator[None]:
        """While the block runs, tell the listener when the stage begins to wait (True) and when it goes on (False)."""
        self._listeners.append(listener)
        try:
            yield
        finally:
            self._listeners.remove(listener)

    @contextmanager
    def _as_waiting(self) -> Iterator[None]:
        with self._lock:
            self._waiting += 1
            first = self._waiting == 1
            if first:
                self._since = self.clock()
        if first:
            self._tell(True)
        try:
            yield
        finally:
            with self._lock:
                self._waiting -= 1
                last = self._waiting == 0
                if last:
                    self._waited += self.clock() - self._since
            if last:
                self._tell(False)

    def _tell(self, waits: bool) -> None:
        """Without the lock: a listener may ask for `waited`."""
        for listener in list(self._listeners):
            listener(waits)

    def _look(self) -> None:
        with self._lock:
            now = self.clock()
            if now - self._looked < LOOK:
                return
            self._looked = now
        found = self.ask()
        if found is not None:
            self.wish(found)


def _nobody() -> str | None:
    return None
