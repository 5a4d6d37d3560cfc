"""How a run looks in a terminal: a bar for each stage, or a plain line every few seconds where nobody sees a bar."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

from pipeline.contract import Done

PLAIN_EVERY = 5.0  # seconds between two lines of one stage


class Console:
    """An Observer that writes to `stream` (stderr: stdout is for results)."""

    def __init__(self, stream: TextIO = sys.stderr) -> None:
        self.stream, self.bars = stream, stream.isatty()
        self.bar: tqdm[Any] | None = None
        self.label, self.last, self.began = "", 0.0, time.monotonic()
        self.warned: set[str] = set()  # results whose warnings were shown: `neuface check` meets some twice

    def started(self, stage: str, number: int, of: int) -> None:
        """A stage begins; `of` is 0 for what is none of the run's stages."""
        self.label = f"[{number}/{of}] {stage}" if of else stage
        self.last = time.monotonic()
        if self.bars:
            self.bar = tqdm(
                total=1,
                desc=self.label,
                file=self.stream,
                leave=False,
                bar_format="{desc}: {percentage:3.0f}% |{bar:24}| {elapsed} {postfix}",
            )

    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None:
        """How far the stage is."""
        shown = " ".join([message, *(f"{k} {v:.4g}" for k, v in figures.items())]).strip()
        if self.bar is not None:
            try:
                self._draw(self.bar, done, total, shown)
            except OSError:
                self._lost()
        elif time.monotonic() - self.last >= PLAIN_EVERY:
            self.last = time.monotonic()
            self.note(f"{self.label}: {100 * done / max(total, 1):.0f} % {shown}".rstrip())

    def _draw(self, bar: tqdm[Any], done: int, total: int, shown: str) -> None:
        bar.total = max(total, 1)
        bar.n = min(done, total)
        bar.set_postfix_str(shown, refresh=False)
        bar.update(0)
        if time.monotonic() - self.last > 0.2 or done >= total:
            self.last = time.monotonic()
            bar.refresh()

    def finished(self, done: Done[Any]) -> None:
        """The stage is done."""
        self.close()
        how = "reused" if done.reused else f"{done.run.get('seconds', 0):.1f} s"
        self.note(f"{self.label}: {how}")
        for warning in getattr(done.located.artifact, "warnings", ()) if done.key not in self.warned else ():
            self.note(f"    warning: {warning}")
        self.warned.add(done.key)

    def note(self, text: str) -> None:
        """A line of its own."""
        try:
            if self.bar is not None:
                self.bar.clear()
            print(text, file=self.stream, flush=True)
        except OSError:
            self._lost()

    def close(self) -> None:
        """Take the bar off the screen."""
        bar, self.bar = self.bar, None
        if bar is not None:
            with suppress(OSError):
                bar.close()

    def _lost(self) -> None:
        """The terminal or the reader of the pipe is gone: the run continues, or stops, without output."""
        self.bar, self.bars = None, False
        self.stream = Path(os.devnull).open("w")  # noqa: SIM115  (as long as the program)
