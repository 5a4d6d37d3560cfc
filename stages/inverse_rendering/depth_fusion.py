"""Fusion of depth maps into a signed distance within the hull.

Near a depth map's surface a grid node's distance is known, and so is that a camera sees through the nodes in front of
it. The surface between is the smoothest one: the squared Laplacian of the distance is minimised, with the hull as a
weak target. So a hole in the depth maps is closed by continuing the surface around it, and what no depth map shows
keeps the hull's shape. The result never exceeds the hull.

Symbols: f distance at the nodes in the hull, t and W the depth maps' mean distance and its weight, s the hull's
distance, all in cells; L the Laplacian of the grid. Minimised: sum W (f - t)^2 + SCREEN (f - s)^2 + |L f|^2.
Source: Curless and Levoy, A volumetric method for building complex models (1996); smoothest.py for the closing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline import transforms
from stages.inverse_rendering.dense_stereo import DepthMaps
from stages.inverse_rendering.depth_kernels import integrate
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.signed_distance import distances
from stages.inverse_rendering.smoothest import smoothest

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
BAND = 3.0  # cells in front of and behind a depth in which its distance counts
SHELL = 1.0  # cells outside of the hull that are solved for
CERTAIN = 1.0  # sum of weights at which a node's data counts half of its most
MIN_VOTES = 0.3  # smaller sums are a single view's: not used
SUPPORT = 5  # nodes: side of the cube whose nodes must mostly have votes, too, so that stray ones weigh little
DATA, SCREEN = 20.0, 7.7e-4  # weights of data and hull; SCREEN^(-1/4) = 6 cells: larger holes keep the hull's shape
REACH = 6.0  # cells from the nearest data: from there on the hull's own distance takes over, fully at twice of it
COARSEST = 24  # nodes of the longest side at which no coarser grid is used


def fused(hull: Start, maps: DepthMaps, check: Callable[[], None] = lambda: None) -> Start:
    """The start whose surface goes through the depth maps; the hull itself if they are empty."""
    level = np.clip(hull.values / hull.cell, -BAND, BAND).astype(np.float64)
    inside = hull.values < SHELL * hull.cell
    mean, weight = votes(hull, inside, maps, check)
    if not (weight > 0).any():
        return hull
    away = ndimage.distance_transform_edt(weight < 0.1)
    share = np.clip(2 - away / REACH, 0, 1)  # of the smooth surface; the closing rounds what it need not change
    values = share * closed(level, inside, mean, weight, check) + (1 - share) * level
    values = np.maximum(values, level) * hull.cell
    if not (values < 0).any():
        return hull
    return Start(distances(values, hull.lo, hull.cell), hull.lo, hull.cell)


def votes(hull: Start, inside: Bool, maps: DepthMaps, check: Callable[[], None]) -> tuple[F64, F64]:
    """Mean distance (X, Y, Z) in cells, and weight in [0, 1], 0 where no depth map says anything."""
    points = hull.lo + hull.cell * np.argwhere(inside)
    distance, total = np.zeros(len(points)), np.zeros(len(points))
    for i in range(len(maps.inverse)):
        check()
        matrix = maps.K[i] @ transforms.inverse_rigid(maps.world_from_cam[i])[:3]
        integrate(
            points, matrix, maps.K[i], maps.inverse[i], maps.slope[i], maps.weight[i], BAND * hull.cell, distance, total
        )
    mean, weight = np.zeros(inside.shape), np.zeros(inside.shape)
    mean[inside] = distance / np.maximum(total, 1e-12) / hull.cell
    weight[inside] = np.where(total > MIN_VOTES, total / (total + CERTAIN), 0)
    return mean, weight * ndimage.uniform_filter((weight > 0).astype(np.float64), SUPPORT) ** 2


def closed(
    level: F64, inside: Bool, mean: F64, weight: F64, check: Callable[[], None] = lambda: None, factor: float = 1.0
) -> F64:
    """The distances f (X, Y, Z) in cells; outside of `inside` they are `level`. Coarse to fine.

    factor: of the weights of data and hull against |L f|^2, 16 for each doubling of the cell, so that the minimum is
    the same function.
    """
    first = np.where(weight > 0, weight * mean + (1 - weight) * level, level)
    if max(level.shape) > COARSEST:
        small = [_halved(x) for x in (level, inside.astype(np.float64), weight * mean, weight)]
        mean_small = small[2] / np.maximum(small[3], 1e-12)
        found = closed(small[0] / 2, small[1] > 0.5, mean_small / 2, small[3], check, 16 * factor)
        first = np.where(weight > 0.5, mean, 2 * _doubled(found, level.shape))
    check()
    return _solved(level, inside, mean, weight, first, factor)


def _halved(x: F64) -> F64:
    x = np.pad(x, [(0, n % 2) for n in x.shape], mode="edge")
    a, b, c = (n // 2 for n in x.shape)
    return np.asarray(x.reshape(a, 2, b, 2, c, 2).mean((1, 3, 5)))


def _doubled(x: F64, shape: tuple[int, ...]) -> F64:
    """Trilinear values at the nodes of the finer grid of `_halved`."""
    for axis in range(3):
        padded = np.concatenate([x.take([0], axis), x, x.take([-1], axis)], axis)
        n = x.shape[axis]
        before, here, after = (padded.take(range(k, k + n), axis) for k in (0, 1, 2))
        pair = np.stack([0.75 * here + 0.25 * before, 0.75 * here + 0.25 * after], axis + 1)
        x = pair.reshape([2 * n if a == axis else m for a, m in enumerate(x.shape)])
    return x[: shape[0], : shape[1], : shape[2]]


def _solved(level: F64, inside: Bool, mean: F64, weight: F64, first: F64, factor: float) -> F64:
    """The minimum on one grid, from `first`, by conjugate gradients."""
    data, screen = factor * DATA * weight[inside], factor * SCREEN
    target = (data * mean[inside] + screen * level[inside]) / (data + screen)
    out = level.copy()
    out[inside] = np.clip(smoothest(inside, level, data + screen, target, first[inside]), -2 * BAND, 2 * BAND)
    return out
