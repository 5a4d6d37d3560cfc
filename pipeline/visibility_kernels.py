"""Compiled loop of visibility.py: which points face a camera and lie inside its photo.

Symbols as in transforms.py; the camera is a row of numbers: 0..11 rows of [R t], camera from world; 12..17 rows of the
upper part of K; 18..22 k1 k2 p1 p2 k3; 23..25 centre; 26, 27 columns and rows of the photo.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(parallel=True, error_model="numpy", cache=True)
def facing(camera, points, normals, cosine, uv):
    """Write the cosine (N,) between each point's normal and the direction to the camera, 0 where it is negative or
    where the point is not inside the photo, and the position (N, 2) in the photo of the others, in pixels.

    points, normals (N, 3). Positions are those of transforms.project; they are not written where the cosine is 0.
    """
    for i in prange(len(points)):
        cosine[i] = 0.0
        dx, dy, dz = camera[23] - points[i, 0], camera[24] - points[i, 1], camera[25] - points[i, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        found = dx / length * normals[i, 0] + dy / length * normals[i, 1] + dz / length * normals[i, 2]
        if not found > 0:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
        if not depth > 1e-9:
            continue
        a = (camera[0] * x + camera[1] * y + camera[2] * z + camera[3]) / depth
        b = (camera[4] * x + camera[5] * y + camera[6] * z + camera[7]) / depth
        r2 = a * a + b * b
        radial = 1 + r2 * (camera[18] + r2 * (camera[19] + r2 * camera[22]))
        s = a * radial + 2 * camera[20] * a * b + camera[21] * (r2 + 2 * a * a)
        t = b * radial + camera[20] * (r2 + 2 * b * b) + 2 * camera[21] * a * b
        u = camera[12] * s + camera[13] * t + camera[14]
        v = camera[15] * s + camera[16] * t + camera[17]
        if u >= 0 and v >= 0 and u < camera[26] and v < camera[27]:
            cosine[i], uv[i, 0], uv[i, 1] = found, u, v
