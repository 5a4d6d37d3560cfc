"""Splits charts that overlap themselves, until none does.

A chart of a crumpled surface may cover the same texels twice. One layer is kept. The faces of the others become charts
of their own, in connected pieces, and if these overlap again, face by face.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes, raster
from pipeline.meshes import F64, Charts, Faces, Indices, Mask

# barycentric positions that are tested in each face: centroid, near the corners, along the sides
PLACES = np.array([[1, 1, 1], [8, 1, 1], [1, 8, 1], [1, 1, 8], [4, 4, 1], [4, 1, 4], [1, 4, 4]], np.float64)
PLACES /= PLACES.sum(1, keepdims=True)


def folded(charts: Charts, size: int) -> Mask:
    """(F,) faces that are mirrored, or lie on texels that belong to another face. For one tile of `size` texels."""
    corners = raster.texel_corners(charts, size)
    mirrored = raster.doubled_areas(corners) > 0  # y points down in texels
    if mirrored.mean() > 0.5:
        mirrored = ~mirrored
    twice = raster.layers(corners, size).ravel() > 1
    if not twice.any():
        return mirrored
    owner = np.full(size * size, -1)
    hits = raster.rasterise(corners, size, 0, size)
    owner[hits.texel] = hits.face
    places = np.einsum("sc,fcx->fsx", PLACES, corners).astype(np.int64).clip(0, size - 1)
    texel = places[..., 1] * size + places[..., 0]
    lost = twice[texel] & (owner[texel] != np.arange(len(corners))[:, None])
    out: Mask = mirrored | lost.any(1)
    return out


def taken_apart(uvs: F64, faces: Faces, out: Mask) -> tuple[F64, Faces]:
    """Uvs (U', 2) and faces (F, 3) in which the faces of `out` (F,) share vertices only among themselves."""
    fresh, inverse = np.unique(faces[out], return_inverse=True)
    return _with(uvs, faces, out, uvs[fresh], inverse.reshape(-1, 3))


def one_by_one(uvs: F64, faces: Faces, out: Mask, corners: F64) -> tuple[F64, Faces]:
    """Uvs (U', 2) and faces (F, 3) in which each face of `out` (F,) is a chart of its own, without stretch; corners
    (F, 3, 3) in space."""
    a, b, c = corners[out].transpose(1, 0, 2)
    along = b - a
    length = np.linalg.norm(along, axis=1)
    x = along / np.maximum(length, 1e-30)[:, None]
    foot = ((c - a) * x).sum(1)
    height = np.linalg.norm(c - a - foot[:, None] * x, axis=1)
    zero = np.zeros(len(a))
    flat = np.stack([np.stack(p, 1) for p in ((zero, zero), (length, zero), (foot, height))], 1)
    return _with(uvs, faces, out, flat.reshape(-1, 2), np.arange(3 * len(flat)).reshape(-1, 3))


def _with(uvs: F64, faces: Faces, out: Mask, fresh: F64, own: Indices) -> tuple[F64, Faces]:
    split = faces.copy()
    split[out] = own + len(uvs)
    together, compacted, _ = meshes.compact(np.concatenate([uvs, fresh]), split)
    return np.asarray(together, np.float64), compacted
