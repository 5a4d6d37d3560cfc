"""Where the surface is skin: for the prior of its material, which photos of a face alone would give to the face alone.

The photos' label of the face ends at the forehead and the jaw, and covers brows and a fringe. So what is labelled face
is skin unless it is much darker than the face. The ears of the placed head are skin under the same rule: their hollows
are darker and redder than the face. Neck and scalp are skin where they have the face's colour. What is far from the
head (shoulders, chest) is so only where it has nearly the face's colour and is continuous with skin of the head.

One vertex tells little: a fair line of a plaid shirt has the face's colour, and a mole has not. So outside of the label
and the ears a vote decides, of what lies within some 6 mm.

Symbols: y log luminance of the albedo, r and b its log red and blue against green; of the labelled face the medians and
the spreads (1.4826 times the median deviation, but at least FLOOR, because skin elsewhere differs from the face's).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline.colour import LUMA
from pipeline.meshes import F64, Indices, Mask, Mesh
from pipeline.smoothing import Smoother
from stages.bake.unseen import HAIR, REGIONS, REST

EARS = REGIONS.index("ears")
DARKER = -1.0  # y against the face's: brows, beards and fringes are darker than a third of it
FLOOR = np.array([0.25, 0.08, 0.12])  # of y, r, b
ALIKE = 3.0  # spreads
ALIKE_FAR = 2.0  # the same far from the head, where most of the surface is cloth: a sheer pink collar is at 2.3
MIN_FACE = 50  # vertices: fewer tell no colour
VOTE = 0.006  # metres: standard deviation of the vote's weights
TOUCHING = 0.01  # metres: the clothes' and the shoulders' mesh ends beside the template's neck, and is not welded to it


def skin_of(mesh: Mesh, face: Mask, albedo: F64, region: Indices | None) -> tuple[Mask, Mask]:
    """(V,) skin, and (V,) the part of it whose photos tell skin's material: that labelled or in the face's colour. The
    hollows of ears are lit by their own flesh, which no exported light has. face (V,): labelled face by the photos;
    albedo (V, 3) linear; region (V,): of the head, by unseen.region_of, None without a placed head."""
    if face.sum() < MIN_FACE:
        return face, face
    bright, off = _against(face, albedo)
    if region is None:
        return face & bright, face & bright
    flesh = (face | (region == EARS)) & (region != HAIR)
    alike = np.where(flesh, bright, off < np.where(region == REST, ALIKE_FAR, ALIKE)) & (region != HAIR)
    share = Smoother(mesh, VOTE)(alike[:, None].astype(np.float64))[:, 0]
    voted = np.where(flesh, alike, (share > 0.5) & (region != HAIR))
    head = _joined(mesh, voted & (region != REST), flesh & alike)
    skin = _joined(mesh, voted, head)
    return skin, skin & (face | (off < ALIKE))


def _against(face: Mask, albedo: F64) -> tuple[Mask, F64]:
    """(V,) not much darker than the face, and (V,) how many spreads the colour (V, 3) is off the face's."""
    colour = np.log(np.maximum(albedo, 1e-4))
    y = np.log(np.maximum(albedo @ np.array(LUMA), 1e-4))
    seen = np.stack([y, colour[:, 0] - colour[:, 1], colour[:, 2] - colour[:, 1]], 1)
    middle = np.median(seen[face], axis=0)
    bright = np.asarray(y - middle[0] > DARKER, np.bool_)
    spread = np.maximum(1.4826 * np.median(np.abs(seen[face & bright] - middle), axis=0), FLOOR)
    return bright, np.sqrt((((seen - middle) / spread) ** 2).sum(1))


def _joined(mesh: Mesh, of: Mask, sure: Mask) -> Mask:
    """(V,) the connected parts of `of` (V,) that touch what is `sure` (V,)."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = edges[of[edges].all(1)]
    part = connected_components(coo_array((np.ones(len(edges)), edges.T), shape=(len(of), len(of))), directed=False)[1]
    near = np.isfinite(cKDTree(mesh.vertices[sure]).query(mesh.vertices, distance_upper_bound=TOUCHING)[0])
    return np.asarray(of & np.isin(part, part[of & near]), np.bool_)
