"""A quarter to a third of a dense mesh's vertices, spread evenly, and values at all vertices from theirs.

What varies slowly over a mesh, as shadows do, need not be computed at every vertex of a fine one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array, diags_array, eye_array

from pipeline.meshes import Faces, Indices, Mask, unique_edges

MANY = 60_000  # vertices of a mesh above which it is thinned: about 1.5 mm apart on a head


@dataclass(frozen=True, slots=True)
class Thinned:
    """chosen (V,): no two are neighbours, and each other vertex has a chosen neighbour. weights (V, n) sparse: every
    vertex from the n chosen ones; itself, or the mean of its chosen neighbours."""

    chosen: Mask
    weights: csr_array

    def spread(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(V, ...) values at all vertices from those of the chosen ones (n, ...), in their order."""
        flat = self.weights @ np.ascontiguousarray(values).reshape(len(values), -1)
        return np.asarray(flat, np.float32).reshape(len(self.chosen), *values.shape[1:])


def thinned(count: int, faces: Faces, many: int = MANY) -> Thinned | None:
    """The thinned mesh of `count` vertices with triangles (F, 3); None if it has at most `many`: keep all.

    Vertices are taken in their order, each unless a neighbour was: on a subdivided mesh, whose old vertices come
    first, these are about the vertices of the level before.
    """
    if count <= many:
        return None
    ends = unique_edges(faces).T
    half = coo_array((np.ones(ends.shape[1], np.float32), tuple(ends)), shape=(count, count))
    graph = csr_array(half + half.T)
    chosen = _independent(graph.indptr, graph.indices, count)
    # a chosen vertex has no chosen neighbour, so that its only entry is itself
    own = csr_array(graph + eye_array(count, dtype=np.float32))[:, np.flatnonzero(chosen)]
    return Thinned(chosen, csr_array(diags_array(1 / own.sum(1)) @ own, dtype=np.float32))


def _independent(starts: Indices, neighbours: Indices, count: int) -> Mask:
    chosen, covered = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for v in range(count):
        if not covered[v]:
            chosen[v] = covered[v] = True
            covered[neighbours[starts[v] : starts[v + 1]]] = True
    return chosen
