"""Which texel of a texture belongs to which triangle, in numpy.

Symbols
    size    texels along each side of the square texture
    x, y    texel coordinates: x = u size, y = (1 - v) size; a texel's centre is at +0.5, row 0 on top
    d       distance (texels) from a texel's centre to the triangle, 0 inside

Triangles are worked off in groups of similar extent, as small dense windows; a band of rows bounds the memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.meshes import Charts

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

WINDOW = 1_000_000  # texel candidates worked on at once


@dataclass(frozen=True, slots=True)
class Hits:
    """Texels and the triangle nearest to each: texel (N,) = row * size + column, ascending and unique; face (N,);
    weights (N, 3) barycentric of the triangle's point nearest to the texel's centre; distance (N,) texels."""

    texel: Indices
    face: Indices
    weights: F32
    distance: F32


def texel_corners(charts: Charts, size: int) -> F64:
    """(F, 3, 2) corners of the charts' triangles in texel coordinates."""
    uv = charts.uvs.astype(np.float64)[charts.faces]
    return np.stack([uv[..., 0] * size, (1 - uv[..., 1]) * size], -1)


def doubled_areas(corners: F64) -> F64:
    """(F,) twice the signed area, positive where the triangle turns the same way as from x to y."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    out: F64 = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out


def rasterise(corners: F64, size: int, first: int, last: int, reach: float = 0.75) -> Hits:
    """Texels of rows first..last-1 whose centre is at most `reach` texels from a triangle.

    With a reach of 0.71 or more every texel that a chart touches is among them. Where triangles compete, the nearest
    wins, then the one with the lower index.
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
    """(size, size) how many triangles hold each texel's centre, those nearer than `margin` texels to it left out.

    A texel with two of them lies under two places of the surface.
    """
    out = np.zeros(size * size, np.uint8)
    for faces, columns, rows in _windows(corners, size, 0, size, 0.0):
        x, y = columns + 0.5, rows + 0.5
        depth = np.full(x.shape, np.inf)
        sign = np.where(doubled_areas(corners[faces]) < 0, -1.0, 1.0)[:, None]
        for i in range(3):
            a, b = corners[faces, i], corners[faces, (i + 1) % 3]
            side = b - a
            length = np.maximum(np.hypot(side[:, 0], side[:, 1]), 1e-30)[:, None]
            cross = side[:, :1] * (y - a[:, 1:]) - side[:, 1:] * (x - a[:, :1])
            depth = np.minimum(depth, sign * cross / length)
        inside = (depth > margin) & (rows < size) & (columns < size)
        np.add.at(out, (rows * size + columns)[inside], 1)
    return out.reshape(size, size)


def _windows(
    corners: F64, size: int, first: int, last: int, reach: float
) -> Iterator[tuple[Indices, Indices, Indices]]:
    """Groups of triangles (G,) and the columns and rows (G, T) of the texels near each; some lie beyond the image."""
    low = np.floor(corners.min(1) - 0.5 - reach).astype(np.int64)
    high = np.ceil(corners.max(1) - 0.5 + reach).astype(np.int64) + 1
    low, high = np.maximum(low, [0, first]), np.minimum(high, [size, last])
    extent = high - low
    alive = np.flatnonzero((extent > 0).all(1))
    order = alive[np.lexsort((extent[alive, 1], extent[alive, 0]))]
    start = 0
    while start < len(order):
        stop, width, height = start, 0, 0
        # grow the group while its common window stays affordable and not much larger than its members need
        limit = min(len(order), start + 4096)
        wide = np.maximum.accumulate(extent[order[start:limit], 0])
        tall = np.maximum.accumulate(extent[order[start:limit], 1])
        count = np.arange(1, limit - start + 1)
        fits = wide * tall * count <= WINDOW
        stop = start + max(1, int(fits.sum()))
        width, height = int(wide[stop - start - 1]), int(tall[stop - start - 1])
        group = order[start:stop]
        dy, dx = (a.ravel() for a in np.mgrid[0:height, 0:width])
        columns, rows = low[group, :1] + dx, low[group, 1:] + dy
        beyond = (columns >= high[group, :1]) | (rows >= high[group, 1:])
        yield group, np.where(beyond, size, columns), np.where(beyond, size, rows)
        start = stop
