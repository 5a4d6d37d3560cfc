"""Albedo where photos show the surface badly or not at all: each region of the head goes on in its own colour.

A photo that sees the surface at a grazing angle mixes it with what lies behind, so that the last seen rim has wrong
colours, and continuing them gives smears; and a mean over the whole head makes the back of a dark-haired head bald.
Hence only well seen vertices are kept, and others are drawn, over the length L, to the median of the seen albedo of
their region of the head template (scalp, neck, ears, face; the rest): smooth.continued.

Symbols: V vertices; cosine between a normal and the direction to the camera.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Indices, Mask
from pipeline.registration.identity_fit import PlacedHead
from pipeline.template.model import Template

GRAZING, CLEAR = 0.1, 0.3  # cosines: up to the first the albedo is replaced, from the second on it is kept
LENGTH = 0.015  # metres over which a region's colour replaces that of the seen rim
BEST = 1 / 3  # of the well seen vertices: at the hair's outline the wall shines through
MIN_SHARE = 0.02  # of a region's vertices that must be seen for its own median; else that of the whole head
# Metres from the head template within which a vertex belongs to its region: hair is thick; a collar is no neck.
NEAR = {"scalp": 0.04, "neck": 0.012, "ears": 0.02, "face": 0.02}
REGIONS = tuple(NEAR)
REST = len(REGIONS)
HAIR = REST + 1  # a mesh of its own; under it the scalp goes on in the colour of the face


def replaced_share(cosine: F64) -> F64:
    """(V,) how far the albedo is replaced, in [0, 1], by the best cosine (V,) towards a photo that sees the vertex; 0
    for none."""
    share = ((cosine - GRAZING) / (CLEAR - GRAZING)).clip(0, 1)
    return np.asarray(1 - share * share * (3 - 2 * share), np.float64)


def region_of(vertices: F64, template: Template, head: PlacedHead) -> Indices:
    """(V,) index into REGIONS of the nearest region of the placed template; REST far from the head and in all other
    regions (lids, lips), which photos of a face show."""
    quads = {name: template.quads[template.regions[name]] for name in REGIONS if name in template.regions}
    points = np.concatenate([head.vertices[q].mean(1) for q in quads.values()])
    names = np.concatenate([np.full(len(q), REGIONS.index(name)) for name, q in quads.items()])
    distance, nearest = cKDTree(points).query(vertices)
    reach = np.array(list(NEAR.values()))[names[nearest]] * head.scale
    return np.where(distance <= reach, names[nearest], REST).astype(np.int64)


def with_hair(region: Indices, hair: Mask) -> Indices:
    """The regions (V,) of a mesh whose vertices hair (V,) are a mesh of hair."""
    bare = np.where(region == REGIONS.index("scalp"), REGIONS.index("face"), region)
    return np.where(hair, HAIR, bare)


def region_colours(albedo: F64, region: Indices, cosine: F64) -> F64:
    """(V, 3) for each vertex the median albedo (V, 3) of the best seen vertices of its region (V,): those with the
    largest cosines (V,), the upper BEST of all that are seen well."""
    seen = cosine >= CLEAR
    out = np.broadcast_to(_median(albedo, cosine, seen), albedo.shape).copy()
    for code in np.unique(region):
        mine = region == code
        if (mine & seen).sum() >= max(MIN_SHARE * mine.sum(), 1):
            out[mine] = _median(albedo, cosine, mine & seen)
    return out


def _median(albedo: F64, cosine: F64, of: Mask) -> F64:
    best = of & (cosine >= np.quantile(cosine[of], 1 - BEST))
    return np.asarray(np.median(albedo[best], axis=0), np.float64)
