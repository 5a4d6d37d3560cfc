"""Compiled search for the nearest point on triangles.

Source: Ericson, Real-Time Collision Detection (2005), section 5.1.5.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

TIE = 1e-12  # of two triangles at the same distance (a point over their common edge), the first candidate is taken


@njit(error_model="numpy", cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(error_model="numpy", cache=True)
def _weights(p, a, b, c):
    """Barycentric weights of the point of the triangle a, b, c that is nearest to p. Triangles without area are edges,
    or a point."""
    ab, ac = b - a, c - a
    ap, bp, cp = p - a, p - b, p - c
    d1, d2, d3, d4, d5, d6 = _dot(ab, ap), _dot(ac, ap), _dot(ab, bp), _dot(ac, bp), _dot(ab, cp), _dot(ac, cp)
    if d1 <= 0 and d2 <= 0:
        return 1.0, 0.0, 0.0
    if d3 >= 0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    if d6 >= 0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0 and d1 > d3:
        v = d1 / (d1 - d3)
        return 1.0 - v, v, 0.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0 and d2 > d6:
        w = d2 / (d2 - d6)
        return 1.0 - w, 0.0, w
    va = d3 * d6 - d5 * d4
    along, back = d4 - d3, d5 - d6
    if va <= 0 and along >= 0 and back >= 0 and along + back > 0:
        w = along / (along + back)
        return 0.0, 1.0 - w, w
    total = va + vb + vc
    if total <= 0:
        return 1.0, 0.0, 0.0
    return va / total, vb / total, vc / total


@njit(parallel=True, error_model="numpy", cache=True)
def nearest_on_triangles(points, corners, candidates, face, weights):
    """For each point (N, 3) the nearest of its candidate triangles (N, K), indices into corners (F, 3, 3). Writes face
    (N,) and the barycentric weights (N, 3) of the nearest point on it."""
    for i in prange(len(points)):
        p, best = points[i], np.inf
        for k in range(candidates.shape[1]):
            f = candidates[i, k]
            a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
            u, v, w = _weights(p, a, b, c)
            away = u * a + v * b + w * c - p
            distance = np.sqrt(_dot(away, away))
            if distance < best - TIE:
                best = distance
                face[i] = f
                weights[i, 0], weights[i, 1], weights[i, 2] = u, v, w
