"""Full precision inside a network that runs in half precision.

Products of radiance (up to 1e5) with harmonics that nearly cancel lose all their digits in bfloat16, and autocast would
use it for every matrix product. The functions of this package disable it: networks may run in half precision, the
physics runs in float32.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
T = TypeVar("T")
HALVES = (torch.float16, torch.bfloat16)


def full_precision(function: Callable[P, T]) -> Callable[P, T]:
    """The function with its half-precision arguments raised to float32 and autocast off."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        raised: Any = [raise_half(a) for a in args]
        named: Any = {k: raise_half(v) for k, v in kwargs.items()}
        kind = next((a.device.type for a in raised if isinstance(a, Tensor)), "cpu")
        if not torch.is_autocast_enabled(kind):
            return function(*raised, **named)
        with torch.autocast(kind, enabled=False):
            return function(*raised, **named)

    return run


def raise_half(value: Any) -> Any:
    """A half-precision tensor as float32; anything else as it is."""
    return value.float() if isinstance(value, Tensor) and value.dtype in HALVES else value
