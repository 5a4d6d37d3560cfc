"""Compiled: a picture between its pixels."""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

BEYOND = 0.2  # of the nearest pixels' range: cubic overshoot is cut there


@njit(error_model="numpy", cache=True)
def _weight(x):
    """Catmull-Rom's kernel at distance x >= 0 from a pixel's centre."""
    if x < 1:
        return 1.5 * x * x * x - 2.5 * x * x + 1
    return -0.5 * x * x * x + 2.5 * x * x - 4 * x + 2 if x < 2 else 0.0


@njit(parallel=True, error_model="numpy", cache=True)
def cubic(picture, uv, out):
    """out (N, 3): values of a picture (H, W, 3) at positions uv (N, 2), pixels from its corner, by cubic interpolation
    with little overshoot. Positions outside take the border's."""
    rows, columns = picture.shape[:2]
    for n in prange(len(uv)):
        u = min(max(uv[n, 0] - 0.5, 0.0), columns - 1.0)
        v = min(max(uv[n, 1] - 0.5, 0.0), rows - 1.0)
        left, top = int(np.floor(u)), int(np.floor(v))
        for c in range(3):
            total, low, high = 0.0, np.inf, -np.inf
            for dy in range(-1, 3):
                y = min(max(top + dy, 0), rows - 1)
                wy = _weight(abs(v - (top + dy)))
                for dx in range(-1, 3):
                    x = min(max(left + dx, 0), columns - 1)
                    value = picture[y, x, c]
                    total += wy * _weight(abs(u - (left + dx))) * value
                    if 0 <= dx <= 1 and 0 <= dy <= 1:
                        low, high = min(low, value), max(high, value)
            reach = BEYOND * (high - low)
            out[n, c] = min(max(total, low - reach), high + reach)
