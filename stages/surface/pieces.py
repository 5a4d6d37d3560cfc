"""Chooses the connected component that is the subject: the one that the photos show most of, not the largest.

A shoulder in few photos may have more area than the head in all of them. Each photo has one vote. It is divided among
the components by the area that each fills in the photo, inside the mask and where nothing hides it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Faces, Indices, Mesh
from pipeline.visibility import FittedPhoto, Occluder, view_cosines

MIN_AREA = 0.02  # of the largest component's area: smaller ones are specks and get no votes
MAX_VIEWS = 24  # photos that vote, evenly spaced
MAX_POINTS = 20_000  # points of the surface that are tested

Votes = Callable[[Mesh, Indices], F64]  # mesh, component (F,) of each face -> share of each component


def votes(mesh: Mesh, piece: Indices, views: Sequence[FittedPhoto], check: Callable[[], None]) -> F64:
    """(pieces,) share of the votes of each component; all 0 if no photo sees any.

    A point's area in a photo is its area on the surface times the cosine over the squared distance.
    """
    count = int(piece.max()) + 1
    total = np.zeros(count)
    step = -(-len(mesh.faces) // MAX_POINTS)
    faces = np.arange(0, len(mesh.faces), step)
    vectors = meshes.area_vectors(mesh.vertices, mesh.faces[faces])
    centre = mesh.vertices.astype(np.float64)[mesh.faces[faces]].mean(1)
    area, normal = np.linalg.norm(vectors, axis=1), meshes.unit(vectors)
    occluder = Occluder(mesh)
    for i in np.unique(np.linspace(0, len(views) - 1, min(MAX_VIEWS, len(views))).astype(int)) if views else ():
        check()
        cosine, _ = view_cosines(views[i], centre, normal, occluder)
        away = centre - np.asarray(views[i].camera.world_from_cam, np.float64)[:3, 3]
        filled = np.bincount(piece[faces], area * cosine / (away * away).sum(1), count)
        total += filled / max(float(filled.sum()), 1e-30)
    return np.asarray(total / max(float(total.sum()), 1e-30), np.float64)


def chosen(
    vertices: F64, faces: Faces, piece: Indices, area: F64, solid: meshes.Mask, vote: Votes
) -> tuple[int, float]:
    """The component that is kept, and the share of the votes of the others.

    piece (F,); area, solid (pieces,). Components that face inwards (not solid) are cavities and get no votes.
    """
    largest = int(area.argmax())
    candidates = np.flatnonzero(solid & (area > MIN_AREA * area[largest]))
    if len(candidates) < 2:
        return largest, 0.0
    some = np.isin(piece, candidates)
    v, f, _ = meshes.compact(vertices, faces[some])
    mesh = Mesh(v.astype(np.float32), meshes.vertex_normals(v, f), f)
    share = vote(mesh, np.searchsorted(candidates, piece[some]))
    if not share.any():
        return largest, 0.0
    best = int(share.argmax())
    return int(candidates[best]), float(1 - share[best])
