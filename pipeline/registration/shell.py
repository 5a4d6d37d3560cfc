"""The head's outer shell: a closed mesh without the inside of the mouth and of the eye sockets, and its signed distance
on a grid.

Symbols: V vertices of the template; F triangles; the borders that the left-out quads and the neck leave are closed by
fans around their middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.meshes import F32, F64, Faces, Indices, Mask, area_vectors, triangles_of, unit
from pipeline.ray_casting import RayCaster
from pipeline.template.model import SKIN, Template

INSIDE = ("mouth_inside", "sockets")  # regions that the shell leaves out, if the template has them
EXACT_CELLS = 3.0  # cells around the surface in which the distance is that to the surface, else to the nearest node
MAX_HITS = 32  # surfaces that a line through a head crosses
JITTER = 1e-4  # cells: rays do not run exactly through vertices


@dataclass(frozen=True, slots=True)
class Shell:
    """faces (F, 3) into the template's vertices and the caps' middles, which follow them. quad (F,): the template's
    quad of each triangle, -1 for a cap. loops: vertices of each border, in order; the first is the longest (the
    neck)."""

    faces: Faces
    quad: Indices
    loops: tuple[Indices, ...]

    def vertices(self, vertices: F64) -> F64:
        """(V + caps, 3): the template's vertices (V, 3) and the middles of the caps."""
        return np.concatenate([vertices, *(vertices[loop].mean(0)[None] for loop in self.loops)])


def outer_shell(template: Template) -> Shell:
    """The skin's outside, closed."""
    left_out = [template.regions[name] for name in INSIDE if name in template.regions]
    keep = np.setdiff1d(template.parts[SKIN], np.concatenate(left_out) if left_out else np.zeros(0, np.int64))
    quads = template.quads[keep]
    loops = border_loops(quads)
    caps = fans(loops, len(template.vertices))
    quad = np.concatenate([np.repeat(keep, 2), np.full(sum(map(len, caps)), -1)])
    return Shell(np.concatenate([triangles_of(quads), *caps]).astype(np.int32), quad.astype(np.int64), tuple(loops))


def fans(loops: Sequence[Indices], count: int) -> list[Indices]:
    """Triangles that close each loop around its middle, which is vertex count, count + 1, ..."""
    return [np.stack([np.roll(b, -1), b, np.full(len(b), count + i)], 1) for i, b in enumerate(loops)]


def border_loops(quads: Indices) -> list[Indices]:
    """Closed loops of the borders of quads (Q, 4), each in the direction of its quads; the longest first."""
    a, b = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    known = set(zip(a.tolist(), b.tolist(), strict=True))
    following = {i: j for i, j in known if (j, i) not in known}
    loops = []
    while following:
        first, loop = next(iter(following)), []
        at = first
        while at in following:
            loop.append(at)
            at = following.pop(at)
        loops.append(np.array(loop, np.int64))
    return sorted(loops, key=len, reverse=True)


@dataclass(frozen=True, slots=True)
class ShellDistance:
    """values (X, Y, Z): signed distance at lo + cell (i, j, k), negative inside; face (X, Y, Z): triangle of the shell
    near the node's nearest point."""

    values: F32
    face: Indices


def shell_distance(vertices: F64, faces: Faces, lo: F64, cell: float, shape: tuple[int, int, int]) -> ShellDistance:
    """Signed distance to a closed mesh: vertices (V, 3), faces (F, 3); lo (3,), cell in the same unit.

    Within EXACT_CELLS cells it is the distance to the tangent plane of the nearest of many surface points; further away
    the distance to the nearest of these nodes is added, which may be too large by a cell.
    """
    inside = contained(vertices, faces, lo, cell, shape)
    away = np.where(inside, ndimage.distance_transform_edt(inside), ndimage.distance_transform_edt(~inside)) - 0.5
    points, normals, of = _samples(vertices, faces, cell)
    near = np.argwhere(away < EXACT_CELLS)
    values = (np.where(inside, -away, away) * cell).astype(np.float32)
    owner = np.zeros(shape, np.int64)
    if len(near):
        x = lo + cell * near
        _, nearest = cKDTree(points).query(x, workers=-1)
        plane = ((x - points[nearest]) * normals[nearest]).sum(1)
        at = tuple(near.T)
        values[at] = np.where(np.sign(plane) == np.sign(values[at]), plane, values[at])
        owner[at] = of[nearest]
    index = ndimage.distance_transform_edt(away >= EXACT_CELLS, return_distances=False, return_indices=True)
    return ShellDistance(values, owner[tuple(index)])


def contained(vertices: F64, faces: Faces, lo: F64, cell: float, shape: tuple[int, int, int]) -> Mask:
    """(X, Y, Z) nodes inside a closed mesh: those with an odd number of surfaces before them along x."""
    caster = RayCaster(vertices, faces)
    y, z = np.meshgrid(np.arange(shape[1]), np.arange(shape[2]), indexing="ij")
    origin = np.stack([np.full(y.size, -1.0), y.ravel() + JITTER, z.ravel() + 2 * JITTER], 1) * cell + lo
    origin[:, 0] = min(float(lo[0]), float(vertices[:, 0].min())) - cell
    direction = np.broadcast_to([1.0, 0.0, 0.0], origin.shape).copy()
    crossed = np.zeros((len(origin), shape[0]), np.int16)
    nodes, live, lift = lo[0] + cell * np.arange(shape[0]), np.arange(len(origin)), 1e-6 * caster.span
    start = origin.copy()
    for _ in range(MAX_HITS):
        far = caster.distances(start[live], direction[live])
        live, far = live[np.isfinite(far)], far[np.isfinite(far)]
        if not len(live):
            break
        start[live, 0] += far + lift
        crossed[live] += nodes > start[live, :1]
    odd = (crossed % 2 == 1).reshape(shape[1], shape[2], shape[0])
    return np.ascontiguousarray(np.moveaxis(odd, 2, 0))


def _samples(vertices: F64, faces: Faces, spacing: float) -> tuple[F64, F64, Indices]:
    """Points of the surface at most about `spacing` apart, their normals and triangles."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    normal = unit(area_vectors(vertices, faces))
    points, of = [], []
    pieces = np.clip(np.ceil(longest / spacing).astype(int), 1, 64)
    for n in np.unique(pieces):
        rows = np.flatnonzero(pieces == n)
        i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        i, j = i[i + j < n], j[i + j < n]
        weights = np.stack([3 * i + 1, 3 * j + 1, 3 * (n - i - j) - 2], 1) / (3 * n)
        points.append(np.einsum("sc,rcx->rsx", weights, corners[rows]).reshape(-1, 3))
        of.append(np.repeat(rows, len(weights)))
    owner = np.concatenate(of)
    return np.concatenate(points), normal[owner], owner
