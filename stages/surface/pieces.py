"""Which of several pieces is the subject: the one that the photos show, and not simply the largest.

A shoulder that few photos see may have more area than the head that all of them look at. Each photo has one vote, which
it gives to the pieces by the share of its picture that they fill, behind its own mask and behind what lies in front.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Faces, Indices, Mesh
from pipeline.visibility import Occluder, View, view_cosines

WORTH_ASKING = 0.02  # of the largest piece's area: smaller ones are specks, whatever the photos see of them
MAX_VIEWS = 24  # that vote, spread evenly over all
MAX_POINTS = 20_000  # of the surface that are looked at

Votes = Callable[[Mesh, Indices], F64]  # of a mesh and the piece (F,) of each face: a share for each piece


def votes(mesh: Mesh, piece: Indices, views: Sequence[View], check: Callable[[], None]) -> F64:
    """(pieces,) mean share of the photos' pictures of the mesh that each piece fills; all 0 where no photo sees any.

    A point's part in a picture is its area times its cosine over the square of its distance.
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
    """The piece that is kept, and the share of the photos' pictures that goes with the others.

    piece (F,); area, solid (pieces,): pieces that face inwards are cavities and have no vote.
    """
    largest = int(area.argmax())
    asked = np.flatnonzero(solid & (area > WORTH_ASKING * area[largest]))
    if len(asked) < 2:
        return largest, 0.0
    some = np.isin(piece, asked)
    v, f, _ = meshes.compact(vertices, faces[some])
    mesh = Mesh(v.astype(np.float32), meshes.vertex_normals(v, f), f)
    share = vote(mesh, np.searchsorted(asked, piece[some]))
    if not share.any():
        return largest, 0.0
    best = int(share.argmax())
    return int(asked[best]), float(1 - share[best])
