"""Numbers with limits, as types of argparse: what is outside of them is wrong usage, told before any work."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """A whole number of at least `low`, and at most `high`."""
    limit = f"of at least {low}" if high is None else f"from {low} to {high}"

    def read(text: str) -> int:
        plain = text.isascii() and text.isdecimal() and len(text) <= 18
        if not plain or int(text) < low or (high is not None and int(text) > high):
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number {limit}")
        return int(text)

    return read


def whole_list(low: int, high: int) -> Callable[[str], tuple[int, ...]]:
    """Whole numbers with commas between them."""
    one = whole(low, high)
    return lambda text: tuple(one(part.strip()) for part in text.split(","))


def number(low: float, high: float = math.inf, *, above: bool = False) -> Callable[[str], float]:
    """A finite number from `low` to `high`. above: `low` itself is too little."""
    limit = f"{'above' if above else 'of at least'} {low:g}" + ("" if high == math.inf else f" and at most {high:g}")

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or value < low or value > high or (above and value == low):
            raise argparse.ArgumentTypeError(f"{text!r} is not a number {limit}")
        return value

    return read
