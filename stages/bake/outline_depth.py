"""How far inside of the photos' silhouettes vertices are seen.

    d_v = max over the photos n that see v well of D_n(p_nv)

Symbols: p_nv where photo n shows vertex v; D_n the distance to the outline of its mask, in shares of its longest side.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pipeline.meshes import F64, Indices, Mesh, unit
from pipeline.visibility import FittedPhoto, Occluder, mask_of, picked, view_cosines

MOST_PHOTOS = 24  # neighbouring photos of a film show the same
SIDE = 256  # pixels of the masks' longest side: finer than what is asked


def outline_depth(
    mesh: Mesh, of: Indices, views: Sequence[FittedPhoto], occluder: Occluder, least_cosine: float
) -> F64:
    """(V,) the depth of the vertices `of`, 0 for others, for those that no photo sees at `least_cosine` or more, and
    without masks."""
    out = np.zeros(len(mesh.vertices))
    with_mask = [v for v in views if v.mask is not None]
    if not len(of) or not with_mask:
        return out
    points, normals = mesh.vertices[of].astype(np.float64), unit(mesh.normals)[of].astype(np.float64)
    every = -(-len(with_mask) // MOST_PHOTOS)
    for view in with_mask[::every]:
        cosine, at = view_cosines(view, points, normals, occluder)
        seen = np.flatnonzero(cosine >= least_cosine)
        if len(seen):
            depth = picked(_distance(view), view.camera, at[seen])
            out[of[seen]] = np.maximum(out[of[seen]], depth)
    return out


def _distance(view: FittedPhoto) -> F64:
    """(H, W) distance to the outline of the mask, 0 outside, in shares of the longest side. The photo's edge is no
    outline."""
    assert view.mask is not None
    inside = mask_of(view.mask)
    scale = SIDE / max(inside.shape)
    size = (max(1, round(inside.shape[1] * scale)), max(1, round(inside.shape[0] * scale)))
    small = cv2.resize(inside.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    pixels = np.asarray(cv2.distanceTransform(small, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float64)
    return np.asarray(pixels / max(small.shape), np.float64)
