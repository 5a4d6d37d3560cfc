"""A triangle mesh in patches of a few millimetres, joined where they touch: what is told about a surface is told of
patches, which are fewer than its vertices and of one size.

A patch is a connected part of the mesh inside one cell of a grid, so that two sheets that run through the same cell
are two patches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline import meshes
from pipeline.meshes import F64, Indices, Mask, Mesh


@dataclass(frozen=True, slots=True)
class Patches:
    """of_vertex (V,): the patch of each vertex of the mesh. where, normals (P, 3): mean places and unit normals; area
    (P,). a, b (E,): patches that touch, each pair once."""

    of_vertex: Indices
    where: F64
    normals: F64
    area: F64
    a: Indices
    b: Indices

    def mean(self, values: npt.NDArray[np.floating]) -> F64:
        """(P, ...) means of values (V, ...) over the vertices of each patch."""
        flat = np.asarray(values, np.float64).reshape(len(self.of_vertex), -1)
        count = np.bincount(self.of_vertex, minlength=len(self.where))
        total = np.stack([np.bincount(self.of_vertex, column, len(self.where)) for column in flat.T], 1)
        return np.asarray((total / count[:, None]).reshape(len(self.where), *np.shape(values)[1:]))

    def beside(self, inside: Mask) -> Mask:
        """(P,) patches outside of some (P,) that touch them."""
        out = np.zeros(len(inside), np.bool_)
        for a, b in ((self.a, self.b), (self.b, self.a)):
            out[a[inside[b]]] = True
        return out & ~inside


def patches_of(mesh: Mesh, size: float) -> Patches:
    """The patches of a mesh in cells of `size`, in the mesh's unit."""
    cell = np.floor((mesh.vertices.astype(np.float64) - mesh.vertices.min(0)) / size).astype(np.int64)
    key = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(0) + 1))
    ends, count = meshes.edges(mesh.faces).astype(np.int64), len(mesh.vertices)
    inside = ends[key[ends[:, 0]] == key[ends[:, 1]]]
    graph = coo_array((np.ones(len(inside), np.int8), tuple(inside.T)), shape=(count, count))
    total, of = connected_components(graph, directed=False)
    of = np.asarray(of, np.int64)
    share = meshes.areas(mesh.vertices, mesh.faces) / 3
    area = np.bincount(of[mesh.faces].ravel(), np.repeat(share, 3), total)
    pairs = np.sort(of[ends], 1)
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    none = np.zeros((total, 3))
    made = Patches(of, none, none, np.asarray(area, np.float64), pairs[:, 0], pairs[:, 1])
    where, normals = made.mean(mesh.vertices), made.mean(mesh.normals)
    return Patches(of, where, meshes.unit(normals), made.area, made.a, made.b)
