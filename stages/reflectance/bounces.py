"""Light that skin sends to other skin, as a path tracer adds it: diffuse bounces between the vertices of a mesh.

E_0 direct,  E_k+1 = M a E_k,   M_ij = share of vertex i's cosine-weighted rays that end at vertex j
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline import meshes
from pipeline.ray_casting import RayCaster
from pipeline.tangents import any_across
from pipeline.transforms import F64
from stages.reflectance.texels import LIFT, Points

RAYS, BOUNCES = 48, 3
GOLDEN = np.pi * (3 - np.sqrt(5))


class Bounces:
    """Of a mesh whose vertices have the diffuse albedo (V, 3)."""

    def __init__(self, mesh: meshes.Mesh, caster: RayCaster, albedo: F64) -> None:
        self.albedo = albedo
        self.points = _vertices(mesh)
        self.matrix = _ends(mesh, caster, self.points)

    def of(self, direct: F64) -> F64:
        """(V, 3) irradiance by way of other vertices, of what arrives directly (V, 3)."""
        total, last = np.zeros_like(direct), direct
        for _ in range(BOUNCES):
            last = np.asarray(self.matrix @ (self.albedo * last), np.float64)
            total = total + last
        return total


def _vertices(mesh: meshes.Mesh) -> Points:
    every = np.arange(len(mesh.vertices))
    normal = meshes.unit(mesh.normals.astype(np.float64))
    return Points(0, every, every, np.ones((len(every), 3)) / 3, mesh.vertices.astype(np.float64), normal)


def _ends(mesh: meshes.Mesh, caster: RayCaster, points: Points) -> Any:
    """Sparse (V, V) M. A ray that meets the back of a triangle ends nowhere."""
    from scipy.sparse import coo_array

    count, n = len(points.texel), points.normal
    across = any_across(n)
    along = np.cross(n, across)
    start = points.position + LIFT * n
    facing = meshes.unit(meshes.area_vectors(mesh.vertices.astype(np.float64), mesh.faces))
    rows, columns = [], []
    for k in range(RAYS):
        u, turn = (k + 0.5) / RAYS, k * GOLDEN + np.arange(count) % 7  # neighbours' rays differ
        r, z = np.sqrt(u), np.sqrt(1 - u)
        way = r * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * along) + z * n
        face = caster.first_faces(start, way)
        hit = np.flatnonzero(face >= 0)
        hit = hit[(facing[face[hit]] * way[hit]).sum(1) < 0]
        rows.append(np.repeat(hit, 3))
        columns.append(mesh.faces[face[hit]].ravel())
    row, column = np.concatenate(rows), np.concatenate(columns)
    return coo_array((np.full(len(row), 1 / (3 * RAYS)), (row, column)), shape=(count, count)).tocsr()
