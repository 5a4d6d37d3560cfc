"""A registered head: its control cage, texture layout and displacement, as one file.

Symbols: V vertices of the cage, Q quads, n vertices after `levels` subdivisions; limit points p and normals N of the
subdivided cage. displacement (n,): metres from p along N to the fitted surface; 0 where none is near or nobody saw it.
seen (n,): 0 to 1, how well the photos show that place.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.meshes import F32, F64, Indices, Mask
from pipeline.registration.subdivision import Level, edges_of, limit, subdivided
from pipeline.template.model import LEFT_OUT


@dataclass(frozen=True)  # no slots: the surface is kept
class Head:
    """vertices (V, 3) asset coordinates; quads (Q, 4); uvs (U, 2), uv_quads (Q, 4): UDIM tiles in one row; region, part
    (Q,): index into the names of the artifact; displacement, seen (n,); levels ()."""

    vertices: F64
    quads: Indices
    uvs: F64
    uv_quads: Indices
    region: Indices
    part: Indices
    displacement: F32
    seen: F32
    levels: int

    def fine(self) -> Level:
        """The subdivided cage."""
        return subdivided(self.quads, len(self.vertices), self.levels)

    def surface(self) -> tuple[F64, F64, Indices]:
        """Limit points (n, 3), unit normals (n, 3) and quads (Q 4^levels, 4), without displacement."""
        return self._surface

    @cached_property
    def _surface(self) -> tuple[F64, F64, Indices]:
        return limit_surface(self.vertices, self.fine())

    def displaced(self) -> F64:
        """(n, 3) the limit points, moved along their normals by the displacement."""
        points, normals, _ = self._surface
        return np.asarray(points + self.displacement[:, None].astype(np.float64) * normals)

    def finer(self) -> F64:
        """(n + E + Q 4^levels, 3) displaced points after one more subdivision, E the edges of the fine quads: at their
        vertices, the edges' middles, the quads' middles. The displacement is linear between the vertices."""
        quads, moved = self.surface()[2], self.displacement.astype(np.float64)
        points, normals, _ = limit_surface(self.vertices, subdivided(self.quads, len(self.vertices), self.levels + 1))
        ends = edges_of(quads, len(moved)).ends
        heights = np.concatenate([moved, moved[ends].mean(1), moved[quads].mean(1)])
        return np.asarray(points + heights[:, None] * normals)

    def fine_uvs(self) -> tuple[F64, Indices]:
        """(U', 2) texture coordinates and quads (Q 4^levels, 4), linear along the borders of charts."""
        level = subdivided(self.uv_quads, len(self.uvs), self.levels, "sharp")
        return np.asarray(level.stencil @ self.uvs), level.quads

    def save(self, path: Path) -> None:
        """Write the npz."""
        np.savez(path, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})  # type: ignore[arg-type]


def kept_quads(head: Head, regions: tuple[str, ...]) -> Mask:
    """(Q,) quads of the cage that the asset shows. regions: names that head.region refers to."""
    return np.asarray(np.array([n not in LEFT_OUT for n in regions])[head.region], np.bool_)


def of_triangles(head: Head, of_quad: Indices, regions: tuple[str, ...]) -> Indices:
    """(F,) values of the cage's quads, of_quad (Q,), at the triangles that the textured mesh has of the head."""
    return np.asarray(np.repeat(of_quad[kept_quads(head, regions)], 2 * 4**head.levels), np.int64)


def load_head(path: Path) -> Head:
    """The head of an npz that `save` wrote."""
    with np.load(path, allow_pickle=False) as z:
        arrays = {f.name: z[f.name] for f in fields(Head) if f.name != "levels"}
        return Head(**arrays, levels=int(z["levels"]))


def limit_surface(vertices: F64, level: Level) -> tuple[F64, F64, Indices]:
    """Limit points (n, 3), unit normals (n, 3) and quads of the cage's vertices (V, 3) after the steps of level."""
    points = np.asarray(level.stencil @ vertices)
    at = limit(level.quads, len(points))
    return np.asarray(at.point @ points), at.normals(points), level.quads
