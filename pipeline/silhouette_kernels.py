"""Compiled loops of silhouettes.py and hull.py: how far points are outside the silhouettes of views.

A view is a row of numbers: 0..11 rows of [R t], camera from world; 12..17 rows of the upper part of K; 18..22 k1 k2 p1
p2 k3; 23 focal length; 24, 25 width and height of the frame; 26 the largest radius on the plane z = 1 that its lens is
for, or infinity. shapes (V, 2): rows and columns of each grid of distances, starts (V,) its first number in
`distances`.

The lens is written out, as in visibility_kernels: what numba keeps on disk of a loop is not compiled again when a
function of another file changes.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

ONE, NEVER = np.float32(1.0), np.float32(-np.inf)
DECIDED_EVERY = 4  # views after which a point that is carved already is left


@njit(error_model="numpy", cache=True, inline="always")
def _outside(view, rows, columns, start, distances, x, y, z, reach):
    """Distance of a point outside a silhouette, whether the view sees all within `reach` of it, and any of that."""
    depth = view[8] * x + view[9] * y + view[10] * z + view[11]
    front = depth > 1e-9
    u, v = -1e9, -1e9
    if front:
        p = view[0] * x + view[1] * y + view[2] * z + view[3]
        q = view[4] * x + view[5] * y + view[6] * z + view[7]
        front = np.hypot(p, q) < view[26] * depth + reach
        a, b = p / depth, q / depth
        r2 = a * a + b * b
        radial = 1 + r2 * (view[18] + r2 * (view[19] + r2 * view[22]))
        s = a * radial + 2 * view[20] * a * b + view[21] * (r2 + 2 * a * a)
        t = b * radial + view[20] * (r2 + 2 * b * b) + 2 * view[21] * a * b
        u, v = view[12] * s + view[13] * t + view[14], view[15] * s + view[16] * t + view[17]
    else:
        depth = 1.0
    margin = reach * view[23] / depth
    left = min(min(u, v), min(view[24] - u, view[25] - v))  # distance to the nearest edge of the frame
    value = np.float32(_bilinear(distances, start, rows, columns, u / view[24], v / view[25]) * (depth / view[23]))
    return value, front and left >= margin, front and (left > -margin if reach > 0 else left >= 0)


@njit(error_model="numpy", cache=True, inline="always")
def _bilinear(image, start, h, w, u, v):
    """Value of (h, w) at a position in [0, 1] (right, down), clamped to the outermost pixels."""
    x, y = min(max(u * w - 0.5, 0.0), w - 1.001), min(max(v * h - 0.5, 0.0), h - 1.001)
    c, r = int(x), int(y)
    fx, fy = np.float32(x - c), np.float32(y - r)
    k = start + r * w + c
    top = image[k] * (ONE - fx) + image[k + 1] * fx
    return top * (ONE - fy) + (image[k + w] * (ONE - fx) + image[k + w + 1] * fx) * fy


@njit(parallel=True, error_model="numpy", cache=True)
def outside_one(points, view, rows, columns, distances, reach, value, whole, part):
    """`silhouettes.outside` of one view: value (N,), whole and part (N,) of points (N, 3)."""
    for n in prange(len(points)):
        value[n], whole[n], part[n] = _outside(
            view, rows, columns, 0, distances, points[n, 0], points[n, 1], points[n, 2], reach
        )


@njit(error_model="numpy", cache=True, inline="always")
def _insert(top, n, value):
    """Insert a value into column n of `top`, sorted in descending order, and drop the smallest."""
    for k in range(len(top)):
        old = top[k, n]
        top[k, n] = max(old, value)
        value = min(old, value)


@njit(parallel=True, error_model="numpy", cache=True)
def largest_outside(points, views, shapes, starts, distances, reach, far, sure, maybe, seen, glimpsed):
    """The largest distances of points (N, 3) outside the views' silhouettes, in descending order: sure (K, N) over the
    views that see all within `reach`, and maybe (K, N), where reach > 0, over those that see any of it; seen and
    glimpsed (N,): their numbers. A point whose last distance in `sure` is above `far` is left after the next
    DECIDED_EVERY views."""
    last = len(sure) - 1
    for n in prange(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for v in range(len(views)):
            value, whole, part = _outside(views[v], shapes[v, 0], shapes[v, 1], starts[v], distances, x, y, z, reach)
            seen[n] += whole
            glimpsed[n] += part
            _insert(sure, n, value if whole else NEVER)
            if reach > 0:
                _insert(maybe, n, value if part else NEVER)
            if v % DECIDED_EVERY == DECIDED_EVERY - 1 and sure[last, n] > far:
                break
