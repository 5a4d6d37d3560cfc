"""Which pieces of a volume belong to the subject: what the cameras look at, and not simply what is largest.

A shirt that only a few cameras see may reach to the edge of the volume and hold more voxels than the head. So a voxel
counts the less the farther it lies from the origin of asset coordinates, where the views meet. All pieces that count
for something are kept: one wrong mask may cut a body in two, and the photos can still join what is kept.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

Bool = npt.NDArray[np.bool_]
MIN_WEIGHT = 0.3  # of the weight of the chief piece: lighter pieces are dropped
SPREAD = 0.25  # of the volume's longest side: the distance from the origin at which a voxel counts an eighth


def subject_pieces(inside: Bool, lo: npt.ArrayLike, cell: float, least: float = MIN_WEIGHT) -> Bool:
    """(X, Y, Z) the 6-connected pieces of a volume that belong to the subject; an empty volume stays empty.

    Args:
        inside: (X, Y, Z); the node [i, j, k] lies at lo + cell * (i, j, k).
        lo: (3,) asset units. cell: edge of a voxel, asset units.
        least: pieces with less than this share of the chief piece's weight are dropped. A voxel at distance d from the
            origin weighs (1 + (d / s)^2)^-3, s being SPREAD times the volume's longest side.
    """
    label, count = ndimage.label(inside)
    if count <= 1:
        return inside.copy()
    s = SPREAD * cell * max(inside.shape)
    square = sum(
        np.square((low + cell * np.arange(n)) / s).reshape([-1 if a == axis else 1 for a in range(3)])
        for axis, (low, n) in enumerate(zip(np.asarray(lo, np.float64), inside.shape, strict=True))
    )
    weight = np.bincount(label.ravel(), ((1.0 + square) ** -3).ravel())
    weight[0] = 0.0
    return np.asarray((weight >= least * weight.max())[label])


def filled(solid: Bool) -> Bool:
    """A volume without its cavities: empty space that does not reach the border of the grid becomes solid."""
    empty, _ = ndimage.label(~solid)
    sides = [np.take(empty, end, axis).ravel() for axis in range(3) for end in (0, -1)]
    border = np.unique(np.concatenate(sides))
    return np.asarray(~np.isin(empty, border[border > 0]), np.bool_)
