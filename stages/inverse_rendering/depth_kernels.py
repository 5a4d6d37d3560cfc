"""Compiled inner loops over finished depth maps: consistency between views, and votes on the nodes of a grid.

Symbols as in stereo_kernels.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit


@njit(error_model="numpy", nogil=True, cache=True)
def agreeing(inverse, others, a, b, back_a, back_b, tolerance, pixels, count):
    """Adds 1 to count (H, W) for each other view whose depth map shows the same point.

    inverse (H, W): inverse depths, NaN where there is none; others: those of the other views. back_a, back_b: the pairs
    in the opposite direction. The depth there may differ by the share `tolerance`, and its point, projected back, must
    lie within `pixels`.
    """
    height, width = inverse.shape
    for y in range(height):
        for x in range(width):
            w = inverse[y, x]
            if not w > 0:
                continue
            u, v = x + 0.5, y + 0.5
            for k in range(len(others)):
                ak, bk, other = a[k], b[k], others[k]
                qz = ak[2, 0] * u + ak[2, 1] * v + ak[2, 2] + w * bk[2]
                if qz <= 1e-9:
                    continue
                px = (ak[0, 0] * u + ak[0, 1] * v + ak[0, 2] + w * bk[0]) / qz
                py = (ak[1, 0] * u + ak[1, 1] * v + ak[1, 2] + w * bk[1]) / qz
                c, r = int(np.floor(px)), int(np.floor(py))
                if r < 0 or c < 0 or r >= other.shape[0] or c >= other.shape[1]:
                    continue
                there = other[r, c]
                expected = w / qz  # z there is z here times qz
                if not there > 0 or abs(there - expected) > tolerance * expected:
                    continue
                ck, dk = back_a[k], back_b[k]
                bz = ck[2, 0] * px + ck[2, 1] * py + ck[2, 2] + there * dk[2]
                bx = (ck[0, 0] * px + ck[0, 1] * py + ck[0, 2] + there * dk[0]) / bz - u
                by = (ck[1, 0] * px + ck[1, 1] * py + ck[1, 2] + there * dk[1]) / bz - v
                if bx * bx + by * by <= pixels * pixels:
                    count[y, x] += 1


@njit(error_model="numpy", nogil=True, cache=True)
def integrate(points, matrix, K, inverse, slope, weight, band, distance, total):
    """Add one view's votes to points (N, 3): distance and weight sums (N,).

    matrix (3, 4) world to pixels; K (3, 3); inverse (H, W), slope (H, W, 2), weight (H, W) of the view. A point's
    distance is that to the plane of its pixel, positive in front of it, at most `band`; points further behind than that
    get no vote.
    """
    height, width = inverse.shape
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        qz = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
        if qz <= 1e-9:
            continue
        px = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / qz
        py = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / qz
        if not (px >= 0 and py >= 0 and px < width and py < height):
            continue
        c, r = int(px), int(py)
        w = inverse[r, c]
        if not w > 0 or weight[r, c] <= 0:
            continue
        gx, gy = slope[r, c, 0], slope[r, c, 1]
        w = w + gx * (px - c - 0.5) + gy * (py - r - 0.5)
        if not w > 0:
            continue
        # the plane is m . X = 1 in camera coordinates, m = K^T (gx, gy, w at the image's corner)
        corner = w - gx * px - gy * py
        m0, m1, m2 = gx * K[0, 0], gy * K[1, 1], gx * K[0, 2] + gy * K[1, 2] + corner
        size = np.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
        d = (1 - w * qz) / size
        facing = w / size  # cosine between the plane's normal and the ray, to a factor near 1
        if d < -band:
            continue
        share = weight[r, c] * min(max(facing, 0.1), 1.0)
        distance[i] += share * min(d, band)
        total[i] += share
