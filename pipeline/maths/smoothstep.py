"""A smooth step between two values."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


def smoothstep(x: F64, low: float | F64, high: float | F64) -> F64:
    """0 up to low, 1 from high on, t^2 (3 - 2 t) between; low < high."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float64)
