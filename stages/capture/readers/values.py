"""Strict reading of single values of a cameras' file: numbers, flags, sizes and names.

Any wrong value raises a `StageError` that names the place and the remedy. The size of a value is checked before memory
is allocated for it.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.errors import StageError
from pipeline.transforms import F64

MAX_MAGNITUDE = 1e15  # of any number: larger than in any unit, and its square is still finite
LONGEST_EDGE = 1_000_000  # pixels
MAX_NUMBERS, MAX_LETTERS = 64, 10_000  # of one table, of one text
DIGITS = 9  # of a view's number
LONGEST_NAME = 240  # bytes: file systems allow 255, and a suffix may be added
LONGEST_PATH = 1000  # bytes, below the capture's folder
PLAIN = "write it as a plain JSON number"
ROWS = "write it as plain JSON numbers in rows of equal length"
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlist = 2, 80, 80, 12


def fault(what: str, where: str, value: object, limit: object, remedy: str) -> StageError:
    """The error for the user."""
    return StageError(what, where=where, value=value, limit=limit, remedy=remedy)


def shown(value: object) -> str:
    """A value as short text for a message, also if it is large or deeply nested."""
    return _SHORT.repr(value)[:120]


def printable(name: str) -> str:
    """A name from a file in printable form: what is not Unicode is escaped, long names are shortened."""
    clean = name[:MAX_LETTERS].encode("utf-8", "backslashreplace").decode()
    return clean if len(clean) <= 120 else f"{clean[:80]}...{clean[-20:]}"


def some_of(names: Sequence[str], most: int) -> str:
    """The first `most` names for a message, with dots where there are more."""
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def number(value: object, where: str, remedy: str = PLAIN) -> float:
    """A finite number. Raises StageError for text, flags, lists, and numbers not finite or beyond MAX_MAGNITUDE."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise fault("a camera parameter is not a number", where, shown(value), "a number", remedy)
    if isinstance(value, int) and abs(value) > MAX_MAGNITUDE:
        raise _too_large(where, value, remedy)
    return float(finite(np.array(float(value)), where, remedy))


def table(value: object, where: str, remedy: str = ROWS) -> F64:
    """A number (), a row (N,) or rows of equal length (N, M), with at most MAX_NUMBERS numbers. Raises StageError."""
    rows: list[Any] = value if isinstance(value, list) else [value]
    nested = bool(rows) and all(isinstance(r, list) for r in rows)
    width = len(rows[0]) if nested else 1
    flat = [x for r in rows[:MAX_NUMBERS] for x in r[:MAX_NUMBERS]] if nested else rows[: MAX_NUMBERS + 1]
    even = not nested or all(len(r) == width for r in rows)
    if not even or any(isinstance(x, bool) or not isinstance(x, int | float) for x in flat):
        raise fault("a camera parameter is not a table of numbers", where, shown(value), "numbers only", remedy)
    if len(rows) * width > MAX_NUMBERS:
        raise fault("a camera parameter has the wrong shape", where, f"more than {MAX_NUMBERS} numbers",
                    f"at most {MAX_NUMBERS} numbers", remedy)  # fmt: skip
    for x in flat:
        if isinstance(x, int) and abs(x) > MAX_MAGNITUDE:
            raise _too_large(where, x, remedy)
    return finite(np.array(value, np.float64), where, remedy)


def words(text: str | None, count: int, where: str, remedy: str) -> F64:
    """(count,) numbers from a text with spaces between them. Raises StageError."""
    text = text or ""
    try:
        if len(text) > MAX_LETTERS:
            raise ValueError
        found = np.array([float(w) for w in text.split()], np.float64)
    except ValueError as e:
        raise fault("a camera parameter is not a table of numbers", where, shown(text), "numbers", remedy) from e
    if found.size != count:
        raise fault("a camera parameter has the wrong length", where, found.size, f"{count} numbers", remedy)
    return finite(found, where, remedy)


def finite(values: F64, where: str, remedy: str = "write it again from the calibration, or remove the view") -> F64:
    """The values, of any shape, themselves. Raises StageError if any is NaN, infinite or beyond MAX_MAGNITUDE."""
    if not np.isfinite(values).all():
        raise fault("a camera parameter is not finite", where, shown(values.tolist()),
                    "finite numbers only (no NaN, no Infinity)", remedy)  # fmt: skip
    if np.abs(values).max(initial=0.0) > MAX_MAGNITUDE:
        raise _too_large(where, float(np.abs(values).max()), remedy)
    return values


def pixels(value: object, where: str, remedy: str = "write the photo's size in pixels") -> int:
    """A width or height in pixels. Raises StageError if it is not a whole number from 1 to LONGEST_EDGE."""
    if isinstance(value, int | float) and not isinstance(value, bool) and 1 <= value <= LONGEST_EDGE:
        whole = math.floor(value)
        if whole == value:
            return whole
    raise fault("image size is not a whole number of pixels", where, shown(value),
                f"a whole number from 1 to {LONGEST_EDGE}", remedy)  # fmt: skip


def flag(value: object, where: str, remedy: str = "write true or false, without quotation marks") -> bool:
    """A JSON boolean, or 0 or 1. Raises StageError for anything else, also for the text "false"."""
    if isinstance(value, int) and value in (0, 1):  # a bool is an int
        return bool(value)
    raise fault("a flag is neither true nor false", where, shown(value), "true, false, 0 or 1", remedy)


def label(value: object, where: str, remedy: str = "write it as text between quotation marks") -> str:
    """A name: text, or a whole number as text. Raises StageError."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) < MAX_MAGNITUDE:
        return str(value)
    if not isinstance(value, str) or len(value) > MAX_LETTERS or "\0" in value:
        raise fault("a name is not text", where, shown(value), f"text of at most {MAX_LETTERS} letters", remedy)
    return value.encode("utf-8", "backslashreplace").decode()  # a lone surrogate is not a character


def view_number(digits: str, where: str) -> int:
    """A view's number from its digits. Raises StageError if there are more than DIGITS."""
    if len(digits) > DIGITS:
        raise fault("a view's number is too long", where, shown(digits), f"at most {DIGITS} digits",
                    "number the views from 0")  # fmt: skip
    return int(digits)


def _too_large(where: str, value: float, remedy: str) -> StageError:
    return fault("a camera parameter is too large", where, shown(value), f"at most {MAX_MAGNITUDE:g}", remedy)
