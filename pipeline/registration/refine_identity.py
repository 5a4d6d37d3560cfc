"""The identity refined with the fitted surface: landmarks and point-to-plane pairs in turn (iterative closest points).

Hair stands out of the scalp and clothes lie on the neck: there a pair counts only near the surface, so that the skull
keeps the shape that the face makes probable.
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, Indices, Mask, vertex_normals
from pipeline.registration.cage import HIDDEN, LOOSE
from pipeline.registration.identity_fit import Data, PlacedHead, landmark_data, place
from pipeline.registration.outgrown import GROWS, growing, outgrown
from pipeline.registration.scan import Scan
from pipeline.template.model import SKIN, Template

REACHES = (0.025, 0.015, 0.010)  # metres of the template, one round each
SIGMA = 0.0115  # metres: eight neighbouring pairs with an error of 4 mm count like one that is independent
LOOSE_REACH = 0.008  # metres, on scalp and neck
MOST = 1000  # pairs of a round: more change nothing


def refined(template: Template, landmarks: F64, head: PlacedHead, scan: Scan) -> PlacedHead:
    """The head on landmarks (468, 3) and the scan, from the head that lies on the landmarks alone."""
    own = landmark_data(template, landmarks)
    for reach in REACHES:
        pairs = surface_data(template, head, scan, reach)
        if len(pairs.where):
            head = place(template, (own, pairs, outgrown_data(template, head, scan)), head)
    return head


def surface_data(template: Template, head: PlacedHead, scan: Scan, reach: float) -> Data:
    """Point-to-plane data of the skin's outer vertices within `reach` metres of the template."""
    vertex, normals = _outer(template, head)
    pairs = scan.pairs(head.vertices[vertex], normals, reach * head.scale)
    limit = np.where(_inside(template, LOOSE)[vertex], min(LOOSE_REACH, reach), reach) * head.scale
    use = np.flatnonzero((pairs.weight > 0) & (pairs.distance <= limit))
    use = use[:: max(1, len(use) // MOST)]
    return _data(vertex[use], pairs.where[use], pairs.weight[use], pairs.normals[use])


def outgrown_data(template: Template, head: PlacedHead, scan: Scan) -> Data:
    """Data of the vertices that the surface outgrows."""
    vertex, normals = _outer(template, head)
    may = growing(template.vertices[vertex], _inside(template, GROWS)[vertex])
    found = outgrown(head.vertices[vertex], normals, may, scan, head.scale)
    use = np.flatnonzero(found.weight > 0)
    return _data(vertex[found.rows[use]], found.where[use], found.weight[use], found.directions[use])


def _data(vertex: Indices, where: F64, weight: F64, normals: F64) -> Data:
    """Data at vertices (N,), of which the distance along normals (N, 3) counts."""
    weights = np.tile([1.0, 0.0, 0.0], (len(vertex), 1))
    return Data(np.repeat(vertex[:, None], 3, axis=1), weights, where, SIGMA / np.sqrt(weight), normals)


def _outer(template: Template, head: PlacedHead) -> tuple[Indices, F64]:
    """(N,) vertices of the skin that photos can show, and their normals (N, 3) on the head."""
    skin = template.part_vertices(SKIN)
    vertex = np.asarray(skin[~_inside(template, HIDDEN)[skin]], np.int64)
    return vertex, vertex_normals(head.vertices, template.triangles()).astype(np.float64)[vertex]


def _inside(template: Template, regions: tuple[str, ...]) -> Mask:
    """(V,) vertices with a quad of one of the regions; those that the template lacks have none."""
    out = np.zeros(len(template.vertices))
    for name in regions:
        if name in template.regions:
            out += template.region_weights(name)
    return out > 0
