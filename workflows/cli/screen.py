"""Lines at the bottom of a terminal that are drawn again in place, below all that was printed before them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from typing import TextIO

UP, ERASE_BELOW = "\x1b[{}A", "\x1b[J"
BAR = 16  # characters
LEAST = 20  # columns: narrower terminals break lines


def can_redraw(stream: TextIO, environment: Mapping[str, str] = os.environ) -> bool:
    """Whether lines on this stream can be drawn again: a terminal that moves its cursor."""
    return stream.isatty() and environment.get("TERM", "") not in ("", "dumb")


def bar(share: float) -> str:
    """A bar for a share in 0..1."""
    filled = int(BAR * share)
    return f"|{'#' * filled}{'-' * (BAR - filled)}|"


class Screen:
    """The lines that are on the terminal now. Every method may raise OSError: the terminal can go away."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.shown: tuple[str, ...] = ()

    def draw(self, lines: Sequence[str]) -> None:
        """Put these lines in place of those before. What is longer than the terminal is wide is cut."""
        fitting = tuple(line[: self._width()] for line in lines)
        if fitting != self.shown:
            self._write(self._erase() + "\n".join(fitting))
            self.shown = fitting

    def above(self, text: str) -> None:
        """Print a text that stays, above the lines."""
        lines = self.shown
        self._write(self._erase() + text + "\n" + "\n".join(lines))

    def clear(self) -> None:
        """Take the lines away."""
        self._write(self._erase())
        self.shown = ()

    def _erase(self) -> str:
        if not self.shown:
            return ""
        return "\r" + (UP.format(len(self.shown) - 1) if len(self.shown) > 1 else "") + ERASE_BELOW

    def _write(self, text: str) -> None:
        if text:
            self.stream.write(text)
            self.stream.flush()

    @staticmethod
    def _width() -> int:
        return max(LEAST, shutil.get_terminal_size().columns - 1)
