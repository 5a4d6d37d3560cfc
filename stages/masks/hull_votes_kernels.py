"""Compiled loop of hull_votes.py: which places on a pixel's ray the other photos show as background.

A view is a row of numbers: 0..11 rows of [R t], camera from world; 12..17 rows of the upper part of K, for the small
mask; 18..22 k1 k2 p1 p2 k3; 23 the largest squared radius on the plane z = 1 that its lens is for.

The lens is written out, as in visibility_kernels: what numba keeps on disk of a loop is not compiled again when a
function of another file changes.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit


@njit(error_model="numpy", cache=True, inline="always")
def _position(view, x, y, z):
    """Column and row of a point in a view's mask; -1, -1 behind the camera or outside of what its lens is for."""
    depth = view[8] * x + view[9] * y + view[10] * z + view[11]
    if not depth > 1e-9:
        return -1.0, -1.0
    a = (view[0] * x + view[1] * y + view[2] * z + view[3]) / depth
    b = (view[4] * x + view[5] * y + view[6] * z + view[7]) / depth
    r2 = a * a + b * b
    if r2 > view[23]:
        return -1.0, -1.0
    radial = 1 + r2 * (view[18] + r2 * (view[19] + r2 * view[22]))
    s = a * radial + 2 * view[20] * a * b + view[21] * (r2 + 2 * a * a)
    t = b * radial + view[20] * (r2 + 2 * b * b) + 2 * view[21] * a * b
    return view[12] * s + view[13] * t + view[14], view[15] * s + view[16] * t + view[17]


@njit(error_model="numpy", cache=True)
def _contradicting(views, shapes, starts, outside, skip, fewest, forgiven, best, x, y, z):
    """The share of the views that show a point as background, less `forgiven` views that may be wrong; -1 where fewer
    than `fewest` views see it. Once it must be above `best`, counting ends and `best` is returned."""
    seen, against = 0, 0
    for v in range(len(views)):
        if v == skip:
            continue
        u, w = _position(views[v], x, y, z)
        column, row = int(np.floor(u)), int(np.floor(w))
        if column < 0 or row < 0 or row >= shapes[v, 0] or column >= shapes[v, 1]:
            continue
        seen += 1
        if outside[starts[v] + row * shapes[v, 1] + column]:
            against += 1
            if against - forgiven >= best * len(views):
                return best
    if seen < fewest:
        return -1.0
    return max(against - forgiven, 0) / seen


@njit(nogil=True, error_model="numpy", cache=True)  # photos are worked on side by side in threads
def least_contradicting(origin, directions, near, far, step, plane, views, shapes, starts, outside, skip, fewest, few,
                        forgiven, most, enough, least):  # fmt: skip
    """Write to least (N,) the smallest share over the places on each ray, `most` if all are larger; a ray ends at the
    first share up to `enough`, and is 0 where it misses the inner sphere.

    The place that was best on the ray before is asked first: neighbours see the same surface, and a small share lets
    all other places be left early. Then from the place nearest to the world's origin outwards.

    origin (3,), directions (N, 3) unit. near, far: radii of two spheres: in the inner one a place that fewer than
    `fewest` views see counts as 0, between the two one that fewer than `few` see does not count; step: between two
    places.
    plane (4,): normal and offset of what the subject stands on; places beneath it are not the subject's. views (V, 24);
    shapes (V, 2) rows and columns of each mask, starts (V,) its first byte in outside (bytes,), 1 where a pixel is
    clearly background. skip: the view of the rays, -1 if it has no vote.
    """
    first = 0
    for i in range(len(directions)):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        middle = -(dx * origin[0] + dy * origin[1] + dz * origin[2])
        away = origin[0] ** 2 + origin[1] ** 2 + origin[2] ** 2 - middle * middle
        least[i] = 0.0
        if not near * near > away:
            continue
        best, inner, half = most, np.sqrt(near * near - away), np.sqrt(far * far - away)
        places, before = 2 * int(half / step) + 1, first
        for n in range(-1, places):
            k = before if n < 0 else n
            if k >= places or (n >= 0 and k == before):
                continue
            along = middle + step * ((k + 1) // 2) * (1 - 2 * (k % 2))
            if not along > 0:
                continue
            x, y, z = origin[0] + along * dx, origin[1] + along * dy, origin[2] + along * dz
            if plane[0] * x + plane[1] * y + plane[2] * z < plane[3]:
                continue
            known = abs(along - middle) <= inner
            share = _contradicting(
                views, shapes, starts, outside, skip, fewest if known else few, forgiven, best, x, y, z
            )
            share = max(share, 0.0) if known or share >= 0 else best
            if share < best:
                best, first = share, k
            if best <= enough:
                break
        least[i] = best
