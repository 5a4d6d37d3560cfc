"""How a run looks: lines that are drawn again on a terminal, plain lines in a pipe or a file, or JSON for programs."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from pipeline.contract import Done
from workflows.cli.events import PROGRESS_EVERY, Events
from workflows.cli.screen import Screen, bar, can_redraw
from workflows.run.forecast import Forecast, in_words

if TYPE_CHECKING:
    from workflows.run.request import RunRequest

PLAIN_EVERY = 5.0  # seconds between two lines of one stage
DRAWN_EVERY = 0.2  # seconds between two drawings
TICK = 1.0  # seconds after which a terminal is drawn again though a stage told nothing: the time runs on


class Console:
    """An Observer that writes to `stream` (None: stderr as it is now; stdout is for results), or JSON to stdout.

    clock: seconds since any moment; a test passes its own.
    """

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.stream, self._clock = sys.stderr if stream is None else stream, clock
        self._paused: float | None = None  # since when
        self._away, self.keys = 0.0, ""  # seconds of pauses before; which keys do what
        self.screen = Screen(self.stream) if can_redraw(self.stream) else None
        self.events: Events | None = None
        self.forecast = Forecast({}, clock())
        self.label, self.stage, self.said, self.last, self.warning = "", "", "", 0.0, ""
        self.counted = False  # whether the stage at work is one of the run's
        self.warned: set[str] = set()  # results whose warnings were shown: `neuface check` meets some twice
        self._lock = threading.RLock()  # the run, the thread of the signals and that of the ticks all write
        self._at_work = threading.Event()

    def clock(self) -> float:
        """Seconds since any moment, without those for which the run was paused."""
        return (self._clock() if self._paused is None else self._paused) - self._away

    def to_json(self, stream: TextIO | None = None) -> None:
        """From now on events as JSON, on standard output, and nothing for people."""
        self.events, self.screen = Events(sys.stdout if stream is None else stream, self._clock), None

    def expect(self, seconds: Mapping[str, float | None], deadline: float | None = None) -> None:
        """A run begins. seconds: how long each stage is expected to take; deadline: of the whole run, a budget."""
        self.forecast = Forecast(seconds, self.clock(), deadline)

    # ------------------------------------------------------------------ of the run
    def started(self, stage: str, number: int, of: int) -> None:
        """A stage begins; `of` is 0 for what is none of the run's stages."""
        with self._lock:
            self.stage, self.said, self.counted = stage, "", of > 0
            self.label = f"[{number}/{of}] {stage}" if of else stage
            self.last = self.clock()
            self.forecast.started(stage, self.last)
            if self.events is not None:
                self.events.tell("started", stage=stage, number=number, of=of)
            self._draw()
        if self.screen is not None and not self._at_work.is_set():
            self._at_work.set()
            threading.Thread(target=self._tick, name="console", daemon=True).start()

    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None:
        """How far the stage is."""
        with self._lock:
            now = self.clock()
            self.forecast.progress(done, total, message, now)
            self.said = " ".join([message, *(f"{k} {v:.4g}" for k, v in figures.items())]).strip()
            every = DRAWN_EVERY if self.screen else PLAIN_EVERY if self.events is None else PROGRESS_EVERY
            if now - self.last < every:
                return
            self.last = now
            if self.events is not None:
                self.events.tell("progress", stage=self.stage, **self._figures(now), message=message, figures=figures)
            elif self.screen is not None:
                self._draw()
            else:
                self.note(self._plain(now))

    def finished(self, done: Done[Any]) -> None:
        """The stage is done."""
        with self._lock:
            self.forecast.finished(done.stage, self.clock(), reused=done.reused)
            seconds = float(done.run.get("seconds", 0.0))
            new = getattr(done.located.artifact, "warnings", ()) if done.key not in self.warned else ()
            self.warned.add(done.key)
            if self.events is not None:
                overall = {**self._figures(self.clock()), "stage_percent": 100.0}
                self.events.tell("finished", stage=done.stage, reused=done.reused, seconds=seconds, **overall)
                for warning in new:
                    self.events.tell("warning", stage=done.stage, text=warning)
                return
            self.stage = ""  # its line goes, and this one stays
            self._draw()
            self.note(f"{self.label}: {'reused' if done.reused else f'{seconds:.1f} s'}")
            for warning in new:
                self.note(f"    warning: {warning}")
                self.warning = f"{done.stage}: {warning}"
            self._draw()

    def paused(self, waits: bool) -> None:
        """The stage at work waits, or goes on. The time between the two is not the run's."""
        with self._lock:
            now = self._clock()
            if not waits and self._paused is not None:
                self._away += now - self._paused
            self._paused = now if waits else None
            if self.events is not None:
                self.events.tell("paused" if waits else "went_on", stage=self.stage)
            elif self.screen is None:
                self.note(f"{self.label}: {'paused' if waits else 'goes on'}")
            self._draw()

    def replanned(self, seconds: Mapping[str, float | None], request: RunRequest) -> None:
        """The run begins again with another preset or budget."""
        with self._lock:
            self.expect(seconds, request.budget)
            if self.events is not None:
                self.events.tell("changed", preset=request.preset, budget=request.budget)
            self._draw()

    def note(self, text: str) -> None:
        """A line of its own."""
        with self._lock:
            if self.events is not None:
                self.events.tell("note", text=text.strip())
                return
            try:
                if self.screen is not None:
                    self.screen.above(text)
                else:
                    print(text, file=self.stream, flush=True)
            except OSError:
                self._lost()

    def result(self, event: str, **fields: Any) -> None:
        """What a command came to, for programs; nothing where people read."""
        if self.events is not None:
            self.events.tell(event, **fields)

    def close(self) -> None:
        """Take the lines off the screen."""
        with self._lock:
            self._at_work.clear()
            self.stage = ""
            if self.screen is not None:
                with suppress(OSError):
                    self.screen.clear()

    # ------------------------------------------------------------------ how it looks
    def _figures(self, now: float) -> dict[str, float | None]:
        """Percentages, and seconds that remain (None: not known)."""
        rest = self.forecast.remaining(now)
        return {
            "stage_percent": round(100 * self.forecast.stage_share, 1),
            "percent": round(100 * self.forecast.share_of_run(now), 1),
            "remaining": None if rest is None else round(rest, 1),
        }

    def _plain(self, now: float) -> str:
        line = f"{self.label}: {100 * self.forecast.stage_share:.0f} % {self.said}".rstrip()
        if not self.counted or not self.forecast.expected:
            return line
        return f"{line}; run {100 * self.forecast.share_of_run(now):.0f} %{self._left(now)}"

    def _left(self, now: float) -> str:
        rest = self.forecast.remaining(now)
        ended = self.forecast.stages_done >= len(self.forecast.expected)
        return "" if rest is None or ended else f", about {in_words(rest)} left"

    def _lines(self, now: float) -> list[str]:
        """The stage at work, the run, and the last warning."""
        share, expected = self.forecast.stage_share, self.forecast.expected
        lines = [f"{self.label:24} {100 * share:3.0f} % {bar(share)} {self.said}".rstrip()] if self.stage else []
        if expected and (self.counted or not self.stage):
            done, share = self.forecast.stages_done, self.forecast.share_of_run(now)
            text = f"{done} of {len(expected)} stages, {clock_time(now - self.forecast.begun)}{self._left(now)}"
            text = f"paused, {text}" if self._paused is not None else text
            lines.append(f"run: {100 * share:3.0f} % {bar(share)} {text}")
        if self.warning:
            lines.append(f"last warning: {self.warning}")
        if self.keys and self.stage:
            lines.append(self.keys)
        return lines

    def _draw(self) -> None:
        if self.screen is None:
            return
        try:
            self.screen.draw(self._lines(self.clock()))
        except OSError:
            self._lost()

    def _tick(self) -> None:
        while self._at_work.is_set():
            time.sleep(TICK)
            with self._lock:
                if self._at_work.is_set():
                    self._draw()

    def _lost(self) -> None:
        """The terminal or the reader of the pipe is gone: the run continues, or stops, without output."""
        self.screen = None
        self._at_work.clear()
        self.stream = Path(os.devnull).open("w")  # noqa: SIM115  (as long as the program)


def clock_time(seconds: float) -> str:
    """ "4:07", or "1:02:30" from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02d}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
