"""Compiled loops of signed_distance.py."""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit


@njit(error_model="numpy", nogil=True, cache=True)
def sweep(distance, fixed):
    """One pass in each of the eight orders of the axes: Godunov's upwind scheme for |gradient| = 1, in place."""
    sx, sy, sz = distance.shape
    for order in range(8):
        for i in range(sx):
            x = i if order & 1 else sx - 1 - i
            for j in range(sy):
                y = j if order & 2 else sy - 1 - j
                for k in range(sz):
                    z = k if order & 4 else sz - 1 - k
                    if fixed[x, y, z]:
                        continue
                    a = min(distance[x - 1, y, z] if x > 0 else np.inf, distance[x + 1, y, z] if x < sx - 1 else np.inf)
                    b = min(distance[x, y - 1, z] if y > 0 else np.inf, distance[x, y + 1, z] if y < sy - 1 else np.inf)
                    c = min(distance[x, y, z - 1] if z > 0 else np.inf, distance[x, y, z + 1] if z < sz - 1 else np.inf)
                    distance[x, y, z] = min(distance[x, y, z], _upwind(a, b, c))


@njit(error_model="numpy", nogil=True, cache=True)
def _upwind(a, b, c):
    """d with sum max(d - a_i, 0)^2 = 1 over the values of the neighbours, infinite if all are."""
    a, b = min(a, b), max(a, b)
    if c < a:
        a, b, c = c, a, b
    elif c < b:
        b, c = c, b
    d = a + 1
    if d > b:
        d = 0.5 * (a + b + np.sqrt(max(2 - (a - b) ** 2, 0.0)))
        if d > c:
            s = a + b + c
            d = (s + np.sqrt(max(s * s - 3 * (a * a + b * b + c * c - 1), 0.0))) / 3
    return d
