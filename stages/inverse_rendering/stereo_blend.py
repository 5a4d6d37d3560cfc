"""One start of two: the sweep's surface and that of the depth maps, each where it shows validation views better.

Depth maps have the hollows that a hull fills: behind ears, eye sockets, below a chin. On smooth skin and at outlines
the sweep is better. Both are right in places of one head, so the choice is made place by place.

Symbols: d difference of both scores at a pixel of a validation view, positive where the depth maps are better; n number
of views that tell, by the area of their pixels on the surface; D the mean of d around a place, drawn towards the mean
G over all pixels by PRIOR views; w in [0, 1] the share of the depth maps. The distance is (1 - w) f_sweep + w f_maps.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stages.inverse_rendering.dense_stereo import pixel_rays
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.signed_distance import distances
from stages.inverse_rendering.stereo_scores import Shown, Validation, mean_score

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
AROUND = 2.0  # cells: standard deviation of the Gaussian over which differences are averaged
PRIOR = 1.0  # views
WIDTH = 0.04  # difference of the scores from all sweep to all depth maps


def blended(sweep: Start, maps: Start, share: F64) -> Start:
    """The start between both. share (X, Y, Z): of the depth maps."""
    values = (1 - share) * sweep.values + share * maps.values
    if not (values < 0).any():
        return sweep
    return Start(distances(values, sweep.lo, sweep.cell), sweep.lo, sweep.cell)


def share_of_maps(sweep: list[Shown], maps: list[Shown], views: Validation, grid: Start) -> F64:
    """w (X, Y, Z) at the nodes of a grid, from the same validation views as both starts show them."""
    total, weight = np.zeros(grid.values.shape), np.zeros(grid.values.shape)
    for one, two in zip(sweep, maps, strict=True):
        better = two.score - one.score
        for inverse in (one.inverse, two.inverse):  # it belongs to both places that the pixel may show
            _add(better, inverse, one.view, views, grid, total, weight)
    total, weight = _around(total), _around(weight)
    overall = mean_score(maps, views) - mean_score(sweep, views)
    difference = (total + PRIOR * overall) / (weight + PRIOR)
    return np.asarray(np.clip(difference / WIDTH + 0.5, 0, 1))


def _add(difference: F32, inverse: F32, view: int, views: Validation, grid: Start, total: F64, weight: F64) -> None:
    """Add a view's pixels to the nodes nearest to them: weights are areas in cells."""
    pictures = views.pictures
    rows, columns = np.nonzero((inverse > 0) & pictures.usable[view])
    w = inverse[rows, columns]
    K = pictures.K[view]
    o, d, length = pixel_rays(K, views.poses[view], rows, columns)
    node = np.rint(((o.numpy() + (length / w)[:, None] * d.numpy()) - grid.lo) / grid.cell).astype(np.intp)
    inside = ((node >= 0) & (node < total.shape)).all(1)
    at, area = tuple(node[inside].T), ((1 / (K[0, 0] * w * grid.cell)) ** 2)[inside]
    np.add.at(total, at, area * difference[rows, columns][inside])
    np.add.at(weight, at, area)


def _around(x: F64) -> F64:
    """Sums over a Gaussian on a surface, of height 1 / (2 pi AROUND^2): a surface that one view covers gets 1."""
    return np.asarray(ndimage.gaussian_filter(x, AROUND) * np.sqrt(2 * np.pi) * AROUND)
