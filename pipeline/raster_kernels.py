"""Compiled inner loops of the rasteriser."""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

STRIPE = 8  # rows per task of a thread


@njit(error_model="numpy", cache=True)
def _nearest(px, py, corner, inverse, weights):
    """Distance of a point to a triangle (3, 2), 0 inside. Writes the barycentric weights of the nearest point."""
    inside = inverse != 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        ax, ay = corner[j, 0] - px, corner[j, 1] - py
        bx, by = corner[k, 0] - px, corner[k, 1] - py
        weights[i] = (ax * by - ay * bx) * inverse
        inside = inside and weights[i] >= 0
    if inside:
        return 0.0
    best = np.inf
    w0, w1, w2 = 0.0, 0.0, 0.0
    for i in range(3):
        j = (i + 1) % 3
        sx, sy = corner[j, 0] - corner[i, 0], corner[j, 1] - corner[i, 1]
        ox, oy = px - corner[i, 0], py - corner[i, 1]
        t = min(max((ox * sx + oy * sy) / max(sx * sx + sy * sy, 1e-30), 0.0), 1.0)
        away = np.sqrt((ox - t * sx) ** 2 + (oy - t * sy) ** 2)
        if away < best:
            best = away
            w0, w1, w2 = 0.0, 0.0, 0.0
            if i == 0:
                w0, w1 = 1 - t, t
            elif i == 1:
                w1, w2 = 1 - t, t
            else:
                w2, w0 = 1 - t, t
    weights[0], weights[1], weights[2] = w0, w1, w2
    return best


@njit(parallel=True, error_model="numpy", cache=True)
def nearest_triangles(corners, candidates, size, first, last, reach, distance, face, weights):
    """For every texel of rows first..last-1 find the nearest triangle within `reach`; of equals, the first one.

    corners (F, 3, 2) texels; candidates (T,) ascending. Writes distance (R, size), inf where there is none; face
    (R, size); weights (R, size, 3).
    """
    rows = last - first
    for stripe in prange((rows + STRIPE - 1) // STRIPE):
        low, high = first + stripe * STRIPE, min(first + (stripe + 1) * STRIPE, last)
        part = slice(low - first, high - first)
        _stripe(corners, candidates, size, low, high, reach, distance[part], face[part], weights[part])


@njit(error_model="numpy", cache=True)
def _stripe(corners, candidates, size, first, last, reach, distance, face, weights):
    found = np.empty(3)
    for f in candidates:
        c = corners[f]
        top = max(first, int(np.floor(min(c[0, 1], c[1, 1], c[2, 1]) - 0.5 - reach)))
        bottom = min(last, int(np.ceil(max(c[0, 1], c[1, 1], c[2, 1]) - 0.5 + reach)) + 1)
        if top >= bottom:
            continue
        left = max(0, int(np.floor(min(c[0, 0], c[1, 0], c[2, 0]) - 0.5 - reach)))
        right = min(size, int(np.ceil(max(c[0, 0], c[1, 0], c[2, 0]) - 0.5 + reach)) + 1)
        doubled = (c[1, 0] - c[0, 0]) * (c[2, 1] - c[0, 1]) - (c[1, 1] - c[0, 1]) * (c[2, 0] - c[0, 0])
        inverse = 1.0 / doubled if abs(doubled) > 1e-12 else 0.0
        for row in range(top, bottom):
            r = row - first
            for column in range(left, right):
                if distance[r, column] == 0:
                    continue
                d = np.float32(_nearest(column + 0.5, row + 0.5, c, inverse, found))
                if d <= reach and d < distance[r, column]:
                    distance[r, column], face[r, column] = d, f
                    weights[r, column, 0], weights[r, column, 1], weights[r, column, 2] = found[0], found[1], found[2]


@njit(error_model="numpy", cache=True)
def count_layers(corners, doubled, size, margin, out):
    """Add 1 to out (size, size) at every texel centre that lies in a triangle and `margin` from its edges.

    corners (F, 3, 2) texels; doubled (F,) twice the signed areas. Counts stop at 255.
    """
    for f in range(len(corners)):
        c = corners[f]
        sign = -1.0 if doubled[f] < 0 else 1.0
        left = max(0, int(np.floor(min(c[0, 0], c[1, 0], c[2, 0]) - 0.5)))
        right = min(size, int(np.ceil(max(c[0, 0], c[1, 0], c[2, 0]) - 0.5)) + 1)
        top = max(0, int(np.floor(min(c[0, 1], c[1, 1], c[2, 1]) - 0.5)))
        bottom = min(size, int(np.ceil(max(c[0, 1], c[1, 1], c[2, 1]) - 0.5)) + 1)
        for row in range(top, bottom):
            for column in range(left, right):
                x, y = column + 0.5, row + 0.5
                inside = True
                for i in range(3):
                    ax, ay = c[i, 0], c[i, 1]
                    sx, sy = c[(i + 1) % 3, 0] - ax, c[(i + 1) % 3, 1] - ay
                    length = max(np.hypot(sx, sy), 1e-30)
                    if sign * (sx * (y - ay) - sy * (x - ax)) / length <= margin:
                        inside = False
                        break
                if inside and out[row, column] < 255:
                    out[row, column] += 1
