"""Fills cells of a grid without a value with that of the nearest cell with one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]


def nearest_known(known: npt.NDArray[np.bool_]) -> Indices:
    """Flat index of the nearest known cell, in the shape of `known` (any dimension); a known cell's own index.

    At least one cell must be known.
    """
    from scipy.ndimage import distance_transform_edt

    where = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(np.ravel_multi_index(tuple(where), known.shape), np.int64)


def filled(values: npt.NDArray[np.float32], known: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """values (*known.shape, ...) with the unknown cells filled."""
    flat = values.reshape(known.size, *values.shape[known.ndim :])
    return np.asarray(flat[nearest_known(known)], np.float32)
