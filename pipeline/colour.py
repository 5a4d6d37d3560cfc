"""The only place where colour spaces are converted.

Radiance, albedo and every mean or sum of them are linear Rec.709. sRGB encoding appears in 8- and 16-bit files, and
in losses and metrics that compare as people see.

Source: IEC 61966-2-1.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")  # numpy.ndarray or torch.Tensor, any shape

LUMA = (0.2126, 0.7152, 0.0722)


def _namespace(x: Any) -> Any:
    if isinstance(x, np.ndarray | float | np.floating):
        return np
    import torch

    return torch


def srgb_from_linear(x: T) -> T:
    """Encode linear values. Domain: all reals; [0, 1] maps to [0, 1], negatives go on along the linear toe.

    Not clamped, so that a loss keeps its gradient above 1. The power's argument is kept above the toe's end, because
    its derivative at 0 is infinite and would reach the gradient through `where`.
    """
    xp: Any = _namespace(x)
    v: Any = x
    high = xp.clip(v, 0.0031308, None) if xp is np else v.clamp(min=0.0031308)
    out: T = xp.where(v <= 0.0031308, 12.92 * v, 1.055 * high ** (1 / 2.4) - 0.055)
    return out


def linear_from_srgb(x: T) -> T:
    """Decode sRGB values; inverse of `srgb_from_linear` on all reals."""
    xp: Any = _namespace(x)
    v: Any = x
    high = xp.clip(v, 0.04045, None) if xp is np else v.clamp(min=0.04045)
    out: T = xp.where(v <= 0.04045, v / 12.92, ((high + 0.055) / 1.055) ** 2.4)
    return out
