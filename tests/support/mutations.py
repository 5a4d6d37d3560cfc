"""Damage to small real files: bytes flipped, cut and repeated; values of JSON and of tables replaced by nonsense."""

from __future__ import annotations

import copy
import json
import re
from typing import Any

from hypothesis import strategies as st

BYTES = (
    b"",
    b"\0" * 8,
    b"\xff" * 8,
    b"\x7f" + b"\xff" * 7,
    b"NaN",
    b"1e300",
    b'"',
    b"]",
    b"\xed\xb3\xbf",
    b"\x80",
    b"<",
)
WORDS = ("nan", "inf", "-inf", "1e300", "-1e300", "1e-320", "0", "-1", "99999999999999999999", "9" * 5000, "x", "",
         "\u0660", "1 2 3", "\ud7ff", "a" * 5000, "../../etc/passwd", "/dev/zero")  # fmt: skip
VALUES = (float("nan"), float("inf"), 1e300, -1e300, 1e30, 1e-320, 0, -1, 10**400, True, False, None, "", "nan", "96px",
          "false", "\ud800", "\0", "n" * 5000, "../" * 50, [], {}, [[[[1]]]], [1, 2, 3], [[1], [2, 3]], [None] * 5,
          {"a": {"b": [1]}}, list(range(5000)), [[0.0] * 4] * 4)  # fmt: skip

share = st.floats(0, 1, exclude_max=True)
cuts = st.tuples(st.just("cut"), share, st.just(b""))
flips = st.tuples(st.just("flip"), share, st.integers(0, 7).map(lambda bit: bytes([1 << bit])))
writes = st.tuples(st.just("write"), share, st.sampled_from(BYTES) | st.binary(min_size=1, max_size=8))
inserts = st.tuples(st.just("insert"), share, st.sampled_from(BYTES))
doubles = st.tuples(st.just("double"), share, st.just(b""))
damages = st.lists(st.one_of(flips, writes, cuts, inserts, doubles), min_size=1, max_size=6)


def damaged(data: bytes, how: list[tuple[str, float, bytes]], head: int | None = None) -> bytes:
    """`data` with damages at shares of its length; of its first `head` bytes where that is said."""
    for kind, where, value in how:
        at = int(where * min(len(data), head or len(data)))
        if kind == "cut":
            data = data[:at]
        elif kind == "flip":
            data = data[:at] + bytes(x ^ value[0] for x in data[at : at + 1]) + data[at + 1 :]
        elif kind == "write":
            data = data[:at] + value + data[at + len(value) :]
        elif kind == "insert":
            data = data[:at] + value + data[at:]
        else:
            data = data[:at] + data
    return data


nonsense = st.lists(st.tuples(share, st.sampled_from(VALUES)), min_size=1, max_size=3)


def replaced(value: Any, how: list[tuple[float, Any]]) -> Any:
    """A JSON value with parts of it, at shares of all its places, replaced or (by None) taken out at random."""
    out = copy.deepcopy(value)
    for where, new in how:
        places = list(_places(out))
        if places:
            holder, key = places[int(where * len(places))]
            holder[key] = copy.deepcopy(new)
    return out


def _places(value: Any) -> Any:
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield value, key
        yield from _places(inner)


swaps = st.lists(st.tuples(share, st.sampled_from(WORDS)), min_size=1, max_size=3)


def reworded(text: str, how: list[tuple[float, str]], pattern: str = r"-?\d[\d.e+-]*") -> str:
    """A text with some of its numbers (or what else `pattern` finds) replaced."""
    for where, word in how:
        found = list(re.finditer(pattern, text))
        if found:
            m = found[int(where * len(found))]
            text = text[: m.start()] + word + text[m.end() :]
    return text


def as_json(value: Any) -> bytes:
    """Python's JSON: NaN and Infinity are written as such, as other programs do too."""
    return json.dumps(value).encode()
