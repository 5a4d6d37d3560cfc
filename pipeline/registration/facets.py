"""How far the vertices of a mesh of quads are raised so that its flat facets follow a smooth surface in the mean.

A mesh whose vertices lie on a convex surface lies inside of it everywhere else: its outline is too small, and what is
seen there of the photos is the background. Symbols: v_a, v_b the ends of an edge with unit normals n_a, n_b and length
l; m the surface's place half way between them; t a vertex's height. The mean square distance along the edges, by
Simpson's rule, is least:

    r = (m - (v_a + v_b) / 2) . unit(n_a + n_b)
    sum over edges of l (t_a^2 / 6 + 4/6 ((t_a + t_b) / 2 - r)^2 + t_b^2 / 6) -> min

The edges are the quads' sides and the diagonals from the first to the third corner that cut them into triangles.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import cg

from pipeline.meshes import F64, Indices, unit
from pipeline.registration.subdivision import edges_of

EXACT = 1e-6  # relative residual of the solve


def raised(points: F64, normals: F64, quads: Indices, finer: F64) -> F64:
    """(n,) heights t along normals (n, 3) of points (n, 3), in their unit. quads (Q, 4). finer (n + E + Q or
    more, 3): the surface after further steps of `subdivision.subdivided`, of which the first gives it at the vertices,
    the edges' middles and the quads' middles."""
    count = len(points)
    sides = edges_of(quads, count).ends
    ends = np.concatenate([sides, quads[:, [0, 2]]])
    middle = finer[count : count + len(ends)]
    if len(middle) < len(ends):
        raise ValueError(f"finer: {len(finer)} points, expected {count + len(ends)}: one step more than the quads")
    a, b = ends.T
    length = np.linalg.norm(points[a] - points[b], axis=1)
    r = ((middle - (points[a] + points[b]) / 2) * unit(normals[a] + normals[b])).sum(1)
    system = _system(ends, length, count)
    right = np.bincount(ends.ravel(), np.repeat(length * r / 3, 2), count)
    found, failed = cg(system, right, rtol=EXACT, atol=0.0)
    if failed:
        raise FloatingPointError("the heights of the facets do not converge: the mesh has edges of no length")
    return np.asarray(found)


def lifted(points: F64, normals: F64, quads: Indices, finer: F64) -> F64:
    """(n, 3) points, at their heights along the normals; as `raised` has them."""
    return np.asarray(points + raised(points, normals, quads, finer)[:, None] * normals)


def _system(ends: Indices, length: F64, count: int) -> csr_array:
    """(n, n) half of the second derivatives of the sum; 1 for vertices without an edge."""
    a, b = ends.T
    own = np.bincount(ends.ravel(), np.repeat(length / 3, 2), count)
    own[own == 0] = 1.0
    rows, columns = np.concatenate([a, b, np.arange(count)]), np.concatenate([b, a, np.arange(count)])
    return csr_array(coo_array((np.concatenate([length / 6, length / 6, own]), (rows, columns)), shape=(count, count)))
