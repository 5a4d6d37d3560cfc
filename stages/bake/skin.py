"""Where the surface is skin: for the prior of its material, which photos of a face alone would give to the face alone.

The photos' label of the face ends at the forehead and the jaw, and covers brows and a fringe. So what is labelled face
is skin unless it is much darker than the face. The ears of the placed head are skin under the same rule: their hollows
are darker and redder than the face. Neck and scalp are skin where they have the face's colour. What is far from the
head (shoulders, chest) is so only where it has nearly the face's colour and is continuous with skin of the head.

One vertex tells little: a fair line of a plaid shirt has the face's colour, and a mole has not. So outside of the label
and the ears a vote decides, of what lies within some 6 mm.

Colours are compared by pipeline/skin_colour.py.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Indices, Mask, Mesh
from pipeline.registration.head_regions import HAIR, REGIONS, REST
from pipeline.skin_colour import ALIKE, against_face
from pipeline.smoothing import Smoother

EARS = REGIONS.index("ears")
ALIKE_FAR = 2.0  # the same far from the head, where most of the surface is cloth: a sheer pink collar is at 2.3
MIN_FACE = 50  # vertices: fewer tell no colour
VOTE = 0.006  # metres: standard deviation of the vote's weights
TOUCHING = 0.01  # metres: the clothes' and the shoulders' mesh ends beside the template's neck, and is not welded to it


def skin_of(mesh: Mesh, face: Mask, albedo: F64, region: Indices | None) -> tuple[Mask, Mask]:
    """(V,) skin, and (V,) the part of it whose photos tell skin's material: that labelled or in the face's colour. The
    hollows of ears are lit by their own flesh, which no exported light has. face (V,): labelled face by the photos;
    albedo (V, 3) linear; region (V,): of the head, by head_regions.region_of, None without a placed head."""
    if face.sum() < MIN_FACE:
        return face, face
    bright, off = against_face(albedo[face], albedo)
    if region is None:
        return face & bright, face & bright
    flesh = (face | (region == EARS)) & (region != HAIR)
    alike = np.where(flesh, bright, off < np.where(region == REST, ALIKE_FAR, ALIKE)) & (region != HAIR)
    share = Smoother(mesh, VOTE)(alike[:, None].astype(np.float64))[:, 0]
    voted = np.where(flesh, alike, (share > 0.5) & (region != HAIR))
    head = _joined(mesh, voted & (region != REST), flesh & alike)
    skin = _joined(mesh, voted, head)
    return skin, skin & (face | (off < ALIKE))


def _joined(mesh: Mesh, of: Mask, sure: Mask) -> Mask:
    """(V,) the connected parts of `of` (V,) that touch what is `sure` (V,)."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = edges[of[edges].all(1)]
    part = connected_components(coo_array((np.ones(len(edges)), edges.T), shape=(len(of), len(of))), directed=False)[1]
    near = np.isfinite(cKDTree(mesh.vertices[sure]).query(mesh.vertices, distance_upper_bound=TOUCHING)[0])
    return np.asarray(of & np.isin(part, part[of & near]), np.bool_)
