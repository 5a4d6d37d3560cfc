"""The fitted surface as the registration sees it: places with normals and how well the photos show them.

Symbols: p a point of the template with unit normal n; y the nearest vertex of the surface, m its unit normal. A pair
counts if y is near, n . m is at least COMPATIBLE, and photos see y. Where the surface is hair, d is how far beneath it
the skin lies at least: there a pair counts, seen or not, only if p is outside of y - d m, and that is its place.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Indices, Mask, Mesh, unit
from pipeline.ray_casting import RayCaster

COMPATIBLE = 0.5  # least cosine between the normals: 60 degrees


@dataclass(frozen=True, slots=True)
class Pairs:
    """Of N points: where (N, 3), normals (N, 3) of the nearest place; distance (N,) to it; weight (N,) 0 to 1 of how
    well it is seen, 0 where the pair does not count; hair (N,): whether the place is under hair."""

    where: F64
    normals: F64
    distance: F64
    weight: F64
    hair: Mask


@dataclass(frozen=True, slots=True)
class Scan:
    """mesh: the fitted surface, in any unit. seen (V,): sum of cosines towards the photos that see a vertex, 0 for
    hair. beneath (V,): d, 0 where the surface is skin; None: everywhere."""

    mesh: Mesh
    seen: F64
    beneath: F64 | None = None
    _tree: cKDTree = field(init=False)
    _caster: RayCaster = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.mesh.vertices.astype(np.float64)))
        object.__setattr__(self, "_caster", RayCaster(self.mesh.vertices, self.mesh.faces))

    def shown_as(self, seen: F64, beneath: F64 | None = None) -> Scan:
        """The same surface, seen otherwise; its trees, which take a second to build, serve both."""
        other = copy(self)
        object.__setattr__(other, "seen", seen)
        object.__setattr__(other, "beneath", beneath)
        return other

    def pairs(self, points: F64, normals: F64, reach: float) -> Pairs:
        """The nearest places of the surface to points (N, 3) with unit normals (N, 3), at most `reach` away."""
        away, nearest = self._tree.query(points, distance_upper_bound=reach)
        found = np.isfinite(away)
        nearest = np.where(found, nearest, 0)
        where = self.mesh.vertices[nearest].astype(np.float64)
        there = unit(self.mesh.normals[nearest])
        facing = (there * normals).sum(1) >= COMPATIBLE
        weight = np.minimum(self.seen[nearest], 1.0)
        hair = np.zeros(len(points), np.bool_)
        if self.beneath is not None:
            deep = self.beneath[nearest]
            hair, where = deep > 0, where - deep[:, None] * there
            weight = np.where(hair, ((points - where) * there).sum(1) > 0, weight)
        weight = np.where(found & facing, weight, 0.0)
        plane = np.abs(((points - where) * there).sum(1))
        return Pairs(where, there, np.where(found, plane, np.inf), weight, hair)

    def nearest(self, points: F64) -> tuple[F64, F64]:
        """(N, 3) nearest vertex of the surface to points (N, 3), and (N,) its distance."""
        away, row = self._tree.query(points)
        return self.mesh.vertices[row].astype(np.float64), np.asarray(away)

    def along(self, points: F64, normals: F64, reach: float) -> tuple[F64, F64]:
        """(N,) signed distance from points (N, 3) along unit normals (N, 3) to the surface, NaN where it is further
        than reach or faces otherwise; (N,) how well the place is seen, 0 to 1."""
        signed, face = self._along(points, normals, reach)
        seen = self.seen[self.mesh.faces[face]].mean(1)
        return signed, np.where(np.isfinite(signed), np.minimum(seen, 1.0), 0.0)

    def _along(self, points: F64, normals: F64, reach: float) -> tuple[F64, Indices]:
        """The same distance, and (N,) the face that is met."""
        signed, face = np.full(len(points), np.nan), np.zeros(len(points), np.int64)
        best = np.full(len(points), reach)
        lift = 1e-5 * self._caster.span
        for side in (1.0, -1.0):
            start = points - lift * side * normals  # a point on the surface itself is found too
            far, hit = self._caster.hits(start, side * normals)
            far = far - lift
            rows = np.flatnonzero(np.abs(far) < best)
            rows = rows[(self._face_normals(hit[rows]) * normals[rows]).sum(1) >= COMPATIBLE]
            best[rows], signed[rows], face[rows] = np.abs(far[rows]), side * far[rows], hit[rows]
        return signed, face

    def over(self, points: F64, normals: F64, reach: float) -> F64:
        """(N,) how far points (N, 3) would have to sink against unit normals (N, 3) to lie d beneath the hair; 0 where
        they do, or where no hair is within reach along the normal."""
        if self.beneath is None:
            return np.zeros(len(points))
        signed, face = self._along(points, normals, reach)
        deep = self.beneath[self.mesh.faces[face]].min(1)
        return np.where(np.isfinite(signed) & (deep > 0), np.maximum(deep - np.nan_to_num(signed), 0), 0.0)

    def _face_normals(self, faces: Indices) -> F64:
        corners = self.mesh.vertices[self.mesh.faces[faces]].astype(np.float64)
        return unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
