"""Hair of a capture: told on the fitted surface around the head, and taken out of what the registration follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from pipeline import meshes
from pipeline.faces.oval import on_face
from pipeline.fields.protocol import Field
from pipeline.meshes import F64, Mask, Mesh
from pipeline.patches import Patches, patches_of
from pipeline.registration.hair import PATCH, Hair, depth_beneath, places_of, tell_hair
from pipeline.registration.identity_fit import PlacedHead, landmark_data, place
from pipeline.registration.refine_identity import surface_data
from pipeline.registration.scan import Scan
from pipeline.template.model import Template

ROUNDS = 30  # of smoothing: over about the size of a patch
RIM = 0.25  # of the smoothed share: hair overlaps the skin by some vertices, so that its shadow on the skin is hidden
FACE_REACH = 0.015  # metres of the template: points of the face that the identity is fitted to


@dataclass(frozen=True, slots=True)
class ToldHair:
    """inside (V,): vertices of the scan that are hair, with a rim of skin; beneath (V,): how far beneath the skin lies
    at least, 0 on the rim and beside the hair; figures: of the artifact; reason: why there is none, or ""."""

    inside: Mask
    beneath: F64
    figures: dict[str, float]
    reason: str


def told_hair(template: Template, landmarks: F64, placed: PlacedHead, scan: Scan, field: Field) -> ToldHair:
    """The hair on the scan. landmarks (468, 3); placed: the template on them."""
    patches = patches_of(scan.mesh, PATCH * placed.scale)
    head = _of_the_face(template, landmarks, placed, scan)
    albedo = field.material(patches.where.astype(np.float32)).albedo.astype(np.float64)
    seen = np.minimum(patches.mean(scan.seen), 1.0)
    hair = tell_hair(patches, places_of(template, head, patches), albedo, seen)
    deep = placed.scale * depth_beneath(patches, hair.inside)[patches.of_vertex]
    inside = smooth(scan.mesh, hair.inside[patches.of_vertex]) if hair.inside.any() else np.zeros(len(deep), np.bool_)
    return ToldHair(inside, np.where(inside, deep, 0.0), _figures(patches, hair, seen), hair.reason)


def smooth(mesh: Mesh, inside: Mask) -> Mask:
    """(V,) some vertices of a mesh, without the steps of the patches along their border, and a rim around them."""
    ends, count = meshes.edges(mesh.faces), len(mesh.vertices)
    graph = coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(count, count)).tocsr()
    graph = csr_array(graph + graph.T)
    degree = np.maximum(np.asarray(graph.sum(1)).ravel(), 1)
    share = inside.astype(np.float64)
    for _ in range(ROUNDS):
        share = 0.5 * (share + (graph @ share) / degree)
    return np.asarray(share > RIM, np.bool_)


def under_hair(scan: Scan, hair: ToldHair) -> Scan:
    """The scan as the registration takes it: hair is unseen, and the skin lies beneath it."""
    if not hair.inside.any():
        return scan
    return scan.shown_as(np.where(hair.inside, 0.0, scan.seen), hair.beneath)


def _of_the_face(template: Template, landmarks: F64, placed: PlacedHead, scan: Scan) -> PlacedHead:
    """The identity that the face alone makes probable: no hair pulls the skull."""
    face = on_face(scan.mesh.vertices.astype(np.float64), scan.mesh.normals, landmarks)
    alone = scan.shown_as(np.where(face, scan.seen, 0.0))
    pairs = surface_data(template, placed, alone, FACE_REACH)
    return place(template, (landmark_data(template, landmarks), pairs), placed) if len(pairs.where) else placed


def _figures(patches: Patches, hair: Hair, seen: F64) -> dict[str, float]:
    area = 1e4 * patches.area
    return {
        "hair_standing": round(hair.share, 5),
        "hair_rise_mm": round(1000 * hair.rise, 4),
        "hair_change": round(hair.change, 3),
        "hair_cm2": round(float(area[hair.inside].sum()), 3),
        "hair_seen": round(float(area[hair.inside & (seen > 0)].sum() / max(area[hair.inside].sum(), 1e-30)), 5),
    }
