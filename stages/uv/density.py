"""More texels for the face: its charts are larger than those of the rest.

Symbols: F faces with true areas a; face: what is measured; region: what may be cut out as a chart of its own, somewhat
more than the face, so that the seam around it lies where it costs little (stages.uv.segment); s how much
larger, in length, a chart of the region is than one of the rest; p, q, A areas of face, region and all, in the texture,
since a chart that lies flat makes some of the face smaller than it is.

    s^2 p / (s^2 q + A - q) = SHARE
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.faces.landmarks3d import head_frame
from pipeline.faces.oval import on_face
from pipeline.least_cut import ENDLESS, least_cut
from pipeline.meshes import F64, Charts, Faces, Indices, Mask, Mesh
from stages.uv.segment import FLOW, Dual, connected

SHARE = 0.42  # of the area under charts for the face: 0.40 is promised, and texels on borders take some
MAX_SCALE = 5.0  # s at most: a head with shoulders needs 4; beyond, the rest would be blurred for little
SHOWS = 0.25  # share of a chart that is face, from which on it is enlarged
WIDER = 1.35  # the region's outline over the face's, from the middle of the face


@dataclass(frozen=True, slots=True)
class Front:
    """(F,) faces of the face, and of the region that its charts may be made of."""

    face: Mask
    region: Mask


def front_of(mesh: Mesh, landmarks: F64 | None) -> Front | None:
    """The face on a mesh by its landmarks (468, 3); None where they are not known or not on it."""
    if landmarks is None:
        return None
    area = meshes.area_vectors(mesh.vertices, mesh.faces)
    normals = meshes.unit(area)
    middle = mesh.vertices.astype(np.float64)[mesh.faces].mean(1)
    face = on_face(middle, normals, landmarks)
    centre = landmarks.mean(0)
    frame = head_frame(landmarks)
    across = np.diag([WIDER, WIDER, 1.0])  # wider as seen from the front, no deeper
    wider = centre + (landmarks - centre) @ frame.axes.T @ across @ frame.axes
    region = face | on_face(middle, normals, wider)
    return Front(face, region) if face.any() else None


def face_parted(label: Indices, front: Front, pairs: Dual) -> Indices:
    """Pieces (F,) with the face as one of its own: its seam is the cheapest between face and the region's border."""
    most = min(FLOW, 2**30 / len(pairs.cost))  # sums stay below what the cut can count
    cost = np.maximum(pairs.cost * (most / pairs.cost.max()), 1).astype(np.int32)
    pull = np.where(front.face, ENDLESS, np.where(front.region, 0, -ENDLESS)).astype(np.int32)
    own = least_cut(pairs.a, pairs.b, cost, pull)
    part = connected(np.where(own, 1, 0), pairs)
    main = part == int(np.bincount(part, front.face & own).argmax())
    return connected(np.where(main, int(label.max()) + 1, label), pairs)


def scale_for(front: Front, dense: Mask, area: F64) -> float:
    """s for charts of the faces `dense`, at least 1."""
    face, part, total = (float(area[m].sum()) for m in (front.face & dense, dense, np.ones_like(dense)))
    left = face - SHARE * part
    wanted = np.inf if left <= 0 else SHARE * (total - part) / left
    return float(np.sqrt(np.clip(wanted, 1.0, MAX_SCALE**2)))


def dense_charts(label: Indices, front: Front, area: F64) -> Mask:
    """(C,) charts that are mostly of the region and show enough of the face: a ring around it is not enlarged."""
    whole = np.maximum(np.bincount(label, area), 1e-300)
    region, face = (np.bincount(label, np.where(m, area, 0.0)) for m in (front.region, front.face))
    return np.asarray((region > 0.5 * whole) & (face > SHOWS * whole))


def enlarged(uvs: F64, faces: Faces, label: Indices, front: Front, area: F64) -> F64:
    """uvs (U, 2) with the charts of the region enlarged. label: (F,) chart of each face; area: (F,) true."""
    dense = dense_charts(label, front, area)[label]
    of_vertex = np.ones(len(uvs))
    of_vertex[faces[dense].ravel()] = scale_for(front, dense, flat_areas(uvs, faces))
    return np.asarray(uvs * of_vertex[:, None], np.float64)


def flat_areas(uvs: npt.NDArray[np.floating], faces: Faces) -> F64:
    """(F,) areas of texture triangles."""
    a, b, c = uvs.astype(np.float64)[faces].transpose(1, 0, 2)
    twice = np.abs((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    return np.asarray(0.5 * twice, np.float64)


def face_share(charts: Charts, face: Mask) -> float:
    """Of the area under charts."""
    flat = flat_areas(charts.uvs, charts.faces)
    return float(flat[face].sum() / max(float(flat.sum()), 1e-300))
