"""The surface without what no photo saw.

Symbols: s share of a vertex's surroundings that photos see; the surface ends where s is 1/2.

Seen and unseen are told apart at vertices and evened out over the neighbourhood, so that specks and notches go; pieces
and holes too small to matter are given to what surrounds them. Triangles that s = 1/2 runs through are cut there. Every
point of the border lies inside an edge, so that no two parts of the surface touch in a point or along an edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components

from pipeline import meshes
from pipeline.errors import StageError
from pipeline.fields.protocol import Field
from pipeline.meshes import F64, Faces, Indices, Mask, Mesh
from stages.surface import clean
from stages.surface.extract import Lattice

WIDTH = 0.03  # of the mesh's longest side: over about that far seen and unseen are evened out
ROUNDS = (24, 800)  # of averaging over neighbours, at least and at most
SMALL = 2e-3  # of the area: smaller holes are closed again, smaller pieces dropped
MARGIN = 0.15  # of an edge: the border keeps that far from its ends, or slivers would be left


@dataclass(frozen=True, slots=True)
class Trimmed:
    """What is left, and the share of the area that was cut off."""

    mesh: Mesh
    share: float


def trimmed(field: Field, grid: Lattice, mesh: Mesh, seen: Mask) -> Trimmed:
    """The closed mesh without the surface around vertices that are not `seen` (V,).

    Raises:
        StageError: nothing of it is seen.
    """
    s = _tidied(mesh, _evened(mesh, seen))
    if (s >= 0.5).all():
        return Trimmed(mesh, 0.0)
    if (s < 0.5).all():
        raise StageError(
            "no fitted photo sees the surface",
            where="surface.unseen",
            value="trimmed: nothing would be left",
            limit="a surface that photos see",
            remedy="check cameras and masks (the report shows both), or set surface.unseen=closed",
        )
    x = mesh.vertices.astype(np.float64)
    ends, share, faces = cut(mesh.faces, s)
    border = clean.land(field, grid, x[ends[:, 0]] + share[:, None] * (x[ends[:, 1]] - x[ends[:, 0]]))
    vertices, faces, source = meshes.compact(np.concatenate([x, border.vertices]), faces)
    normals = np.concatenate([mesh.normals, border.normals])[source]
    before, after = (float(meshes.areas(v, f).sum()) for v, f in ((x, mesh.faces), (vertices, faces)))
    return Trimmed(Mesh(vertices.astype(np.float32), normals, faces), 1 - after / before)


def _evened(mesh: Mesh, seen: Mask) -> F64:
    """(V,) s, by a random walk of n steps over neighbours that stays where it is half of the time: it goes sqrt(n / 2)
    edges far."""
    a, b = meshes.edges(mesh.faces).T
    n = len(seen)
    degree = np.maximum(np.bincount(a, minlength=n), 1)
    step = (coo_array((0.5 / degree[a], (a, b)), shape=(n, n)) + diags_array(np.full(n, 0.5))).tocsr()
    span = float(np.ptp(mesh.vertices, axis=0).max())
    edge = float(np.median(meshes.edge_lengths(mesh.vertices, mesh.faces)))
    s = seen.astype(np.float64)
    for _ in range(int(np.clip(2 * (WIDTH * span / edge) ** 2, *ROUNDS))):
        s = step @ s
    return np.asarray(s, np.float64)


def _tidied(mesh: Mesh, s: F64) -> F64:
    """s with small holes, then small pieces, on the other side of 1/2."""
    area = np.bincount(mesh.faces.ravel(), np.repeat(meshes.areas(mesh.vertices, mesh.faces) / 3, 3), len(s))
    for side in (False, True):  # holes first: they must not part pieces
        piece = _pieces(mesh.faces, s >= 0.5)
        small = np.bincount(piece, area) < SMALL * area.sum()
        s = np.where(((s >= 0.5) == side) & small[piece], 1 - s - 1e-9 * side, s)
    return s


def _pieces(faces: Faces, inside: Mask) -> Indices:
    """(V,) pieces of vertices on one side, joined by edges."""
    a, b = meshes.edges(faces).T
    same = inside[a] == inside[b]
    n = len(inside)
    graph = coo_array((np.ones(int(same.sum()), np.int8), (a[same], b[same])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def cut(faces: Faces, s: F64) -> tuple[Indices, F64, Faces]:
    """The part of a closed mesh where s (V,) is at least 1/2.

    Ends (B, 2) of the edges that the border crosses, from inside to outside, where it does (B,) between them, and
    faces: their indices from V on are points of the border. Vertices outside are in no face.
    """
    e = meshes.edges(faces)
    out = e[(s[e[:, 0]] >= 0.5) & (s[e[:, 1]] < 0.5)]
    code = np.sort(out[:, 0] * len(s) + out[:, 1])
    ends = np.stack(np.divmod(code, len(s)), 1)
    share = ((s[ends[:, 0]] - 0.5) / (s[ends[:, 0]] - s[ends[:, 1]])).clip(MARGIN, 1 - MARGIN)

    def point(inner: Indices, outer: Indices) -> Indices:
        return np.asarray(len(s) + np.searchsorted(code, inner * len(s) + outer), np.int64)

    f = np.asarray(faces, np.int64)
    inside = s[f] >= 0.5
    made = [f[inside.all(1)]]
    for i in range(3):
        a, b, c = f[:, i], f[:, (i + 1) % 3], f[:, (i + 2) % 3]
        only = inside[:, i] & (inside.sum(1) == 1)
        made.append(np.stack([a[only], point(a[only], b[only]), point(a[only], c[only])], 1))
        lost = ~inside[:, i] & (inside.sum(1) == 2)
        before, after = point(b[lost], a[lost]), point(c[lost], a[lost])
        made += [np.stack([b[lost], c[lost], after], 1), np.stack([b[lost], after, before], 1)]
    return ends, share, np.concatenate(made).astype(np.int32)
