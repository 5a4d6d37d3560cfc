"""Selects the connected components of a volume that belong to the subject: those that the cameras look at.

A shirt in only a few photos may reach the edge of the volume and have more voxels than the head. So the weight of a
voxel falls with its distance from the origin of asset coordinates, where the views meet. All components with enough
weight are kept: one wrong mask may split the subject, and the fit can still join the parts.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy import ndimage

Bool = npt.NDArray[np.bool_]
MIN_WEIGHT = 0.3  # of the weight of the heaviest component: lighter ones are dropped
SPREAD = 0.25  # of the volume's longest side: distance from the origin at which a voxel's weight is an eighth


def subject_pieces(inside: Bool, lo: npt.ArrayLike, cell: float, least: float = MIN_WEIGHT) -> Bool:
    """(X, Y, Z) the 6-connected components of a volume that belong to the subject; an empty volume stays empty.

    Args:
        inside: (X, Y, Z); the node [i, j, k] is at lo + cell * (i, j, k).
        lo: (3,) asset units. cell: edge of a voxel, asset units.
        least: components with less than this share of the heaviest component's weight are dropped. The weight of a
            voxel at distance d from the origin is (1 + (d / s)^2)^-3, s = SPREAD times the volume's longest side.
    """
    label, count = ndimage.label(inside)
    if count <= 1:
        return inside.copy()
    weight = np.zeros(count + 1)
    for places, part in zip(_distances(lo, cell, inside.shape), label, strict=True):  # by slabs: a volume may be large
        weight += np.bincount(part.ravel(), ((1.0 + places) ** -3).ravel(), count + 1)
    weight[0] = 0.0
    return np.asarray((weight >= least * weight.max())[label])


def _distances(lo: npt.ArrayLike, cell: float, shape: tuple[int, ...]) -> Iterator[npt.NDArray[np.float64]]:
    """(Y, Z) for each slab: squared distances from the origin over the square of s."""
    s = SPREAD * cell * max(shape)
    x, y, z = (
        np.square((low + cell * np.arange(n)) / s) for low, n in zip(np.asarray(lo, np.float64), shape, strict=True)
    )
    for here in x:
        yield here + y[:, None] + z


def filled(solid: Bool) -> Bool:
    """A volume (X, Y, Z) with filled cavities: empty space not connected to the border of the grid becomes solid."""
    empty, count = ndimage.label(~solid)
    sides = [np.take(empty, end, axis).ravel() for axis in range(3) for end in (0, -1)]
    cavity = np.ones(count + 1, np.bool_)
    cavity[np.unique(np.concatenate(sides))] = False
    cavity[0] = True  # what is solid
    return np.asarray(cavity[empty])
