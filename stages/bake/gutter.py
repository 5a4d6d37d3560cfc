"""Texels between the charts take the value of the nearest covered one, everywhere.

With that no mip level can mix a chart with black: each coarse texel is a mean of chart values, also far from charts.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.meshes import F32, Indices, Mask


def nearest_index(covered: Mask) -> Indices:
    """(H, W) flat index of the nearest covered texel, its own where covered. At least one texel must be covered."""
    from scipy.ndimage import distance_transform_edt

    row, column = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    out: Indices = row.astype(np.int64) * covered.shape[1] + column
    return out


def nearest_filled(image: F32, index: npt.NDArray[np.integer]) -> F32:
    """(H, W) or (H, W, C) with every texel taken from where `index` says."""
    flat = image.reshape(-1, *image.shape[2:])
    return np.asarray(flat[index], np.float32)
