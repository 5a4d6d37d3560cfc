"""How far a colour is from that of a face: what of a person that no photo labels is bare skin.

Symbols: y log luminance of an albedo, r and b its log red and blue against green; of the face the medians and the
spreads (1.4826 times the median deviation, but at least FLOOR, because skin elsewhere differs from the face's).
"""

from __future__ import annotations

import numpy as np

from pipeline.colour import LUMA
from pipeline.meshes import F64, Mask

DARKER = -1.0  # y against the face's: brows, beards and fringes are darker than a third of it
FLOOR = np.array([0.25, 0.08, 0.12])  # of y, r, b
ALIKE = 3.0  # spreads within which bare skin is
LEAST = 1e-4  # albedo, below which it counts as that


def against_face(face: F64, albedo: F64) -> tuple[Mask, F64]:
    """(V,) whether an albedo (V, 3), linear, is not much darker than the face's (N, 3), N > 0; and (V,) how many
    spreads its colour is off, in [0, inf)."""
    own, other = _features(face), _features(albedo)
    middle = np.median(own, axis=0)
    lit = own[own[:, 0] - middle[0] > DARKER]
    spread = np.maximum(1.4826 * np.median(np.abs(lit - middle), axis=0), FLOOR)
    return np.asarray(other[:, 0] - middle[0] > DARKER), np.sqrt((((other - middle) / spread) ** 2).sum(1))


def _features(albedo: F64) -> F64:
    """(V, 3) y, r and b of an albedo (V, 3)."""
    colour = np.log(np.maximum(albedo, LEAST))
    y = np.log(np.maximum(albedo @ np.array(LUMA), LEAST))
    return np.stack([y, colour[:, 0] - colour[:, 1], colour[:, 2] - colour[:, 1]], 1)
