"""Albedo where photos show the surface badly or not at all: each region of the head goes on in its own colour.

A photo that sees the surface at a grazing angle mixes it with what lies behind, so that the last seen rim has wrong
colours, and continuing them gives smears; and a mean over the whole head makes the back of a dark-haired head bald.
Hence only well seen vertices are kept, and others are drawn, over the length L, to the median of the seen albedo of
their region of the head template (scalp, ears, face, bands of the neck; the rest): smoothing.continued. The neck is
divided by height, because a collar or long hair ends at about one height all around it, and its front from the rest,
because the nape goes on as the sides do: long hair covers them, and a throat is bare. Of hair and scalp the vertices
count that photos show farthest inside of the silhouette, and that are farthest from what they show of other regions: at
the outline the wall shines through loose hair, and a fringe shows the forehead. So it does where hair is seen at a
slant, and hair is kept from a larger cosine on than a solid.

Symbols: V vertices; cosine between a normal and the direction to the camera.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.maths.smoothstep import smoothstep
from pipeline.meshes import F64, Indices, Mask
from pipeline.registration.head_regions import BANDS, FIRST_BAND, FIRST_BEHIND, HAIR, REGIONS, REST
from pipeline.visibility import FEW
from stages.bake.nearby import nearby_colours

GRAZING, CLEAR = FEW  # cosines: up to the first the albedo is replaced, from the second on it is kept
HAIR_GRAZING, HAIR_CLEAR = 0.3, 0.5  # the same for hair
LENGTH = 0.015  # metres over which a region's colour replaces that of the seen rim
BEST = 1 / 3  # of the well seen vertices
MIN_SHARE = 0.02  # of a region's vertices that must be seen for its own median; else that of the whole head
AROUND = 4  # bands up or down that are as unlike as the front of the neck and what is behind it
LOOSE = (REGIONS.index("scalp"), HAIR)  # whose outline is not that of a solid


def replaced_share(cosine: F64, region: Indices) -> F64:
    """(V,) how far the albedo is replaced, in [0, 1], by the best cosine (V,) towards a photo that sees the vertex, 0
    for none, and its region (V,)."""
    low, high = np.where(region == HAIR, HAIR_GRAZING, GRAZING), np.where(region == HAIR, HAIR_CLEAR, CLEAR)
    return 1 - smoothstep(cosine, low, high)


def with_hair(region: Indices, hair: Mask) -> Indices:
    """The regions (V,) of a mesh whose vertices hair (V,) are a mesh of hair."""
    bare = np.where(region == REGIONS.index("scalp"), REGIONS.index("face"), region)
    return np.where(hair, HAIR, bare)


def region_colours(points: F64, albedo: F64, region: Indices, cosine: F64, depth: F64) -> F64:
    """(V, 3) for each vertex, at points (V, 3), the median albedo (V, 3) of the best seen vertices of its region (V,):
    the upper BEST of all that are seen well by the cosine (V,), or of LOOSE regions by how far inside they are: by the
    depth (V,) inside of the silhouettes and the distance to other regions. A band that is not seen takes the nearest
    band's colour, the rest that of what is seen nearby, other regions that of the whole head."""
    seen, known = cosine >= CLEAR, {}
    for code in np.unique(region):
        mine = region == code
        if (mine & seen).sum() >= max(MIN_SHARE * mine.sum(), 1):
            rank = _inside(points, depth, mine & seen, seen & ~mine) if code in LOOSE else cosine
            known[int(code)] = _median(albedo, rank, mine & seen)
    whole, bands = _median(albedo, cosine, seen), [c for c in known if c >= FIRST_BAND]
    out = np.broadcast_to(whole, albedo.shape).copy()
    for code in map(int, np.unique(region)):
        own = region == code
        if code >= FIRST_BAND and code not in known and bands:
            out[own] = known[min(bands, key=lambda b: _unlike(b, code))]
        elif code in known:
            out[own] = known[code]
    off_head = (region == REST) | (region == HAIR) | (region >= FIRST_BEHIND)
    if (off_head & seen).any():
        asked = np.flatnonzero((region == REST) & ~seen)
        asked = asked[_nearer(points[asked], points[seen & off_head], points[seen & ~off_head])]
        out[asked] = nearby_colours(points[asked], points[seen & off_head], albedo[seen & off_head])
    return out


def _nearer(at: F64, to: F64, than: F64) -> Mask:
    """(N,) whether at (N, 3) the points to (M, 3) are nearer than the points than (L, 3); the head's inside is nearer
    to its face than to hair and clothes."""
    return np.asarray(cKDTree(to).query(at)[0] < cKDTree(than).query(at)[0] if len(than) else np.ones(len(at), bool))


def _unlike(band: int, other: int) -> int:
    """How far apart two bands of the neck are, in bands."""
    (side, height), (its_side, its_height) = (divmod(b - FIRST_BAND, BANDS) for b in (band, other))
    return abs(height - its_height) + AROUND * abs(side - its_side)


def _inside(points: F64, depth: F64, own: Mask, others: Mask) -> F64:
    """(V,) for the vertices own (V,) the lower of their ranks by depth (V,) and by distance to the others (V,)."""
    from scipy.stats import rankdata

    out = np.zeros(len(depth))
    out[own] = rankdata(depth[own])
    if others.any():
        out[own] = np.minimum(out[own], rankdata(cKDTree(points[others]).query(points[own])[0]))
    return out


def _median(albedo: F64, rank: F64, of: Mask) -> F64:
    best = of & (rank >= np.quantile(rank[of], 1 - BEST))
    return np.asarray(np.median(albedo[best], axis=0), np.float64)
