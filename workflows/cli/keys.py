"""Keys in the terminal of a run: p pauses, space goes on, s stops after the stage, b and a digit choose another time.

Keys are read while this process is in the foreground of the terminal: one in the background would be stopped by the
kernel when it reads. Ctrl-C and Ctrl-Z do what they always do.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from workflows.cli.console import Console
from workflows.run.steering import BUDGET, OFFERED_MINUTES, OFFERED_PRESETS, PRESET, Steering

WISHES = {"p": "pause", " ": "go on", "s": "stop after stage"}
HELP = "keys: p pause, space go on, s stop after this stage, b another time, Ctrl-C stop"
SAID = {
    "pause": "pausing at the next checkpoint; space goes on",
    "go on": "going on",
    "stop after stage": "stopping after this stage; space takes it back",
}
OFFERED = {f"{PRESET} {p}": p for p in OFFERED_PRESETS} | {
    f"{BUDGET} {60 * m}": f"{m} min from now" for m in OFFERED_MINUTES
}  # wish -> its words
TIMES = {str(n): wish for n, wish in enumerate(OFFERED, 1)}  # after b
ASKED = (
    f"another time; the fit starts again: {', '.join(f'{n}: {OFFERED[wish]}' for n, wish in TIMES.items())}; "
    "any other key: as it is"
)
LOOK = 0.2  # seconds between two looks


class Keys:
    """Reads single keys from a terminal. descriptor: None where there is none."""

    def __init__(self, steering: Steering, console: Console, descriptor: int | None) -> None:
        self.steering, self.console, self.descriptor = steering, console, descriptor
        self._ends, self._choosing = threading.Event(), False
        self._before: list[Any] | None = None  # the terminal's settings, while ours are in force
        self._lock = threading.Lock()

    def restore(self) -> None:
        """Give the terminal its settings back."""
        with self._lock:
            before, self._before = self._before, None
            if before is not None and self.descriptor is not None and self._in_front():
                with suppress(termios.error, OSError):
                    termios.tcsetattr(self.descriptor, termios.TCSADRAIN, before)

    def read(self) -> None:
        """Until `end`: take keys as wishes."""
        while not self._ends.is_set() and self.descriptor is not None:
            try:
                if not self._in_front():
                    self._ends.wait(LOOK)
                    continue
                self._take_over()
                ready, _, _ = select.select([self.descriptor], [], [], LOOK)
                if not ready or not self._in_front():
                    continue
                typed = os.read(self.descriptor, 1)
            except (OSError, termios.error, ValueError):  # the terminal is gone
                return
            if not typed:
                return
            self.press(typed.decode(errors="replace"))

    def press(self, key: str) -> None:
        """What a key asks for; others ask for nothing."""
        if self._choosing:
            self._choosing = False
            self._choose(key)
            return
        if key.lower() == "b" and self.steering.changeable:
            self._choosing = True
            self.console.note(ASKED)
            return
        wish = WISHES.get(key.lower())
        if wish is None:
            return
        asked = self.steering.pausing or self.steering.ends_after_stage.is_set()
        self.steering.wish(wish)
        if wish != "go on" or asked:
            self.console.note(SAID[wish])

    def _choose(self, key: str) -> None:
        change = TIMES.get(key)
        self.console.note("nothing is changed" if change is None else f"{change}: at the next checkpoint")
        if change is not None:
            self.steering.wish(change)

    def end(self) -> None:
        """Read no more."""
        self._ends.set()
        self.restore()

    def _in_front(self) -> bool:
        return self.descriptor is not None and os.tcgetpgrp(self.descriptor) == os.getpgrp()

    def _take_over(self) -> None:
        """Keys without Enter and without an echo; signals as before. A shell may have changed it in between."""
        with self._lock:
            if self._ends.is_set() or self.descriptor is None:
                return
            now: list[Any] = termios.tcgetattr(self.descriptor)
            if now[3] & termios.ICANON:
                self._before = self._before or now
                tty.setcbreak(self.descriptor, termios.TCSADRAIN)


@contextmanager
def keys_of(steering: Steering, console: Console) -> Iterator[Keys]:
    """While the block runs, keys steer the run, if a person sits at the terminal that it is drawn on."""
    keys = Keys(steering, console, _terminal() if console.screen is not None else None)
    thread = threading.Thread(target=keys.read, name="keys", daemon=True)
    if keys.descriptor is not None:
        console.keys = HELP
        thread.start()
    try:
        yield keys
    finally:
        keys.end()
        console.keys = ""
        if keys.descriptor is not None:
            thread.join()


def _terminal() -> int | None:
    """The standard input, if it is a terminal."""
    try:
        descriptor = sys.stdin.fileno()
        return descriptor if os.isatty(descriptor) else None
    except (OSError, ValueError, AttributeError):
        return None
