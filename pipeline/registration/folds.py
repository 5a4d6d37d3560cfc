"""Where a deformed mesh of quads folds, and where it passes through itself.

Symbols: at corner i of a quad, J_i = (x_next - x_i) x (x_before - x_i), the corner's oriented area; J0 that of the
rest, turned by the quad's rotation.

    folded: J_i . J0_i < LEAST |J_i| |J0_i| at any corner, or a corner's angle close to 0 or 180 degrees
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, Faces, Indices, Mask, triangles_of, unique_edges
from pipeline.registration.crossing_kernels import crossing

LEAST = 0.1  # cosine between the corner's normal and that of the turned rest
SHORT = 0.05  # corner areas below this share of the rest's are degenerate


def folded_quads(rest: F64, now: F64, turn: F64, quads: Indices) -> Mask:
    """(Q,) quads that fold. rest, now (V, 3); turn (V, 3, 3) rotations from rest to now."""
    mean = turn[quads].mean(1)
    before, after = (_corners(x, quads) for x in (rest, now))
    wanted = np.einsum("qij,qcj->qci", mean, before)
    size = np.linalg.norm(wanted, axis=2)
    product = (after * wanted).sum(2)
    length = np.linalg.norm(after, axis=2)
    bad = (product < LEAST * length * size) | (length < SHORT * size)
    return np.asarray((bad & (size > 1e-3 * size.max())).any(1))


def _corners(x: F64, quads: Indices) -> F64:
    """(Q, 4, 3) oriented areas at the corners."""
    at = x[quads]
    return np.asarray(np.cross(np.roll(at, -1, axis=1) - at, np.roll(at, 1, axis=1) - at), np.float64)


def piercing_edges(vertices: F64, faces: Faces) -> Indices:
    """(N, 2) edges of triangles (F, 3) that pass through a triangle that they do not touch. Two triangles that cross do
    so at an edge of one of them. Coplanar overlaps are not found."""
    f, ends = np.asarray(faces, np.int64), unique_edges(faces)
    return np.asarray(ends[crossing(np.asarray(vertices, np.float64), f, ends)], np.int64)


def pierced_quads(points: F64, fine: Indices) -> Indices:
    """(Q,) number of piercing edges at each quad of the cage. points (M, 3), fine (16 Q, 4): of the second
    subdivision."""
    edges = piercing_edges(points, triangles_of(fine))
    hits = np.bincount(edges.ravel(), minlength=len(points))
    return np.asarray(hits[fine].reshape(-1, 64).sum(1), np.int64)
