"""Hair as a mesh of its own: the outer shell of the fitted surface where the template stage tells hair.

Its faces are cut from the dense mesh along the told vertices; where they meet the skin they go on beneath it (rim.py).
Small pieces beside the head that touch the hair belong to it. Hair and rest are decimated as one mesh and parted then.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes
from pipeline.artifacts import Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import F64, Indices, Mask, Mesh
from stages.uv.remainder import SMALL, cut_out

NEAREST = 0.1  # of an edge, between its end and a cut
CRUMB = 12  # faces: a smaller piece on the other side of the border between hair and rest goes to that side


def hair_vertices(head: Located[RegisteredHead], count: int) -> Mask | None:
    """(V,) vertices of the fitted surface that are hair; None if there is none. count: V."""
    ref = head.artifact.hair
    if ref is None:
        return None
    with np.load(head.path(ref), allow_pickle=False) as z:
        told = np.asarray(z["hair"], np.bool_)
    if len(told) != count:
        raise ValueError(f"hair is told of {len(told)} vertices, the fitted surface has {count}")
    return told


def hair_faces(dense: Mesh, told: Mask, beside: Mask) -> Mask:
    """(F,) faces of the dense mesh that are hair. told (V,); beside (V,): vertices that the head does not stand for."""
    own = np.asarray(told[dense.faces].any(1), np.bool_)
    other = np.flatnonzero(beside[dense.faces].any(1) & ~own)
    if not len(other):
        return own
    faces = dense.faces[other]
    piece = meshes.component_of_face(faces, len(dense.vertices))
    area = np.bincount(piece, meshes.areas(dense.vertices, faces))
    at_hair = np.zeros(len(dense.vertices), np.bool_)
    at_hair[dense.faces[own]] = True
    touches = np.bincount(piece, at_hair[faces].any(1)) > 0
    small = area <= SMALL * float(meshes.areas(dense.vertices, dense.faces).sum())
    own[other[(small & touches)[piece]]] = True
    return own


def parted(mesh: Mesh, dense: Mesh, rest: Mask, hair: Mask) -> tuple[Mesh | None, Mesh | None]:
    """The decimated mesh of what is beside the head as two, the rest and hair; None for one that has no faces.

    It is cut where the nearest faces of both, given as rest, hair (F,) of the dense mesh, are equally far. Both sides
    end at the same vertices, so that no slit opens between them.
    """
    from scipy.spatial import cKDTree

    if not hair.any() or not rest.any():
        return (None, mesh) if hair.any() else (mesh, None)
    points, centres = mesh.vertices.astype(np.float64), dense.vertices[dense.faces].mean(1).astype(np.float64)
    away = [cKDTree(centres[part]).query(points)[0] for part in (rest, hair)]
    mesh, of_hair = cut_at_zero(mesh, away[0] - away[1])
    of_hair = _without_crumbs(mesh, of_hair)
    of_hair = ~_without_crumbs(mesh, ~of_hair)
    return _side(mesh, ~of_hair), _side(mesh, of_hair)


def cut_at_zero(mesh: Mesh, value: F64) -> tuple[Mesh, Mask]:
    """The mesh with its triangles cut where `value` (V,), linear over each, is 0; and the faces where it is positive.
    Cuts are at least NEAREST of an edge away from its ends, so that no sliver is left."""
    side = value > 0
    pairs = meshes.unique_edges(mesh.faces)
    pairs = pairs[side[pairs[:, 0]] != side[pairs[:, 1]]]
    a, b = pairs.T
    t = (value[a] / (value[a] - value[b])).clip(NEAREST, 1 - NEAREST)[:, None]
    between = [((1 - t) * x[a] + t * x[b]).astype(np.float32) for x in (mesh.vertices, mesh.normals)]
    count = len(mesh.vertices)
    keys = a * count + b  # sorted, as the edges are

    def middle(p: Indices, q: Indices) -> Indices:
        return np.asarray(count + np.searchsorted(keys, np.minimum(p, q) * count + np.maximum(p, q)), np.int64)

    inside = side[mesh.faces].sum(1)
    cut = (inside == 1) | (inside == 2)
    some = mesh.faces[cut].astype(np.int64)
    lone = (side[some] == (inside[cut] == 1)[:, None]).argmax(1)  # the corner that is alone on its side
    p, q, r = (some[np.arange(len(some)), (lone + k) % 3] for k in range(3))
    pq, pr = middle(p, q), middle(p, r)
    tips, bases = np.stack([p, pq, pr], 1), np.concatenate([np.stack([pq, q, r], 1), np.stack([pq, r, pr], 1)])
    faces = np.concatenate([mesh.faces[~cut], tips, bases]).astype(np.int32)
    positive = np.concatenate([inside[~cut] == 3, side[p], np.tile(side[q], 2)])
    vertices = np.concatenate([mesh.vertices, between[0]])
    normals = np.concatenate([mesh.normals, meshes.unit(between[1]).astype(np.float32)])
    return Mesh(vertices, normals, faces), positive


def _without_crumbs(mesh: Mesh, side: Mask) -> Mask:
    """side (F,) without its connected pieces of fewer than CRUMB faces that touch the other side."""
    out = side.copy()
    if side.any():
        faces = mesh.faces[side]
        piece = meshes.component_of_face(faces, len(mesh.vertices))
        at_other = np.zeros(len(mesh.vertices), np.bool_)
        at_other[mesh.faces[~side]] = True
        touches = np.bincount(piece, at_other[faces].any(1)) > 0
        out[side] = ~((np.bincount(piece) < CRUMB) & touches)[piece]
    return out


def _side(mesh: Mesh, own: Mask) -> Mesh | None:
    return cut_out(mesh, mesh.faces[own]) if own.any() else None
