"""Rasteriser: assigns the texels of a texture to triangles.

Symbols
    size    texels along each side of the square texture
    x, y    texel coordinates: x = u size, y = (1 - v) size; a texel's centre is at +0.5, row 0 on top
    d       distance (texels) from a texel's centre to the triangle, 0 inside

The loops over triangles are compiled (raster_kernels). Work on bands of rows limits the memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.meshes import Charts

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Hits:
    """Texels and the nearest triangle of each: texel (N,) = row * size + column, ascending and unique; face (N,);
    weights (N, 3) barycentric, of the triangle's point nearest to the texel's centre; distance (N,) texels."""

    texel: Indices
    face: Indices
    weights: F32
    distance: F32


def texel_corners(charts: Charts, size: int) -> F64:
    """(F, 3, 2) corners of the charts' triangles in texel coordinates."""
    return in_texels(charts.uvs.astype(np.float64)[charts.faces], size)


def in_texels(uv: F64, size: int) -> F64:
    """(..., 2) texture coordinates (..., 2) converted to texels."""
    return np.stack([uv[..., 0] * size, (1 - uv[..., 1]) * size], -1)


def doubled_areas(corners: F64) -> F64:
    """(F,) twice the signed area of triangles (F, 3, 2), positive for an orientation from x to y."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    out: F64 = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out


def rasterise(corners: F64, size: int, first: int, last: int, reach: float = 0.75) -> Hits:
    """Texels of rows first..last-1 whose centre is at most `reach` texels from a triangle of corners (F, 3, 2).

    A reach of 0.71 or more includes every texel that a chart touches. Of several triangles the nearest is taken, then
    the one with the lower index.
    """
    from pipeline import raster_kernels

    rows = last - first
    low, high = corners[..., 1].min(1) - 0.5 - reach, corners[..., 1].max(1) - 0.5 + reach
    candidates = np.flatnonzero((np.floor(low) < last) & (np.ceil(high) >= first))
    distance, face = np.full((rows, size), np.inf, np.float32), np.zeros((rows, size), np.int32)
    weights = np.zeros((rows, size, 3), np.float32)
    raster_kernels.nearest_triangles(corners, candidates, size, first, last, reach, distance, face, weights)
    near = np.isfinite(distance)
    texel = np.flatnonzero(near.ravel()) + first * size
    return Hits(texel, face[near].astype(np.int64), weights[near], distance[near])


def layers(corners: F64, size: int, margin: float = 1e-3) -> npt.NDArray[np.uint8]:
    """(size, size) number of triangles (F, 3, 2) that contain each texel's centre, at least `margin` texels inside.

    A texel with two of them belongs to two places on the surface.
    """
    from pipeline import raster_kernels

    out = np.zeros((size, size), np.uint8)
    raster_kernels.count_layers(corners, doubled_areas(corners), size, margin, out)
    return out
