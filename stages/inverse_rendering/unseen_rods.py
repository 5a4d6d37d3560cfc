"""Thin parts that no photo looks at are cut off the start.

Where the head template would leave silhouettes empty, something is kept on their rays (keep_silhouettes.py). Photos
from one side bound it in front. Behind, where no photo looks, it may stand out as a rod, and nothing in the fit removes
that. So what is thin and far from all seen surface goes:

    removed = O - ((O eroded by r) dilated by r),  where no seen place of the surface is within r

Symbols: O the start's solid; r radius of the thickest rod that goes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from stages.inverse_rendering.footprint import surface_of
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView, evenly_spaced
from stages.inverse_rendering.signed_distance import distances
from stages.inverse_rendering.weakly_seen import on_surface, seen_by

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
POINTS = 20_000  # of the surface: some 5 mm apart on a head
VIEWS = 16  # evenly spaced over all
RADIUS = 0.015  # metres of the template


def without_unseen_rods(
    start: Start, views: list[PhotoView], radius: float, check: Callable[[], None] = lambda: None
) -> Start:
    """The start without them; the same one if there are none. radius: r, world units."""
    thin = _thin(start.values < 0, radius / start.cell)
    if not thin.any():
        return start
    seen, node = _seen_places(start, views, check), np.argwhere(thin)
    if len(seen):
        node = node[cKDTree(seen).query(start.lo + start.cell * node, workers=-1)[0] > radius]
    if not len(node):
        return start
    values = start.values.astype(np.float64)
    values[tuple(node.T)] = 0.5 * start.cell
    return Start(distances(values, start.lo, start.cell), start.lo, start.cell)


def _thin(solid: Bool, radius: float) -> Bool:
    """(X, Y, Z) voxels of a solid that a ball of this radius, in voxels, does not reach within it."""
    core = ndimage.distance_transform_edt(np.pad(solid, 1))[1:-1, 1:-1, 1:-1] > radius
    if not core.any():
        return np.zeros(solid.shape, np.bool_)
    return np.asarray(solid & (ndimage.distance_transform_edt(~core) > radius), np.bool_)


def _seen_places(start: Start, views: list[PhotoView], check: Callable[[], None]) -> F64:
    """(N, 3) places of the surface that a photo sees within its mask."""
    grid = start.surface("cpu")
    x, n = on_surface(grid, surface_of(start, POINTS)[0])
    seen = np.zeros(len(x), np.bool_)
    for i in evenly_spaced(len(views), min(VIEWS, len(views))):
        check()
        seen[seen_by(grid, views[i], x, n)[0]] = True
    return x[seen]
