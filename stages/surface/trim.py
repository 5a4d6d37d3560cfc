"""Cuts off the surface that no photo shows.

Symbols: s share of a vertex's neighbourhood that photos see; the surface ends where s is 1/2.

Visibility is computed at vertices and smoothed, which removes specks and notches; small components and small holes are
removed. Triangles that the line s = 1/2 crosses are cut there. Every point of the border lies inside an edge, so that
no two parts of the surface touch in a point or along an edge.
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

WIDTH = 0.03  # of the mesh's longest side: about the width of the smoothing
ROUNDS = (24, 800)  # smallest and largest number of averaging steps
SMALL = 2e-3  # of the area: smaller holes are closed, smaller components dropped
MARGIN = 0.15  # of an edge: least distance of the border from its ends, to avoid slivers


@dataclass(frozen=True, slots=True)
class Trimmed:
    """The remaining mesh, and the share of the area that was cut off."""

    mesh: Mesh
    share: float


def trimmed(field: Field, grid: Lattice, mesh: Mesh, seen: Mask) -> Trimmed:
    """The closed mesh without the surface around vertices that are not `seen` (V,).

    Raises:
        StageError: no vertex is seen.
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
            remedy="check the cameras and masks (the report shows both), or set surface.unseen=closed",
        )
    x = mesh.vertices.astype(np.float64)
    ends, share, faces = cut(mesh.faces, s)
    border = clean.land(field, grid, x[ends[:, 0]] + share[:, None] * (x[ends[:, 1]] - x[ends[:, 0]]))
    vertices, faces, source = meshes.compact(np.concatenate([x, border.vertices]), faces)
    normals = np.concatenate([mesh.normals, border.normals])[source]
    before, after = (float(meshes.areas(v, f).sum()) for v, f in ((x, mesh.faces), (vertices, faces)))
    return Trimmed(Mesh(vertices.astype(np.float32), normals, faces), 1 - after / before)


def _evened(mesh: Mesh, seen: Mask) -> F64:
    """(V,) s, by a lazy random walk of n steps (it stays half of the time), which reaches sqrt(n / 2) edges far."""
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
    """s (V,) with small holes, then small components, moved to the other side of 1/2."""
    area = meshes.vertex_areas(mesh.vertices, mesh.faces)
    for side in (False, True):  # holes first: they must not split components
        piece = _pieces(mesh.faces, s >= 0.5)
        small = np.bincount(piece, area) < SMALL * area.sum()
        s = np.where(((s >= 0.5) == side) & small[piece], 1 - s - 1e-9 * side, s)
    return s


def _pieces(faces: Faces, inside: Mask) -> Indices:
    """(V,) component of each vertex, among vertices on the same side joined by edges."""
    a, b = meshes.edges(faces).T
    same = inside[a] == inside[b]
    n = len(inside)
    graph = coo_array((np.ones(int(same.sum()), np.int8), (a[same], b[same])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def cut(faces: Faces, s: F64) -> tuple[Indices, F64, Faces]:
    """The part of a closed mesh where s (V,) is at least 1/2.

    Returns the ends (B, 2) of the edges that the border crosses, from inside to outside; the position (B,) of the
    crossing between them; and faces, whose indices from V on are points of the border. No face uses vertices outside.
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
