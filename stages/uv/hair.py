"""Hair as a mesh of its own: the outer shell of the fitted surface where the template stage tells hair.

Its faces are cut from the dense mesh along the told vertices; where they meet the skin they overlap it by about a
triangle, so that no gap shows. Small pieces beside the head that touch the hair belong to it.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes
from pipeline.artifacts import Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Mask, Mesh
from stages.uv.remainder import SMALL, cut_out


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


def hair_mesh(dense: Mesh, own: Mask) -> Mesh | None:
    """The hair's faces (F,) of the dense mesh as a mesh; None if there are none."""
    return cut_out(dense, dense.faces[own]) if own.any() else None
