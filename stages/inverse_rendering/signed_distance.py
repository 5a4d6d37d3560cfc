"""Values that are zero on a surface, made signed distances again: |gradient| = 1.

A surface that stereo has moved, or that was put together of two, has values whose slope is anything between .3 and 5.
Where it is above 1, sphere tracing steps over thin parts, and the density of the renderer is wrong.

Next to the surface values are divided by their slope, which leaves the surface where it is; further away follow
distances by fast sweeping. Source: Zhao, A fast sweeping method for eikonal equations (2005).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.pieces import filled, subject_pieces
from stages.inverse_rendering import signed_distance_kernels as kernels

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
SLOPES = 0.5, 2.0  # of the values next to the surface: what is beyond is no slope but an edge


def distances(values: F32 | F64, lo: F32, cell: float) -> F32:
    """Signed distances (X, Y, Z), negative inside, to the zero set of the subject's components of `values` (X, Y, Z),
    whose holes are filled; without a surface that of the grid's diagonal. lo (3,): first node; cell: distance of nodes,
    asset units."""
    solid = filled(subject_pieces(values < 0, lo, cell))
    beside = (ndimage.binary_dilation(solid) & ~solid) | (ndimage.binary_dilation(~solid) & solid)
    slope = np.sqrt(sum(g**2 for g in np.gradient(ndimage.gaussian_filter(values.astype(np.float64), 1.0))))
    near = np.minimum(np.abs(values) / np.clip(slope, SLOPES[0] * cell, SLOPES[1] * cell), 1.0)
    distance = np.where(beside, near, np.inf)
    kernels.sweep(distance, beside)
    distance = np.minimum(distance, float(np.linalg.norm(values.shape)))
    return np.asarray(np.where(solid, -distance, distance) * cell, np.float32)
