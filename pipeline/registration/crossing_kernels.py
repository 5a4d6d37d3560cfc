"""Compiled search for edges of a triangle mesh that pass through its triangles.

Symbols: an edge from p along the unit direction d over the length L; a triangle with corners q0, q1, q2 and unit normal
m. They cross where p + t d = q0 + u (q1 - q0) + v (q2 - q0) with u, v, 1 - u - v >= 0 and CLEAR L < t < (1 - CLEAR) L.

Each triangle is written into the cells of a regular grid that its box touches; an edge is compared with the triangles
of the cells that its own box touches.

Source: Moeller and Trumbore, Fast, minimum storage ray-triangle intersection (1997).
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.meshes import F64, Indices, Mask

CLEAR = 0.02  # share of an edge at each end in which a hit is its own corner
GRAZING = 1e-4  # cosine: an edge in the plane of a triangle does not pierce it
CELL = 2.0  # of the edges' median length
MOST_CELLS = 128  # along each side of the grid
INSIDE = 1e-12  # of barycentric coordinates: an edge through the side that two triangles share meets one of them


def crossing(vertices: F64, faces: Indices, ends: Indices) -> Mask:
    """(E,) whether the edge between vertices ends (E, 2) passes through one of the triangles faces (F, 3) that has none
    of its ends. vertices (V, 3)."""
    if not len(faces) or not len(ends):
        return np.zeros(len(ends), np.bool_)
    corners = vertices[faces]
    boxes = np.concatenate([corners.min(1), corners.max(1)], 1)
    low, high = boxes[:, :3].min(0), boxes[:, 3:].max(0)
    span = max(float((high - low).max()), 1e-300)
    length = np.linalg.norm(vertices[ends[:, 1]] - vertices[ends[:, 0]], axis=1)
    cell = max(CELL * float(np.median(length)), span / MOST_CELLS)
    cells = ((boxes - np.tile(low, 2)) / cell).astype(np.int64)
    shape = cells[:, 3:].max(0) + 1
    start, entry = _grid(cells, shape)
    live = np.flatnonzero(length > 1e-6 * span)
    out = np.zeros(len(ends), np.bool_)
    out[live] = _crossing(vertices, faces, boxes, ends[live], low, cell, shape, start, entry)
    return out


@njit(error_model="numpy", cache=True)
def _grid(cells, shape):
    """start (cells + 1,) of each cell's part of entry (n,), the triangles in it. cells (F, 6): the first and the last
    cell of each triangle's box."""
    count = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    for f in range(len(cells)):
        for x in range(cells[f, 0], cells[f, 3] + 1):
            for y in range(cells[f, 1], cells[f, 4] + 1):
                for z in range(cells[f, 2], cells[f, 5] + 1):
                    count[(x * shape[1] + y) * shape[2] + z + 1] += 1
    start = np.cumsum(count)
    entry, filled = np.empty(start[-1], np.int64), start[:-1].copy()
    for f in range(len(cells)):
        for x in range(cells[f, 0], cells[f, 3] + 1):
            for y in range(cells[f, 1], cells[f, 4] + 1):
                for z in range(cells[f, 2], cells[f, 5] + 1):
                    at = (x * shape[1] + y) * shape[2] + z
                    entry[filled[at]] = f
                    filled[at] += 1
    return start, entry


@njit(error_model="numpy", cache=True)
def _cell(at, low, cell, count):
    return min(max(int((at - low) / cell), 0), count - 1)


@njit(error_model="numpy", cache=True)
def _crossing(vertices, faces, boxes, ends, low, cell, shape, start, entry):
    out = np.zeros(len(ends), np.bool_)
    for e in range(len(ends)):
        i, j = ends[e, 0], ends[e, 1]
        x0, x1 = min(vertices[i, 0], vertices[j, 0]), max(vertices[i, 0], vertices[j, 0])
        y0, y1 = min(vertices[i, 1], vertices[j, 1]), max(vertices[i, 1], vertices[j, 1])
        z0, z1 = min(vertices[i, 2], vertices[j, 2]), max(vertices[i, 2], vertices[j, 2])
        for x in range(_cell(x0, low[0], cell, shape[0]), _cell(x1, low[0], cell, shape[0]) + 1):
            for y in range(_cell(y0, low[1], cell, shape[1]), _cell(y1, low[1], cell, shape[1]) + 1):
                for z in range(_cell(z0, low[2], cell, shape[2]), _cell(z1, low[2], cell, shape[2]) + 1):
                    at = (x * shape[1] + y) * shape[2] + z
                    for n in range(start[at], start[at + 1]):
                        f = entry[n]
                        if out[e] or boxes[f, 0] > x1 or boxes[f, 3] < x0 or boxes[f, 1] > y1 or boxes[f, 4] < y0:
                            continue
                        if boxes[f, 2] > z1 or boxes[f, 5] < z0:
                            continue
                        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                        if i in (a, b, c) or j in (a, b, c):
                            continue
                        out[e] = _meets(vertices, i, j, a, b, c)
    return out


@njit(error_model="numpy", cache=True)
def _meets(vertices, i, j, a, b, c):
    """Whether the edge from vertex i to j passes through the triangle of vertices a, b, c."""
    wx, wy, wz = (vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2])
    ux, uy, uz = (vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2])
    vx, vy, vz = (vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2])
    sx, sy, sz = (vertices[i, 0] - vertices[a, 0], vertices[i, 1] - vertices[a, 1], vertices[i, 2] - vertices[a, 2])
    mx, my, mz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx  # the triangle's normal
    along, square = mx * wx + my * wy + mz * wz, mx * mx + my * my + mz * mz
    if abs(along) <= GRAZING * np.sqrt(square * (wx * wx + wy * wy + wz * wz)):
        return False
    t = -(mx * sx + my * sy + mz * sz) / along
    if not CLEAR < t < 1 - CLEAR:
        return False
    rx, ry, rz = sx + t * wx, sy + t * wy, sz + t * wz  # the place from a
    u = (mx * (ry * vz - rz * vy) + my * (rz * vx - rx * vz) + mz * (rx * vy - ry * vx)) / square
    v = (mx * (uy * rz - uz * ry) + my * (uz * rx - ux * rz) + mz * (ux * ry - uy * rx)) / square
    return u >= -INSIDE and v >= -INSIDE and u + v <= 1 + INSIDE
