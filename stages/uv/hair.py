"""Hair as a mesh of its own: the outer shell of the fitted surface where the template stage tells hair.

Its faces are cut from the dense mesh along the told vertices; where they meet the skin they go on beneath it (tuck.py).
Small pieces beside the head that touch the hair belong to it. Hair and rest are decimated as one mesh and parted then.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes
from pipeline.artifacts import Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import F64, Mask, Mesh
from stages.uv.remainder import SMALL, cut_out

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

    A face belongs to the side whose dense face is nearest. Both sides end at the same vertices, so that no slit opens
    between them. rest, hair (F,): faces of the dense mesh.
    """
    from scipy.spatial import cKDTree

    known = np.flatnonzero(rest | hair)
    of_hair = hair[known[cKDTree(_centres(dense)[known]).query(_centres(mesh))[1]]]
    of_hair = _without_crumbs(mesh, np.asarray(of_hair, np.bool_))
    of_hair = ~_without_crumbs(mesh, ~of_hair)
    return _side(mesh, ~of_hair), _side(mesh, of_hair)


def _centres(mesh: Mesh) -> F64:
    return np.asarray(mesh.vertices[mesh.faces].mean(1), np.float64)


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
