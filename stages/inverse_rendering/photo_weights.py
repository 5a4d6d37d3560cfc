"""How much each photo and each part of it counts in the fit, from the residuals of the fit's rays.

    E = max(m_q h_b, s_v),   z_c = sum of a over c / sum of E over c,   r = ln(z / median z) / sigma,
    w = min((nu + 1) / (nu + r^2), 1) where r > 0, else 1

Symbols: a the absolute residual of a ray, sRGB, mean over the channels; q a place of the surface, v a photo, c a cell
of a photo; m_q the median over the photos of q's mean residual; b how far the surface faces the camera, h_b the factor
of the residual at such angles; s_v the least residual that counts, from the photo's noise and the median residual of
all places; sigma the spread of ln z, from its median absolute deviation.

A residual is compared with those of the other photos at the same place of the surface. Where shape or material are
wrong, all photos of the place have a large residual and keep their weight, so that the fit can mend it. A hand, a moved
shadow or a flash in glasses is in few photos. Source: ours; the weight is Student's t (pipeline.maths.student).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.maths.student import student_weight

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
CELLS = 32  # cells along the longest side of a photo
FACINGS = 4  # classes of the cosine between normal and direction to the camera
FEWEST_PHOTOS = 4  # of a place: with fewer, nothing tells which one is wrong
FEWEST_PAIRS = 30  # of place and photo, for the factor of a class
FEWEST_RAYS = 2  # of a place in one photo
FEWEST_IN_CELL = 4  # rays of a cell that takes part in medians
PRIOR_RAYS = 6.0  # a cell's ratio is drawn towards its photo's as if by so many rays
LARGEST = 1.0  # residual, sRGB: more is not told apart
NU, NU_MOVES = 4.0, 1.5  # degrees of freedom; the second where labels say that things move
LEAST = 0.1  # smallest weight: a photo that is right after all must be able to come back
# Smallest sigma of cells and of photos. On a finished draft of a scanned head without fault, .2 for the cells gave 5 %
# of them a low weight, .4 gave 1.6 %; of bars painted into six photos both found more than 99 %.
LEAST_SPREAD, LEAST_SPREAD_OF_PHOTOS = 0.4, 0.2
LOW = 0.5  # weights below it are reported as low
MAD = 1.4826  # standard deviation over median absolute deviation, of a Gaussian


@dataclass(frozen=True, slots=True)
class Residuals:
    """N rays: residual (N,) sRGB; place (N,) of the surface, facing (N,) class of its angle in 0 .. FACINGS - 1, view
    (N,) position of the photo in the fit, cell (N,) of the photo, row by row in 0 .. CELLS^2 - 1."""

    residual: F64
    place: I64
    facing: I64
    view: I64
    cell: I64


@dataclass(frozen=True, slots=True)
class Weights:
    """view (V,) weight of each photo; cell (V, CELLS, CELLS) weight of its cells relative to it; rays (V, CELLS, CELLS)
    number of rays in each cell."""

    view: F64
    cell: F64
    rays: F64

    @property
    def table(self) -> F64:
        """(V, CELLS, CELLS) the weight of each cell's rays."""
        return np.maximum(self.view[:, None, None] * self.cell, LEAST)

    def of_photos(self) -> tuple[F64, F64]:
        """(V,) mean weight over the rays of each photo, and (V,) share of its rays with a low one; 1 and 0 of a photo
        without rays."""
        count = self.rays.sum((1, 2))
        known = np.maximum(count, 1)
        mean = (self.rays * self.table).sum((1, 2)) / known
        low = (self.rays * (self.table < LOW)).sum((1, 2)) / known
        return np.where(count > 0, mean, 1.0), low


def all_alike(views: int) -> Weights:
    """Weight 1 everywhere."""
    grid = np.ones((views, CELLS, CELLS))
    return Weights(np.ones(views), grid, np.zeros_like(grid))


def weigh(seen: Residuals, noise: F64, moves: F64) -> Weights:
    """The weights. noise: (V,) standard deviation of each photo's noise, sRGB. moves: (V, CELLS, CELLS) share of each
    cell in which labels say that things move."""
    views = len(noise)
    a = np.fmin(seen.residual, LARGEST)  # NaN becomes the largest too
    expected = expected_residuals(seen, a, noise)
    known = np.isfinite(expected)
    place, shape = (seen.view * CELLS**2 + seen.cell)[known], (views, CELLS, CELLS)
    total, usual, rays = (
        np.bincount(place, w, views * CELLS**2).reshape(shape).astype(np.float64)
        for w in (a[known], expected[known], None)
    )
    full = rays >= FEWEST_IN_CELL
    if not full.any() or not np.median(total[full] / usual[full]) > 0:
        return all_alike(views)
    of_view = _ratio_of_views(total, usual, full)
    centre = float(np.median(of_view[full.any((1, 2))]))
    own = np.log(of_view / centre)
    view = student_weight(np.maximum(own, 0) / _spread(own[full.any((1, 2))], LEAST_SPREAD_OF_PHOTOS), NU)
    # a photo that is better than most must not have its usual cells called bad
    base = np.maximum(of_view, centre)
    off = np.log(_smoothed_ratio(total, usual, rays, of_view) / base[:, None, None])
    cell = student_weight(np.maximum(off, 0) / _spread(off[full], LEAST_SPREAD), NU + (NU_MOVES - NU) * moves)
    return Weights(np.maximum(view, LEAST), np.maximum(cell, LEAST), rays)


def expected_residuals(seen: Residuals, a: F64, noise: F64) -> F64:
    """(N,) E of each ray; NaN where too few photos show its place."""
    views = len(noise)
    pairs, of = np.unique(seen.place * views + seen.view, return_inverse=True)
    count = np.bincount(of)
    mean = np.bincount(of, a) / count
    facing = np.rint(np.bincount(of, seen.facing) / count).astype(np.int64)
    place = pairs // views
    sure = count >= FEWEST_RAYS
    out = np.full(len(a), np.nan)
    if not sure.any():
        return out
    factor = np.ones(FACINGS)
    for _ in range(2):  # the medians of places seen at several angles need the factors, and these the medians
        median = _medians(place[sure], mean[sure] / factor[facing[sure]], int(place.max()) + 1)
        ratio = mean / np.maximum(median[place], 1e-9)
        for b in range(FACINGS):
            here = ratio[sure & (facing == b) & np.isfinite(ratio)]
            factor[b] = max(float(np.median(here)), 1e-3) if len(here) >= FEWEST_PAIRS else 1.0
    least = np.maximum(noise * np.sqrt(2 / np.pi), max(float(np.median(mean[sure])), 1e-6))
    usual = median[place] * factor[facing]
    return np.asarray(np.maximum(usual, least[pairs % views])[of], np.float64)


def _medians(group: I64, values: F64, count: int) -> F64:
    """(count,) median of the values (N,) of each group; NaN for those with fewer than FEWEST_PHOTOS."""
    order = np.lexsort((values, group))
    ordered = values[order]
    ends = np.searchsorted(group[order], np.arange(count + 1))
    first, n = ends[:-1], np.diff(ends)
    out = np.full(count, np.nan)
    enough = n >= FEWEST_PHOTOS
    low, high = first[enough] + (n[enough] - 1) // 2, first[enough] + n[enough] // 2
    out[enough] = (ordered[low] + ordered[high]) / 2
    return out


def _ratio_of_views(total: F64, usual: F64, full: npt.NDArray[np.bool_]) -> F64:
    """(V,) median of z over the full cells of each photo; 1 without one."""
    out = np.ones(len(total))
    for v, cells in enumerate(full):
        if cells.any():
            out[v] = max(float(np.median(total[v][cells] / usual[v][cells])), 1e-6)
    return out


def _smoothed_ratio(total: F64, usual: F64, rays: F64, of_view: F64) -> F64:
    """(V, CELLS, CELLS) z over a cell and its neighbours with binomial weights 1 2 1."""
    out = np.empty_like(total)
    for v, (a, e, n) in enumerate(zip(total, usual, rays, strict=True)):
        per_ray = float(e.sum()) / max(float(n.sum()), 1.0) or 1.0  # 1.0: a photo without rays
        drawn = PRIOR_RAYS * per_ray
        near_a, near_e = (cv2.GaussianBlur(g, (3, 3), 0, borderType=cv2.BORDER_CONSTANT) * 4 for g in (a, e))
        out[v] = (near_a + drawn * of_view[v]) / (near_e + drawn)
    return out


def _spread(off: F64, least: float) -> float:
    """Robust standard deviation of logarithms (N,), at least `least`."""
    return max(MAD * float(np.median(np.abs(off - np.median(off)))), least)
