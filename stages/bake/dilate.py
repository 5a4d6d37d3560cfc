"""Texels between the charts take the value of the nearest covered one, everywhere.

With that no mip level can mix a chart with black: each coarse texel is a mean of chart values, also far from charts.
"""

from __future__ import annotations

from pipeline.meshes import Indices, Mask
from pipeline.nearest import nearest_known

HALO = 512  # rows above and below a band in which the nearest texel is looked for


def nearest_rows(covered: Mask, first: int, last: int) -> Indices:
    """(last - first, W) flat index of the nearest covered texel for rows first..last-1, its own where covered.

    Looks at most HALO rows beyond the band, further only where these hold none. At least one texel must be covered.
    """
    width = covered.shape[1]
    low, high = max(0, first - HALO), min(len(covered), last + HALO)
    while not covered[low:high].any():
        low, high = max(0, low - HALO), min(len(covered), high + HALO)
    out: Indices = nearest_known(covered[low:high])[first - low : last - low] + low * width
    return out
