"""More texels for the face: its charts are enlarged.

Symbols: F faces with true areas a. face: the part whose share is measured. region: somewhat more than the face; it may
become a chart of its own, so that the seam can be where it costs little (stages.uv.segment). s: scale (of lengths) of
the region's charts over that of the rest. p, q, A: areas of face, region and all, in the texture, because a chart
shrinks parts of the face.

    s^2 p / (s^2 q + A - q) = SHARE
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import meshes
from pipeline.faces.landmarks3d import head_frame
from pipeline.faces.oval import on_face
from pipeline.least_cut import ENDLESS, least_cut
from pipeline.meshes import F64, Charts, Faces, Indices, Mask, Mesh
from stages.uv.parameterise import signed_areas
from stages.uv.segment import FLOW, Dual, connected

SHARE = 0.42  # of the area under charts for the face: 0.40 is the goal, and texels on borders take some
MAX_SCALE = 5.0  # largest s: a head with shoulders needs 4; more would blur the rest for little gain
MIN_FACE = 0.25  # share of a chart that is face, from which it is enlarged
WIDER = 1.35  # size of the region's outline over that of the face's


@dataclass(frozen=True, slots=True)
class Front:
    """Masks (F,) of the triangles of the face, and of the region that its charts may cover."""

    face: Mask
    region: Mask


def front_of(mesh: Mesh, landmarks: F64 | None) -> Front | None:
    """The face on a mesh by its landmarks (468, 3); None if they are missing or not on the mesh."""
    if landmarks is None:
        return None
    area = meshes.area_vectors(mesh.vertices, mesh.faces)
    normals = meshes.unit(area)
    middle = mesh.vertices.astype(np.float64)[mesh.faces].mean(1)
    face = on_face(middle, normals, landmarks)
    centre = landmarks.mean(0)
    frame = head_frame(landmarks)
    across = np.diag([WIDER, WIDER, 1.0])  # larger seen from the front, not deeper
    wider = centre + (landmarks - centre) @ frame.axes.T @ across @ frame.axes
    region = face | on_face(middle, normals, wider)
    return Front(face, region) if face.any() else None


def face_parted(label: Indices, front: Front, pairs: Dual) -> Indices:
    """Pieces (F,) with the face as a piece of its own. Its seam is the cheapest between the face and the region's
    border. label (F,)."""
    most = min(FLOW, 2**30 / len(pairs.cost))  # sums must not overflow in the minimum cut
    cost = np.maximum(pairs.cost * (most / pairs.cost.max()), 1).astype(np.int32)
    pull = np.where(front.face, ENDLESS, np.where(front.region, 0, -ENDLESS)).astype(np.int32)
    own = least_cut(pairs.a, pairs.b, cost, pull)
    part = connected(np.where(own, 1, 0), pairs)
    main = part == int(np.bincount(part, front.face & own).argmax())
    return connected(np.where(main, int(label.max()) + 1, label), pairs)


def scale_for(front: Front, dense: Mask, area: F64) -> float:
    """s for charts of the faces `dense` (F,), at least 1. area (F,): in the texture."""
    face, part, total = (float(area[m].sum()) for m in (front.face & dense, dense, np.ones_like(dense)))
    left = face - SHARE * part
    wanted = np.inf if left <= 0 else SHARE * (total - part) / left
    return float(np.sqrt(np.clip(wanted, 1.0, MAX_SCALE**2)))


def dense_charts(label: Indices, front: Front, area: F64) -> Mask:
    """(C,) charts that are mostly in the region and contain enough of the face: a ring around it is not enlarged.
    label (F,) chart of each face; area (F,)."""
    whole = np.maximum(np.bincount(label, area), 1e-300)
    region, face = (np.bincount(label, np.where(m, area, 0.0)) for m in (front.region, front.face))
    return np.asarray((region > 0.5 * whole) & (face > MIN_FACE * whole))


def enlarged(uvs: F64, faces: Faces, label: Indices, front: Front, area: F64) -> F64:
    """uvs (U, 2) with the charts of the region enlarged. label: (F,) chart of each face; area: (F,) true."""
    dense = dense_charts(label, front, area)[label]
    of_vertex = np.ones(len(uvs))
    of_vertex[faces[dense].ravel()] = scale_for(front, dense, np.abs(signed_areas(uvs, faces)))
    return np.asarray(uvs * of_vertex[:, None], np.float64)


def face_share(charts: Charts, face: Mask) -> float:
    """Share of the area under charts that belongs to the face (F,)."""
    flat = np.abs(signed_areas(charts.uvs.astype(np.float64), charts.faces))
    return float(flat[face].sum() / max(float(flat.sum()), 1e-300))
