"""A quarter to a third of a dense mesh's vertices, spread evenly, and values at all vertices from theirs.

What varies slowly over a mesh, as shadows do, need not be computed at every vertex of a fine one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array

from pipeline.meshes import Faces, Indices, Mask

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
    a, b = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    ones = np.ones(2 * len(a), np.float32)
    graph = coo_array((ones, (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(count, count)).tocsr()
    chosen = _independent(graph.indptr, graph.indices, count)
    graph.data[:] = 1.0
    own: Any = graph[:, np.flatnonzero(chosen)].tocsr()
    own = own.multiply(1 / np.maximum(own.sum(1), 1)[:, None]).tocsr()
    rows = np.flatnonzero(chosen)
    itself = coo_array((np.ones(len(rows), np.float32), (rows, np.arange(len(rows)))), shape=own.shape)
    return Thinned(chosen, csr_array(own + itself, dtype=np.float32))


def _independent(starts: Indices, neighbours: Indices, count: int) -> Mask:
    chosen, covered = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for v in range(count):
        if not covered[v]:
            chosen[v] = covered[v] = True
            covered[neighbours[starts[v] : starts[v + 1]]] = True
    return chosen
