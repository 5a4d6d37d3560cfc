"""The part of the subject that the asset covers: for a person the head, the neck and the beginning of the shoulders.

Symbols: h length from the chin to the top of the forehead (the landmarks'); s(x) distance outside the extent, negative
inside, asset units: the larger of the ellipsoid's and the planes'.

Everything outside is neither fitted nor scored, and the mesh ends there. All stages use the same solid, with these
margins: pixels count from ASKED h inside it, because a visual hull is a little too thick; behind their place on the
hull the surface may lie further out, so that the mesh is cut MESH h outside; the fit reaches GROWN h, so that it has no
rim at the cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Cut, Extent
from pipeline.faces.landmarks3d import HeadFrame
from pipeline.hull import BAND_CELLS, Hull

F64 = npt.NDArray[np.float64]

BELOW = 0.95  # h from the chin down to the cut: a neck is 0.5 h long; an open collar shows more skin
MIDDLE = (0.0, 0.0, -0.55)  # h from the point between the eyes to the centre of the extent: left, up, to the front
RADIUS = 1.65  # h: leaves 0.8 h around a head for hair, and includes some of the shoulders
# The same for the head and neck alone, with which the rest of the subject is compared.
HEAD_BELOW, HEAD_RADIUS = 0.6, 1.4
CORE, CORE_MIDDLE = 0.6, (0.0, 0.1, -0.55)  # h: radius of a ball inside every head, and its centre as above
ASKED, MESH, GROWN = 0.04, 0.08, 0.1  # h


def head_extent(frame: HeadFrame, below_chin: float = BELOW, radius: float = RADIUS) -> Extent:
    """The extent of a person from the head's frame. below_chin, radius: see BELOW and RADIUS."""
    h, axes = frame.height, frame.axes
    centre = frame.eyes + h * np.asarray(MIDDLE) @ axes
    down = -axes[1]
    below = Cut(normal=_triple(down), offset=float(down @ frame.chin) + below_chin * h)
    turn = tuple(_triple(row) for row in axes)
    return Extent(centre=_triple(centre), axes=turn, radii=(radius * h,) * 3, cuts=(below,), head=h)


def core(extent: Extent) -> tuple[F64, float]:
    """Centre (3,) and radius of a ball inside every head."""
    axes = np.asarray(extent.axes, np.float64)
    away = (np.asarray(CORE_MIDDLE) - np.asarray(MIDDLE)) * extent.head
    return np.asarray(extent.centre, np.float64) + away @ axes, CORE * extent.head


def signed(extent: Extent, points: npt.NDArray[np.floating], grown: float = 0.0) -> F64:
    """(N,) s at points (N, 3), for the solid grown by `grown`; an approximate distance if the radii differ."""
    value = _of_ellipsoid(extent, points)[0]
    for cut in extent.cuts:
        value = np.maximum(value, np.asarray(points, np.float64) @ np.asarray(cut.normal) - cut.offset)
    return np.asarray(value - grown, np.float64)


def signed_and_gradient(
    extent: Extent, points: npt.NDArray[np.floating], grown: float = 0.0
) -> tuple[F64, F64]:  # fmt: skip
    """s (N,) at points (N, 3) and its gradient (N, 3), of unit length."""
    value, steepest, second = _of_ellipsoid(extent, points)
    away = np.any(steepest != 0, axis=1, keepdims=True)
    gradient = np.where(away, steepest / second[:, None], [0.0, 1.0, 0.0]) @ np.asarray(extent.axes, np.float64)
    for cut in extent.cuts:
        normal = np.asarray(cut.normal)
        beyond = np.asarray(points, np.float64) @ normal - cut.offset
        larger = beyond > value
        value = np.where(larger, beyond, value)
        gradient = np.where(larger[:, None], normal, gradient)
    return np.asarray(value - grown, np.float64), np.asarray(gradient, np.float64)


def _of_ellipsoid(extent: Extent, points: npt.NDArray[np.floating]) -> tuple[F64, F64, F64]:
    """Distance (N,) of points (N, 3) to the ellipsoid, q = x / r^2 (N, 3) in its own axes, and |q| (N,)."""
    axes, radii = np.asarray(extent.axes, np.float64), np.asarray(extent.radii, np.float64)
    local = (np.asarray(points, np.float64) - np.asarray(extent.centre)) @ axes.T
    scaled = local / radii**2
    first = np.sqrt(np.einsum("ij,ij->i", local, scaled))
    second = np.maximum(np.sqrt(np.einsum("ij,ij->i", scaled, scaled)), 1e-12)
    # at the centre both are 0 and the distance is the smallest radius
    return np.where(first > 1e-9, first * (first - 1) / second, -radii.min()), scaled, second


def bounds(extent: Extent, grown: float = 0.0) -> tuple[F64, F64]:
    """(3,) corners of the bounding box of the ellipsoid, reduced by the planes that are perpendicular to an axis."""
    axes, radii = np.asarray(extent.axes, np.float64), np.asarray(extent.radii, np.float64)
    centre = np.asarray(extent.centre, np.float64)
    reach = np.sqrt(((axes * radii[:, None]) ** 2).sum(0)) + grown
    return centre - reach, centre + reach


def within(hull: Hull, extent: Extent, grown: float = 0.0) -> Hull:
    """The part of a hull inside the extent."""
    centres = hull.centres(np.ones(hull.level.shape, bool)).reshape(-1, 3)
    outside = signed(extent, centres, grown).reshape(hull.level.shape).astype(np.float32)
    band = np.float32(BAND_CELLS * hull.cell)
    level = np.maximum(hull.level, outside.clip(-band, band))
    return replace(hull, level=level, occupied=hull.occupied & (outside <= 0.5 * hull.cell))


def _triple(v: npt.NDArray[np.floating] | Sequence[float]) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
