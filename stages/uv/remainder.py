"""What the scan shows beside the registered template: clothes, shoulders, and hair where it is not told apart. It is a
mesh of its own, with charts on a tile of its own.

Symbols: p a vertex of the dense mesh, q the nearest of the head's skin with normal n. p is left over if it lies outside
(n . (p - q) >= OUT |p - q|) by more than AWAY, or if q is on the head's border (the neck's end). The parts overlap by
OVERLAP there, where the head lies beneath (pipeline/registration/neck.py).
Around an ear (AROUND_EARS from its skin) nothing is left over but hair: photos from the front leave a web of the visual
hull behind it, and the template has the back of an ear.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes
from pipeline.meshes import F32, F64, Mask, Mesh

AWAY = 0.003  # metres: nearer, the head's skin stands for it
OVERLAP = 0.0035  # metres over which the parts overlap at the neck's end; neck.OVERLAPPED is more
OUT = 0.5  # cosine: what is inside of the head, or beside a fold of it, is not left over
AROUND_EARS = 0.02  # metres
SMALL = 0.01  # of the dense mesh's area: a piece up to this size that touches hair is hair
CRUMB = 0.002  # of the same: smaller pieces are dropped; a fringe that stands off has .003


def left_over(dense: Mesh, beside: Mask, hair: Mask) -> Mask:
    """(F,) faces of the dense mesh with vertices beside (V,) the head, in large pieces. hair (F,): faces that are no
    part of it."""
    return _large(dense, np.asarray(beside[dense.faces].any(1) & ~hair, np.bool_))


def cut_out(dense: Mesh, faces: meshes.Faces) -> Mesh:
    """Faces (F', 3) of the dense mesh as a mesh in which no two fans share a vertex."""
    vertices, compact, rows = meshes.compact(dense.vertices, faces)
    parted, own = meshes.split_apart(np.asarray(vertices, np.float64), compact)
    normals = meshes.vertex_normals(parted, own)
    if len(parted) == len(rows):
        normals = dense.normals[rows]
    return Mesh(parted.astype(np.float32), normals, own)


def beside_head(dense: Mesh, skin: Mesh, ears: F32 | None = None, hair: Mask | None = None) -> Mask:
    """(V,) vertices of the dense mesh that the head's skin does not stand for. ears (n, 3): points of the skin; hair
    (V,): vertices that are hair."""
    from scipy.spatial import cKDTree

    points: F64 = dense.vertices.astype(np.float64)
    away, nearest = cKDTree(skin.vertices.astype(np.float64)).query(points)
    out = ((points - skin.vertices[nearest]) * skin.normals[nearest]).sum(1)
    border = _border(skin)
    beside = border[nearest] | ((away > AWAY) & (out >= OUT * away))
    if border.any():
        beside |= cKDTree(skin.vertices[border].astype(np.float64)).query(points)[0] < OVERLAP
    if ears is not None and len(ears):
        close = np.isfinite(cKDTree(ears).query(points, distance_upper_bound=AROUND_EARS)[0])
        beside &= ~close if hair is None else ~close | hair
    return np.asarray(beside, np.bool_)


def _border(mesh: Mesh) -> Mask:
    """(V,) vertices of the longest border: the neck's end, not those of eyes and mouth."""
    count = len(mesh.vertices)
    open_edges = meshes.open_edges(mesh.faces, count)
    out = np.zeros(count, np.bool_)
    if not len(open_edges):
        return out
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(open_edges), np.int8), tuple(open_edges.T)), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    length = np.linalg.norm(mesh.vertices[open_edges[:, 1]] - mesh.vertices[open_edges[:, 0]], axis=1)
    longest = np.bincount(label[open_edges[:, 0]], length).argmax()
    out[open_edges[label[open_edges[:, 0]] == longest].ravel()] = True
    return out


def _large(dense: Mesh, keep: Mask) -> Mask:
    """The faces keep (F,) whose connected piece is large enough."""
    out = keep.copy()
    if keep.any():
        faces = dense.faces[keep]
        piece = meshes.component_of_face(faces, len(dense.vertices))
        area = np.bincount(piece, meshes.areas(dense.vertices, faces))
        out[keep] = area[piece] > CRUMB * float(meshes.areas(dense.vertices, dense.faces).sum())
    return out
