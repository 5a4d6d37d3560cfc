"""Modules with one guard taken out: the proof that a test at the extremes would notice."""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def without(module: str, guard: str, unguarded: str) -> Iterator[types.ModuleType]:
    """A fresh copy of `module` in which every occurrence of `guard` reads `unguarded`. Fails if there is none."""
    original = importlib.import_module(module)
    source = Path(str(original.__file__)).read_text()
    if guard not in source:
        raise LookupError(f"{module} has no {guard!r} any more: the test of this guard is out of date")
    name = f"{module}__without_a_guard"
    copy = types.ModuleType(name)
    copy.__file__, copy.__package__ = original.__file__, original.__package__
    sys.modules[name] = copy  # dataclasses look their module up there
    try:
        exec(compile(source.replace(guard, unguarded), str(original.__file__), "exec"), copy.__dict__)
        yield copy
    finally:
        del sys.modules[name]
