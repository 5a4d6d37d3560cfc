"""Dilation: every texel between the charts takes the value of the nearest covered texel.

So no mip level mixes a chart with black: each coarse texel is a mean of chart values.
"""

from __future__ import annotations

from pipeline.meshes import Indices, Mask
from pipeline.nearest import nearest_known

HALO = 512  # rows above and below a band that are searched for the nearest texel


def nearest_rows(covered: Mask, first: int, last: int) -> Indices:
    """(last - first, W) flat index of the nearest covered texel for rows first..last-1; a covered texel's own index.

    covered (H, W). The search goes HALO rows beyond the band, further only if these have no covered texel. At least one
    texel must be covered.
    """
    width = covered.shape[1]
    low, high = max(0, first - HALO), min(len(covered), last + HALO)
    while not covered[low:high].any():
        low, high = max(0, low - HALO), min(len(covered), high + HALO)
    out: Indices = nearest_known(covered[low:high])[first - low : last - low] + low * width
    return out
