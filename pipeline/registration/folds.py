"""Where a deformed mesh of quads folds, and where it passes through itself.

Symbols: at corner i of a quad, J_i = (x_next - x_i) x (x_before - x_i), the corner's oriented area; J0 that of the
rest, turned by the quad's rotation.

    folded: J_i . J0_i < LEAST |J_i| |J0_i| at any corner, or a corner's angle close to 0 or 180 degrees
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, Faces, Indices, Mask, area_vectors, triangles_of, unique_edges, unit
from pipeline.ray_casting import RayCaster

LEAST = 0.1  # cosine between the corner's normal and that of the turned rest
CLEAR = 0.02  # share of an edge at each end in which a hit is its own corner
GRAZING = 1e-4  # cosine: an edge in the plane of a triangle does not pierce it
PASSES = 4  # hits along an edge that are looked at
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
    f = np.asarray(faces, np.int64)
    ends = unique_edges(faces)
    caster = RayCaster(vertices, faces)
    way = vertices[ends[:, 1]] - vertices[ends[:, 0]]
    length = np.linalg.norm(way, axis=1)
    live = np.flatnonzero(length > 1e-6 * caster.span)
    direction = way / np.maximum(length, 1e-30)[:, None]
    at = CLEAR * length
    pierced, facing = np.zeros(len(ends), np.bool_), unit(area_vectors(vertices, faces))
    for _ in range(PASSES):
        start = vertices[ends[live, 0]] + at[live, None] * direction[live]
        far, hit = caster.hits(start, direction[live])
        at[live] += far
        near = at[live] < (1 - CLEAR) * length[live]
        live, hit = live[near], hit[near]
        own = (f[hit][:, :, None] == ends[live][:, None, :]).any((1, 2))
        own |= np.abs((facing[hit] * direction[live]).sum(1)) < GRAZING
        pierced[live[~own]] = True
        live = live[own]
        at[live] += CLEAR * length[live]
    return np.asarray(ends[pierced], np.int64)


def pierced_quads(points: F64, fine: Indices) -> Indices:
    """(Q,) number of piercing edges at each quad of the cage. points (M, 3), fine (16 Q, 4): of the second
    subdivision."""
    edges = piercing_edges(points, triangles_of(fine))
    hits = np.bincount(edges.ravel(), minlength=len(points))
    return np.asarray(hits[fine].reshape(-1, 64).sum(1), np.int64)
