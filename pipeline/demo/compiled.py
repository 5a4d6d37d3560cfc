"""Typed wrapper of numba: `compiled` compiles a function to machine code that releases the GIL."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile `function` on its first call; keep the result on disk where a cache folder is writable."""
    # Exact IEEE arithmetic (no fastmath): equal arguments must give equal bytes.
    try:
        return cast(Function, numba.njit(nogil=True, cache=True)(function))
    except RuntimeError:  # numba found no writable folder for its cache, for example in a read-only installation
        return cast(Function, numba.njit(nogil=True)(function))
