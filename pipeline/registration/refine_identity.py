"""The identity refined with the fitted surface: landmarks and point-to-plane pairs in turn (iterative closest points).

Hair stands out of the scalp and clothes lie on the neck: there a pair counts only near the surface, so that the skull
keeps the shape that the face makes probable.
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, vertex_normals
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
    vertex = _outer(template)
    normals = vertex_normals(head.vertices, template.triangles()).astype(np.float64)[vertex]
    pairs = scan.pairs(head.vertices[vertex], normals, reach * head.scale)
    loose = sum((template.region_weights(n) for n in LOOSE if n in template.regions), np.zeros(len(template.vertices)))
    limit = np.where(loose[vertex] > 0, min(LOOSE_REACH, reach), reach) * head.scale
    use = np.flatnonzero((pairs.weight > 0) & (pairs.distance <= limit))
    use = use[:: max(1, len(use) // MOST)]
    corners = np.repeat(vertex[use, None], 3, axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(use), 1))
    sigma = SIGMA / np.sqrt(pairs.weight[use])
    return Data(corners, weights, pairs.where[use], sigma, pairs.normals[use])


def outgrown_data(template: Template, head: PlacedHead, scan: Scan) -> Data:
    """Data of the vertices that the surface outgrows."""
    vertex = _outer(template)
    normals = vertex_normals(head.vertices, template.triangles()).astype(np.float64)[vertex]
    grows = sum((template.region_weights(n) for n in GROWS if n in template.regions), np.zeros(len(template.vertices)))
    may = growing(template.vertices[vertex], grows[vertex] > 0)
    found = outgrown(head.vertices[vertex], normals, may, scan, head.scale)
    use = np.flatnonzero(found.weight > 0)
    corners = np.repeat(vertex[found.rows[use], None], 3, axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(use), 1))
    return Data(corners, weights, found.where[use], SIGMA / np.sqrt(found.weight[use]), found.directions[use])


def _outer(template: Template) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """(N,) vertices of the skin that photos can show."""
    skin = template.part_vertices(SKIN)
    inside = sum(
        (template.region_weights(n) for n in HIDDEN if n in template.regions), np.zeros(len(template.vertices))
    )
    return np.asarray(skin[inside[skin] == 0], np.int64)
