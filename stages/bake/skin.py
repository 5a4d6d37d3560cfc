"""Where the surface is skin: for the prior of its material, which photos of a face alone would give to the face alone.

The photos' label of the face ends at the forehead and the jaw, and covers brows and a fringe. So what is labelled face
is skin unless it is much darker than the face; and ears, neck and scalp of the placed head are skin where they have
the face's colour.

Symbols: y log luminance of the albedo, r and b its log red and blue against green; of the labelled face the medians and
the spreads (1.4826 times the median deviation, but at least FLOOR, because skin elsewhere differs from the face's).
"""

from __future__ import annotations

import numpy as np

from pipeline.colour import LUMA
from pipeline.meshes import F64, Indices, Mask
from stages.bake.unseen import HAIR, REST

DARKER = -1.0  # y against the face's: brows, beards and fringes are darker than a third of it
FLOOR = np.array([0.25, 0.08, 0.12])  # of y, r, b
ALIKE = 3.0  # spreads
MIN_FACE = 50  # vertices: fewer tell no colour


def skin_of(face: Mask, albedo: F64, region: Indices | None) -> Mask:
    """(V,) skin. face (V,): labelled face by the photos; albedo (V, 3) linear; region (V,): of the head, by
    unseen.region_of, None without a placed head."""
    if face.sum() < MIN_FACE:
        return face
    colour = np.log(np.maximum(albedo, 1e-4))
    y = np.log(np.maximum(albedo @ np.array(LUMA), 1e-4))
    seen = np.stack([y, colour[:, 0] - colour[:, 1], colour[:, 2] - colour[:, 1]], 1)
    middle = np.median(seen[face], axis=0)
    bright = np.asarray(face & (y - middle[0] > DARKER), np.bool_)
    if region is None:
        return bright
    spread = np.maximum(1.4826 * np.median(np.abs(seen[bright] - middle), axis=0), FLOOR)
    alike = (((seen - middle) / spread) ** 2).sum(1) < ALIKE**2
    bare = (region != REST) & (region != HAIR)
    return np.asarray(bright | (bare & ~face & alike), np.bool_)
