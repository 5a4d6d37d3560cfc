"""Placing charts in the square: greedy, largest first, by exact collision tests of their pixels.

Symbols
    G       cells along the square's side during packing
    reach   cells around a chart that count as its own, so that two charts keep their padding
    scale   side of the square over the unit of the charts: searched, the largest at which all charts fit

All free places of a chart are found at one time, as the zeros of the correlation of its pixels with the occupied ones
(by FFT); the one nearest to the corner is taken. xatlas's packer mirrors charts when it turns them and left half of
the square empty on heads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from pipeline import raster
from pipeline.meshes import F32, F64, Faces, Indices, Mask

G = 256
HALF_DIAGONAL = 0.71  # of a cell
SEARCH = 5  # halvings of the interval of scales
DENSEST, LOOSEST = 0.76, 0.36  # share of the square that charts may take, where the search starts and ends
SMALL = 0.01  # of all charts' area: smaller charts are tried in one orientation only


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart: its texture vertices (n,), its faces into those (m, 3), and its area (in the given unit squared)."""

    vertices: Indices
    faces: Faces
    area: float


def pack(uvs: F64, faces: Faces, chart_of_face: Indices, padding: float) -> F32 | None:
    """(U, 2) uvs in [0, 1], charts turned and moved but not mirrored, at least `padding` (in uv) apart.

    uvs: (U, 2) in any one scale, positive areas. None if they do not fit even loosely.
    """
    upright = np.array(uvs, np.float64)
    charts = _charts(upright, faces, chart_of_face)
    for chart in charts:
        upright[chart.vertices] = boxed(upright[chart.vertices])
    total = sum(c.area for c in charts)
    low, high = np.sqrt(LOOSEST / total), np.sqrt(DENSEST / total)
    best = _placed(upright, charts, low, padding)
    for _ in range(SEARCH):
        middle = 0.5 * (low + high)
        found = _placed(upright, charts, middle, padding)
        if found is None:
            high = middle
        else:
            low, best = middle, found
    return best


def boxed(points: F64) -> F64:
    """(n, 2) points turned so that the smallest rectangle around them is upright, its corner at 0, wider than tall."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # a chart that is a line
        return np.asarray(points - points.min(0), np.float64)
    side = np.roll(hull, -1, 0) - hull
    best, smallest = points, np.inf
    for angle in np.arctan2(side[:, 1], side[:, 0]):
        c, s = np.cos(angle), np.sin(angle)
        turned = hull @ np.array([[c, -s], [s, c]])
        width, height = np.ptp(turned, axis=0)
        if width * height < smallest * (1 - 1e-9):
            smallest = width * height
            best = points @ (np.array([[c, -s], [s, c]]) if width >= height else np.array([[s, c], [-c, s]]))
    return np.asarray(best - best.min(0), np.float64)


def _charts(uvs: F64, faces: Faces, label: Indices) -> list[Chart]:
    a, b, c = uvs[faces].transpose(1, 0, 2)
    area = 0.5 * np.abs((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    totals = np.bincount(label, area)
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(len(totals) + 1))
    charts = []
    for which in np.argsort(-totals, kind="stable"):
        own = faces[order[starts[which] : starts[which + 1]]]
        vertices, inverse = np.unique(own, return_inverse=True)
        charts.append(Chart(vertices.astype(np.int64), inverse.reshape(-1, 3).astype(np.int32), float(totals[which])))
    return charts


def _placed(uvs: F64, charts: list[Chart], scale: float, padding: float) -> F32 | None:
    """Every chart at this scale, or None if one does not fit."""
    occupied = np.zeros((G, G), np.float32)
    out = np.zeros((len(uvs), 2), np.float64)
    total = sum(c.area for c in charts)
    reach = HALF_DIAGONAL + 0.5 * padding * G
    border = int(np.ceil(reach))
    for chart in charts:
        points = uvs[chart.vertices] * scale * G + border
        upright = _pixels(points, chart.faces, reach, border)
        if upright is None:
            return None
        spectrum = fft.rfft2(occupied, (2 * G, 2 * G))
        best: tuple[float, int, tuple[int, int]] | None = None
        for turns in range(4 if chart.area > SMALL * total else 1):
            mask = np.rot90(upright, turns)
            place = _corner_most(spectrum, mask)
            if place is not None:
                cost = max(place[0] + mask.shape[0], place[1] + mask.shape[1]) + 1e-3 * sum(place)
                if best is None or cost < best[0]:
                    best = cost, turns, place
        if best is None:
            return None
        _, turns, (row, column) = best
        mask = np.rot90(upright, turns)
        occupied[row : row + mask.shape[0], column : column + mask.shape[1]] += mask
        turned = _turned(points, upright.shape, turns)
        out[chart.vertices] = (turned + np.array([column, row])) / G
    return np.asarray(out.clip(0, 1), np.float32)


def _turned(points: F64, shape: tuple[int, ...], turns: int) -> F64:
    """(n, 2) x along columns, y along rows of an array of `shape`, where np.rot90 takes them."""
    (x, y), (height, width) = points.T, shape
    return np.stack([(x, y), (y, width - x), (width - x, height - y), (height - y, x)][turns], 1)


def _pixels(points: F64, faces: Faces, reach: float, border: int) -> Mask | None:
    """The chart's cells with `reach` around them; None if it is larger than the square."""
    width, height = (int(n) for n in np.ceil(points.max(0)).astype(int) + border)
    size = max(width, height)
    if size > G:
        return None
    hits = raster.rasterise(points[faces], size, 0, size, reach)
    out = np.zeros(size * size, np.bool_)
    out[hits.texel] = True
    return out.reshape(size, size)[:height, :width]


def _corner_most(spectrum: object, mask: Mask) -> tuple[int, int] | None:
    """The free place (row, column) of a mask where its box then reaches least far from the corner."""
    flipped = fft.rfft2(mask[::-1, ::-1].astype(np.float32), (2 * G, 2 * G))
    hits = fft.irfft2(spectrum * flipped, (2 * G, 2 * G))
    h, w = mask.shape
    free = hits[h - 1 : G, w - 1 : G] < 0.5
    if not free.any():
        return None
    row, column = np.nonzero(free)
    cost = np.maximum(row + h, column + w) + 1e-3 * (row + column)
    best = int(cost.argmin())
    return int(row[best]), int(column[best])
