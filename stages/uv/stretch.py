"""How much a texture is stretched over the surface.

Symbols
    J       2 x 3 -> the map from texture to surface of one triangle; columns S_u, S_v
    L2      sqrt((S_u . S_u + S_v . S_v) / 2), root mean square stretch of a triangle [Sander 2001, section 3]
    Linf    larger singular value of J: the largest stretch in any direction

Both relative to the mean scale: the texture counts as scaled so that both areas are equal; 1 for an isometry.
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64

STRETCHED = 4.0  # Linf of a triangle from which it counts as stretched


def stretches(corners: F64, texture: F64) -> tuple[F64, F64, F64]:
    """(N,) L2 and Linf of triangles with corners (N, 3, 3) and texture (N, 3, 2), and their areas (N,). The triangles
    have an area in the texture; else their stretch is infinite or not a number."""
    x, t = corners, texture
    e1, e2, d1, d2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    twice: F64 = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    s_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) / twice[:, None]
    s_v = (e2 * d1[:, :1] - e1 * d2[:, :1]) / twice[:, None]
    square = 0.5 * ((s_u * s_u).sum(1) + (s_v * s_v).sum(1))
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    scale = 0.5 * np.abs(twice).sum() / area.sum()
    # singular values of J: those of J^T J by its trace and determinant
    determinant = (s_u * s_u).sum(1) * (s_v * s_v).sum(1) - (s_u * s_v).sum(1) ** 2
    larger = square + np.sqrt(np.maximum(square * square - determinant, 0))
    return np.sqrt(square * scale), np.sqrt(larger * scale), area
