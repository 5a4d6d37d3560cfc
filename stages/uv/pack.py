"""Packs charts into one or several squares: greedy, largest first, with exact collision tests of their pixels.

Symbols
    G       cells along a square's side during packing
    reach   cells around a chart that belong to it, so that two charts keep their padding
    scale   side of a square over the unit of the charts: the largest at which all charts fit, the same for all

All free positions of a chart are found at once: they are the zeros of the correlation (by FFT) of its pixels with the
occupied ones. The position where most of its rim touches other charts is taken. (The one nearest to a corner left 9 %
more empty on a head; rotations by 30 and 45 degrees gained nothing.) xatlas's packer mirrors charts when it rotates
them, and it left half of the square empty on heads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import fft

from pipeline.meshes import F32, F64, Faces, Indices, Mask, open_edges

Spectrum = npt.NDArray[np.complexfloating]
G = 256
OVERLOOKED = 0.25  # of a cell: largest error of a chart's drawn border
RIM = 3  # cells around a chart that are its rim
FINER = 4  # fine cells along a cell's side when a chart is drawn
SEARCH = 5  # halvings of the interval of scales
DENSEST, LOOSEST = 0.76, 0.36  # share of the square under charts, where the search starts and ends
SMALL = 0.01  # of all charts' area: smaller charts are tried in one orientation only
LOWER, LOWEST = 0.93, 12  # several squares: factor of the next scale to try, and number of tries


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart: its texture vertices (n,), the loops of its outline as indices into those, and its area."""

    vertices: Indices
    outline: list[Indices]
    area: float


def pack(uvs: F64, faces: Faces, chart_of_face: Indices, padding: float, least: float = LOOSEST) -> F32 | None:
    """(U, 2) uvs in [0, 1]: charts rotated and moved but not mirrored, at least `padding` (in uv) apart.

    uvs: (U, 2) at any common scale, with positive areas. None if charts that cover `least` of the square do not fit.
    """
    upright, charts, total = _ready(uvs, faces, chart_of_face)
    low, high = np.sqrt(least / total), np.sqrt(max(DENSEST, 1.05 * least) / total)
    return _largest(upright, charts, _placed(upright, charts, low, padding), low, high, padding)


def pack_tiles(
    uvs: F64, faces: Faces, chart_of_face: Indices, padding: float, tiles: int, scale: float | None = None
) -> F32 | None:
    """As `pack`, into `tiles` squares side by side: u in [0, tiles], no chart across a border, all at one scale.

    scale: the smallest that is accepted; by default the first at which the charts fit, from LOOSEST of the squares
    under charts downwards. Each chart goes into the first square with room, so only the last squares may stay empty.
    """
    upright, charts, total = _ready(uvs, faces, chart_of_face)
    low = np.sqrt(tiles * LOOSEST / total) if scale is None else scale
    found = _placed(upright, charts, low, padding, tiles)
    for _ in range(LOWEST if scale is None else 0):
        if found is not None:
            break
        low *= LOWER
        found = _placed(upright, charts, low, padding, tiles)
    high = max(float(np.sqrt(tiles * DENSEST / total)), 1.05 * low)
    return _largest(upright, charts, found, low, high, padding, tiles)


def _ready(uvs: F64, faces: Faces, chart_of_face: Indices) -> tuple[F64, list[Chart], float]:
    """The texture vertices with upright charts, the charts from the largest on, and their total area."""
    upright = np.array(uvs, np.float64)
    charts = _charts(upright, faces, chart_of_face)
    for chart in charts:
        upright[chart.vertices] = boxed(upright[chart.vertices])
    return upright, charts, sum(c.area for c in charts)


def _largest(
    upright: F64, charts: list[Chart], best: F32 | None, low: float, high: float, padding: float, tiles: int = 1
) -> F32 | None:
    """The charts at the largest scale up to `high` at which they fit. `best`: the packing at `low`, if there is one."""
    for _ in range(SEARCH if best is not None else 0):
        middle = 0.5 * (low + high)
        found = _placed(upright, charts, middle, padding, tiles)
        if found is None:
            high = middle
        else:
            low, best = middle, found
    return best


def boxed(points: F64) -> F64:
    """(n, 2) points rotated so that their smallest bounding rectangle is upright, wider than tall, one corner at 0."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # the points lie on a line
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
        charts.append(Chart(vertices.astype(np.int64), outline(inverse.reshape(-1, 3)), float(totals[which])))
    return charts


def outline(faces: Indices) -> list[Indices]:
    """The border loops (vertices in order) of a chart with faces (m, 3), outer and inner ones."""
    border = open_edges(faces, int(faces.max()) + 1)
    after: dict[int, list[int]] = {}
    for start, end in border[::-1].tolist():
        after.setdefault(start, []).append(end)
    loops = []
    for start in border[:, 0].tolist():
        loop, at = [], start
        while after.get(at):
            loop.append(at)
            at = after[at].pop()
        if len(loop) > 2:
            loops.append(np.array(loop, np.int64))
    return loops


def _placed(uvs: F64, charts: list[Chart], scale: float, padding: float, tiles: int = 1) -> F32 | None:
    """Every chart at this scale, or None if one does not fit."""
    squares = [_Room() for _ in range(tiles)]
    out = np.zeros((len(uvs), 2), np.float64)
    total = sum(c.area for c in charts)
    reach = OVERLOOKED + 0.5 * padding * G
    border = int(np.ceil(reach))
    for chart in charts:
        points = uvs[chart.vertices] * scale * G + border
        upright = _pixels(points, chart.outline, reach, border)
        if upright is None:
            return None
        shapes = [_Shape(np.rot90(upright, turns)) for turns in range(4 if chart.area > SMALL * total else 1)]
        found = ((t, _best_position(square, shapes)) for t, square in enumerate(squares))
        tile, place = next((f for f in found if f[1] is not None), (0, None))
        if place is None:
            return None
        turns, (row, column) = place
        squares[tile].fill(shapes[turns], row, column)
        placed = (_turned(points, upright.shape, turns) + np.array([column, row])) / G
        out[chart.vertices] = placed.clip(0, 1) + [tile, 0]
    return np.asarray(out, np.float32)


def _best_position(square: _Room, shapes: list[_Shape]) -> tuple[int, tuple[int, int]] | None:
    """Best rotation (quarter turns) and position (row, column) of a chart in a square; None without room."""
    best: tuple[float, int, tuple[int, int]] | None = None
    for turns, shape in enumerate(shapes):
        place = square.best_position(shape)
        if place is not None and (best is None or place[0] > best[0]):
            best = place[0], turns, place[1]
    return None if best is None else best[1:]


def _turned(points: F64, shape: tuple[int, ...], turns: int) -> F64:
    """(n, 2) points (x along columns, y along rows of an array of `shape`) after np.rot90 of the array."""
    (x, y), (height, width) = points.T, shape
    return np.stack([(x, y), (y, width - x), (width - x, height - y), (height - y, x)][turns], 1)


def _pixels(points: F64, loops: list[Indices], reach: float, border: int) -> Mask | None:
    """The chart's cells with `reach` around them; None if it is larger than the square.

    It is drawn FINER times finer and dilated by a disc; a cell counts if any of its fine cells does.
    """
    import cv2

    width, height = (int(n) for n in np.ceil(points.max(0)).astype(int) + border)
    if max(width, height) > G:
        return None
    fine = np.zeros((height * FINER, width * FINER), np.uint8)
    cv2.fillPoly(fine, [np.round(points[loop] * FINER - 0.5).astype(np.int32) for loop in loops], 1)
    radius = int(np.ceil(reach * FINER))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    fine = np.asarray(cv2.dilate(fine, disc))
    return np.asarray(fine.reshape(height, FINER, width, FINER).max((1, 3)) > 0)


class _Shape:
    """A chart's mask, the rim around it and their spectra, computed once for all squares."""

    def __init__(self, mask: Mask) -> None:
        self.mask = mask

    @cached_property
    def spectrum(self) -> Spectrum:
        """Spectrum of the mask."""
        return _spectrum(self.mask)

    @cached_property
    def rim(self) -> tuple[Spectrum, float]:
        """Spectrum of the rim, and its number of cells."""
        import cv2

        wide = np.pad(self.mask, RIM).astype(np.uint8)
        rim = cv2.dilate(wide, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)) - wide
        return _spectrum(rim), float(rim.sum())


class _Room:
    """A square with the charts in it; finds the best position of a further one."""

    def __init__(self) -> None:
        self._occupied = np.zeros((G, G), np.float32)
        self._spectra: tuple[Spectrum, Spectrum] | None = None

    def fill(self, shape: _Shape, row: int, column: int) -> None:
        """Place a chart."""
        height, width = shape.mask.shape
        self._occupied[row : row + height, column : column + width] += shape.mask
        self._spectra = None

    def best_position(self, shape: _Shape) -> tuple[float, tuple[int, int]] | None:
        """The free position (row, column) where most of the rim touches charts or walls, and that share."""
        h, w = shape.mask.shape
        if self._occupied.sum() + shape.mask.sum() > G * G:
            return None
        if self._spectra is None:
            walled = np.ones((G + 2 * RIM, G + 2 * RIM), np.float32)
            walled[RIM:-RIM, RIM:-RIM] = self._occupied
            self._spectra = fft.rfft2(self._occupied, (2 * G, 2 * G)), fft.rfft2(walled, (2 * G, 2 * G))
        taken, edges = self._spectra
        hits = _correlation(taken, shape.spectrum)
        free = hits[h - 1 : G, w - 1 : G] < 0.5
        if not free.any():
            return None
        rim, around = shape.rim
        touched = _correlation(edges, rim)
        score = np.where(free, touched[h + 2 * RIM - 1 :, w + 2 * RIM - 1 :][: free.shape[0], : free.shape[1]], -1.0)
        best = int(np.round(score, 3).argmax())
        row, column = divmod(best, free.shape[1])
        return float(score.flat[best]) / around, (row, column)


def _correlation(room: Spectrum, shape: Spectrum) -> F32:
    """Correlation of two pictures from their spectra. The product is computed in place: in a new array numpy rounds
    differently, which would decide ties between positions differently."""
    product = shape.copy()
    product *= room
    return np.asarray(fft.irfft2(product, (2 * G, 2 * G)))


def _spectrum(mask: npt.NDArray[np.generic]) -> Spectrum:
    """Spectrum of the mask rotated by 180 degrees, so that a product of spectra is a correlation."""
    return np.asarray(fft.rfft2(mask[::-1, ::-1].astype(np.float32), (2 * G, 2 * G)))
