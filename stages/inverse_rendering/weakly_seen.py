"""Smoothing of the surface where the photos hardly determine it.

Photos from the front see the sides of a head at grazing angles, in few photos that lie close together. What they say
about the depth there is less than their noise: colours and outlines that scatter by a part of a pixel make craters and
steps of a centimetre. So the surface is smoothed as far as it has to be for that noise to cancel, and no further.

Symbols: c_v cosine between a point's normal and the unit direction d_v to camera v, 0 for a view that does not see it;
p edge of a pixel on the surface; I information about the depth; S number of views on whose outline of the subject the
point lies; q length of the smoothing.

    I = sum c_v |d_v|^2 - |sum c_v d_v|^2 / sum c_v
    q = min(NOISE p / sqrt(I), longest)

The line to camera v is known to about a pixel, across d_v, and a patch of the surface covers c_v as many pixels as one
that faces the camera. Of a point on the lines of several views, least squares determine the depth with the variance
p^2 / I: nothing is known of it from one view, or from views in one direction (I = 0), and much from a wide spread.
Where I is different from place to place the lower values count (`QUANTILE`): a facet of a crater may face a camera.

The SDF is replaced near the zero set by the smoothest function that stays close to it (smoothest.py), with weights
(cell / q)^4: a ripple of wavelength 2 pi q is halved. Values where q is less than `LEAST` cells stay as they are. What
is thin, the rim of an ear, would shrink, and what is hollow, above a shoulder, would fill, although masks show it. So
the surface is held (`HELD`) where S > 0 and it went back by more than `BACK` pixels, and where it came to lie outside
of the masks by more than `EDGE` pixels, and the smoothing is repeated.

The fit goes on then, and its noise makes ripples of two or three cells in the same places, which no photo contradicts:
bumps on a jaw that photos from the front show at grazing angles. Shortly before its end they are smoothed once more,
with q of at most `RIPPLE` cells, which moves no outline.

Photos of an arc before a face, held in a hand, are off by more than that: the head moves against the room that the
cameras were solved from. Cheeks and forehead, which have hardly any texture, get wrinkles. Where the head template cut
the hull, plain skin of the face is smoothed for the noise `FACE` at last, and not where lids, nose and lips have their
shape (head_regions.plain_face).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree

from pipeline import transforms
from pipeline.fields.geometry import GridSdf
from pipeline.maths.sdf import unit
from pipeline.registration.head_regions import Near
from stages.inverse_rendering.footprint import footprint, surface_of
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.observations import unoccluded
from stages.inverse_rendering.ray_sampling import PhotoView, factor_for
from stages.inverse_rendering.smoothest import laplacian, solved

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
SMOOTH_AT = (0.35, 0.55)  # shares of the fit: then the colours follow, and the photos correct the outline
AGAIN_UNTIL, AGAIN_EACH, AGAIN = 0.9, 700, 8  # long fits make the noise anew: until then, each so many steps, at most
RIPPLES_AT = 0.93  # the same for the last smoothing
RIPPLE = 0.6  # cells: a ripple of 3.8 cells is halved, of 8 cells 4 % lower
NOISE = 1.5  # pixels that noise may move the surface for I = 1
FACE = 1.0, 4.0  # the same on plain skin of a face before an arc of photos: cells, and the noise in pixels
POINTS = 30_000  # of the surface, some 4 mm apart on a head
NEIGHBOURS, QUANTILE = 16, 1 / 3
TANGENT, EDGE = 0.2, 2.0  # cosine of a surface that a ray grazes; pixels of the fit from the mask's edge
BACK, MISSED, HELD, ROUNDS = 1.5, 2, 16.0, 3  # pixels; views; weight, of q = half a cell; smoothings at most
BAND = 6.0  # cells around the zero set that are solved for
LEAST, MOST = 0.7, 3.0  # cells; a longer q takes far more iterations
ITERATIONS = 120
TINY = 1e-9


def smoothing_shares(steps: int) -> tuple[float, ...]:
    """Shares of a fit of so many steps at which the surface is smoothed."""
    last = SMOOTH_AT[-1]
    count = min(int((AGAIN_UNTIL - last) * steps / AGAIN_EACH), AGAIN)
    return (*SMOOTH_AT, *(last + (AGAIN_UNTIL - last) * (k + 1) / count for k in range(count)))


def smooth_weakly_seen(
    grid: GridSdf, views: Sequence[PhotoView], side: int, longest: float, most: float = np.inf, noise: float = NOISE,
    where: Near | None = None,
) -> float:  # fmt: skip
    """Smooth the zero set where the views hardly determine it, in place. side: pixels, of the photos in the fit;
    longest: largest q, asset units; most: cells to which q is cut where it is longer than `LEAST`; noise: NOISE; where:
    the part that is smoothed, None for all. Returns the share of the surface that was smoothed."""
    start = Start(grid.values.detach().cpu().numpy(), grid.lo.cpu().numpy(), grid.cell)
    x, n = on_surface(grid, surface_of(start, POINTS)[0])
    looked = footprint(start, list(views), side)
    if not len(x) or looked is None:
        return 0.0
    longest = min(longest, MOST * grid.cell)
    length = lengths(information(grid, views, x, n), x, looked.pixel * noise / NOISE, longest) / grid.cell
    length = length if where is None else np.where(where(x), length, 0.0)
    node = np.argwhere(band(start.values, grid.cell))
    nearest = cKDTree(x).query(start.lo + grid.cell * node, workers=-1)[1]
    weak = length[nearest] >= LEAST
    if not weak.any():
        return 0.0
    outline = (outlines(views, x, n, side) > 0)[nearest[weak]]
    values, limit = start.values.astype(np.float64) / grid.cell, BACK * looked.pixel / grid.cell

    def wrong(before: F64, found: F64) -> Bool:
        """(N,) nodes at which the surface must not move so."""
        grown = np.flatnonzero((before > 0) & (found < 0))
        out = outline & (found - before > limit)
        out[grown] |= outside(views, start.lo + grid.cell * node[weak][grown], side) >= MISSED
        return np.asarray(out, np.bool_)

    changed = _smoothed(values, node[weak], np.minimum(length[nearest[weak]], most) ** -4, wrong)
    grid.replace(torch.from_numpy((changed * grid.cell).astype(np.float32)))
    return float((length >= LEAST).mean())


def _smoothed(values: F64, node: npt.NDArray[np.int64], weight: F64, wrong: Callable[[F64, F64], Bool]) -> F64:
    """values (X, Y, Z), in cells, with the nodes node (N, 3) smoothed by weights (N,). wrong: says of values before
    and after which nodes must be held."""
    inside, out = np.zeros(values.shape, np.bool_), values.copy()
    inside[tuple(node.T)] = True  # in the order of node: both are sorted
    before = values[inside]
    found, operator = before, laplacian(inside, values)
    for _ in range(ROUNDS):
        found = solved(operator, weight, before, found, ITERATIONS)
        held = (weight < HELD) & wrong(before, found)
        if not held.any():
            break
        weight = np.where(held, HELD, weight)
    out[inside] = found
    return out


def band(values: npt.NDArray[np.float32], cell: float) -> Bool:
    """(X, Y, Z) nodes near the zero set and not at the grid's faces."""
    near = np.zeros(values.shape, np.bool_)
    near[1:-1, 1:-1, 1:-1] = np.abs(values[1:-1, 1:-1, 1:-1]) < BAND * cell
    return near


def lengths(information: F64, x: F64, pixel: float, longest: float) -> F64:
    """q (N,) at points x (N, 3) with I (N,), in the unit of pixel and longest."""
    count = min(NEIGHBOURS, len(x))
    near = cKDTree(x).query(x, k=count, workers=-1)[1].reshape(len(x), count)
    low = np.sort(information[near], axis=1)[:, int(QUANTILE * (count - 1))]
    return np.asarray(np.minimum(NOISE * pixel / np.sqrt(np.maximum(low, TINY)), longest), np.float64)


def information(grid: GridSdf, views: Sequence[PhotoView], x: F64, n: F64) -> F64:
    """I (N,) at points x with unit normals n, (N, 3)."""
    total, mean = np.zeros(len(x)), np.zeros((len(x), 3))
    for view in views:
        seen, cosine, toward = seen_by(grid, view, x, n)
        total[seen] += cosine
        mean[seen] += cosine[:, None] * toward
    return np.asarray(np.maximum(total - (mean**2).sum(1) / np.maximum(total, TINY), 0.0), np.float64)


def outlines(views: Sequence[PhotoView], x: F64, n: F64, side: int) -> F64:
    """S (N,) at points x with unit normals n, (N, 3)."""
    total = np.zeros(len(x))
    for view in views:
        subject, window = _reached(view, side)
        edge = (cv2.dilate(subject, window) > cv2.erode(subject, window)) & _counting(view)
        cosine = (_directions(view, x)[0] * n).sum(1)
        total += (np.abs(cosine) < TANGENT) & _looked_up(edge, view, x)
    return total


def outside(views: Sequence[PhotoView], x: F64, side: int) -> npt.NDArray[np.int64]:
    """(N,) number of views in which points x (N, 3) lie more than `EDGE` pixels outside of a mask that counts."""
    total = np.zeros(len(x), np.int64)
    for view in views:
        beyond = (cv2.dilate(*_reached(view, side)) == 0) & _counting(view)
        total += _looked_up(beyond, view, x)
    return total


def _reached(view: PhotoView, side: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """(H, W) 1 on the subject, and the window that reaches `EDGE` pixels of the fit."""
    reach = round(EDGE * factor_for(view.size, side))
    return (view.alpha > 0.5).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _counting(view: PhotoView) -> Bool:
    """(H, W) pixels that count in the fit."""
    out = np.ones(view.alpha.shape, np.bool_) if view.asked is None else view.asked > 0.5
    return out if view.doubtful is None else out & ~view.doubtful


def _looked_up(pixels: Bool, view: PhotoView, x: F64) -> Bool:
    """(N,) the values of a picture (H, W) at points x (N, 3); False outside of it."""
    uv, _ = transforms.project(view.K, transforms.inverse_rigid(view.world_from_cam), view.distortion, x)  # NaN: behind
    at = np.floor(np.nan_to_num(uv, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64)
    framed = np.asarray((at >= 0).all(1) & (at < view.size).all(1))
    column, row = np.where(framed[:, None], at, 0).T
    return np.asarray(framed & pixels[row, column], np.bool_)


def _directions(view: PhotoView, x: F64) -> tuple[F64, F64]:
    """Unit directions (N, 3) from points x (N, 3) to the camera, and distances (N,)."""
    away = view.world_from_cam[:3, 3] - x
    distance = np.linalg.norm(away, axis=1)
    return away / np.maximum(distance, TINY)[:, None], distance


def seen_by(grid: GridSdf, view: PhotoView, x: F64, n: F64) -> tuple[npt.NDArray[np.int64], F64, F64]:
    """Indices of the points that a view sees where it counts, their c and d."""
    toward, distance = _directions(view, x)
    cosine = (toward * n).sum(1)
    seen = np.flatnonzero((cosine > 0) & _looked_up((view.alpha > 0.5) & _counting(view), view, x))
    if len(seen):
        seen = seen[unoccluded(grid, view.world_from_cam[:3, 3], toward[seen], distance[seen], grid.lo)]
    return seen, cosine[seen], toward[seen]


def on_surface(grid: GridSdf, near: F64) -> tuple[F64, F64]:
    """Points near the zero set, (N, 3), moved onto it by one Newton step, and their unit normals."""
    x = torch.from_numpy(near.astype(np.float32)).to(grid.lo)
    with torch.no_grad():
        s, g = grid(x)
        x = x - s[:, None] * g / (g * g).sum(-1, keepdim=True).clamp(min=0.25)
        n = unit(grid(x)[1])
    return x.cpu().double().numpy(), n.cpu().double().numpy()
