"""Contour refinement by a minimum cut with local colour models.

GrabCut's colour models of the whole subject and the whole background take a highlight at the subject's edge for
background: its colour is nowhere else in the subject, but somewhere in the background. The background next to the edge,
however, does not change there. So in a strip from `REACH` outside the contour to a few pixels inside,

    background at x costs   min( 1/2 min( |c - b|^2 / (s^2 + k v), d_out^2 ), MAX_COST )
    subject at x costs      min( 1/2 d_in^2, STRANGE )
    d^2                     min_i |c - c_i|^2 / s^2 + |x - x_i|^2 / r^2

c: colour at x, of 255, slightly blurred. b, v: the background outside the strip extrapolated to x by an affine
function, and its variance. c_i: colours near x further outside (d_out) or further inside (d_in). s: tolerance of
colours, including the photo's noise. A colour that is on neither side is the subject's, because the edge of a surface
may look different from the rest. Separating two neighbours costs the more the less they differ; the minimum cut
decides. If the background varies as much as the subject differs from it, or the photo is noisy, the contour is
unchanged. Accuracy: docs/captures.md, 'Contours'.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.least_cut import ENDLESS, I32, I64, least_cut
from stages.masks.region import F32, U8, Bool

REACH = 14 / 640  # of the longest edge: width of the undecided strip outside the contour
INWARD = 3  # pixels: width of the undecided strip inside the contour
DEPTH = 2.5  # width of the colour samples, in reaches (inwards: of INWARD, plus 4 pixels)
CONTINUED = 0.6  # reaches: width of the window that extrapolates the background
LEVELS = 4.0  # s without noise, of 255
NOISE = 2.0  # weight of the photo's noise in s
LOUD = 2.5  # largest noise at which local colours are better than global ones; about 6 before the blur
VARIED = 9.0  # k
NEAR = 25 / 640  # r, of the longest edge
MAX_COST, STRANGE = 6.0, 2.0
TOGETHER, CONTRAST, MIN_TOGETHER = 4.0, 6.0, 0.15  # cost of separating neighbours: at equal colours, scale, minimum
UNIT = 100.0  # factor from costs to integers
BLUR = 0.7  # pixels
FEWEST = 50  # pixels: fewest colour samples of a side
SPECK, HOLE = 20, 200  # pixels: smaller components and smaller holes are removed
SLOPE = 0.1  # of the window's variance: regularisation of the slope
STEPS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.7), (1, -1, 0.7))  # to half the neighbours, and their weight


def refined_contour(image: U8, inside: Bool) -> Bool:
    """A hard mask (h, w) with a better contour. inside: (h, w). image: (h, w, 3) 8-bit sRGB.

    The mask is returned unchanged if the photo shows too little of either side, or is too noisy. Mixed pixels are
    inside; matting.soft_edge computes their alpha.
    """
    reach = max(4, round(REACH * max(inside.shape)))
    far_out, far_in = _distance(~inside), _distance(inside)
    room = int(np.ceil(DEPTH * reach)) + 2
    window = _window(far_out <= room, inside)
    if window is None:
        return inside
    part = _cut(image[window], far_out[window], far_in[window], reach, NEAR * max(inside.shape))
    if part is None:
        return inside
    out = inside.copy()
    out[window] = part
    return _tidy(out, inside)


def _distance(where: Bool) -> F32:
    """(h, w) distance in pixels to the nearest pixel outside `where`; 0 there."""
    return np.asarray(cv2.distanceTransform(where.astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _window(near: Bool, inside: Bool) -> tuple[slice, slice] | None:
    """Bounding rows and columns of `near`; None if there is no contour."""
    if not inside.any() or inside.all():
        return None
    rows, columns = np.flatnonzero(near.any(1)), np.flatnonzero(near.any(0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _cut(image: U8, far_out: F32, far_in: F32, reach: int, near: float) -> Bool | None:
    open_ = (far_out <= reach) & (far_in <= INWARD)
    outer = (far_out > reach) & (far_out <= DEPTH * reach + 2)
    inner = (far_in > INWARD) & (far_in <= DEPTH * INWARD + 4)
    if min(outer.sum(), inner.sum(), open_.sum()) < FEWEST:
        return None
    colour = image.astype(np.float32)
    seen = np.asarray(cv2.GaussianBlur(colour, (0, 0), BLUR), np.float32)
    noise = _noise(seen, far_out > reach)
    if noise > LOUD:
        return None
    spread = float(np.hypot(LEVELS, NOISE * noise))
    background, variance, known = continued(colour, far_out > reach, CONTINUED * reach)
    off = ((seen - background) ** 2 / (spread**2 + VARIED * variance)).sum(-1)
    off = np.where(known, off, 0)[open_]
    behind = np.minimum(0.5 * np.minimum(off, unlike(seen, open_, outer, spread, near, MAX_COST)), MAX_COST)
    own = np.minimum(0.5 * unlike(seen, open_, inner, spread, near, STRANGE), STRANGE)
    pull = np.round(UNIT * (behind - own)).astype(np.int32)
    pull[(far_in > INWARD - 1)[open_]] = ENDLESS
    pull[(far_out > reach - 1)[open_]] = -ENDLESS
    out = far_in > INWARD
    a, b, cost = _neighbours(seen, open_)
    out[open_] = least_cut(a, b, cost, pull)
    return out


def _noise(seen: F32, where: Bool) -> float:
    """Robust standard deviation of a picture from its blurred copy."""
    rough = (seen - np.asarray(cv2.GaussianBlur(seen, (0, 0), 2.0)))[where]
    return 1.4826 * float(np.median(np.abs(rough))) if len(rough) else 0.0


def unlike(seen: F32, of: Bool, known: Bool, spread: float, near: float, most: float) -> F32:
    """d^2 of the pixels `of` from `known`, of which every second pixel and row is used; inf if half of it exceeds
    `most`."""
    from scipy.spatial import cKDTree

    some = known.copy()
    some[1::2] = some[:, 1::2] = False
    if not some.any():
        some = known

    def places(where: Bool) -> F32:
        return np.concatenate([np.argwhere(where) / near, seen[where] / spread], 1).astype(np.float32)

    distance, _ = cKDTree(places(some)).query(places(of), distance_upper_bound=float(np.sqrt(2 * most)))
    return np.asarray(distance**2, np.float32)


def continued(colour: F32, known: Bool, sigma: float) -> tuple[F32, F32, Bool]:
    """The colours of the pixels `known` (h, w), extrapolated by local affine regression with a Gaussian window.

    Returns the colours (h, w, 3), the variance (h, w, 1) about the regression, and where any colour is known (h, w).
    colour: (h, w, 3). sigma: of the window, pixels. Slopes are regularised by SLOPE towards the mean, for places with
    few samples or samples on one side. Computed at half the size. Source: local regression, textbook.
    """
    h, w = known.shape
    small = (max(w // 2, 1), max(h // 2, 1))

    def halved(a: F32) -> F32:
        return np.asarray(cv2.resize(a, small, interpolation=cv2.INTER_AREA), np.float32)

    weight = known.astype(np.float32)
    square = np.asarray((colour * colour).mean(-1), np.float32)
    mean, var, total = _regression(
        halved(weight), halved(colour * weight[..., None]), halved(square * weight), sigma / 2
    )

    def back(a: F32) -> F32:
        return np.asarray(cv2.resize(a, (w, h), interpolation=cv2.INTER_LINEAR), np.float32)

    return back(mean), back(var)[..., None], back(total) > 1e-3


def _regression(weight: F32, value: F32, square: F32, sigma: float) -> tuple[F32, F32, F32]:
    """Local affine regression: its value at the centre (h, w, 3), variance about it (h, w), sum of weights (h, w).

    weight: (h, w); value, square: weight times colour (h, w, 3) and mean squared colour (h, w).
    """
    r = int(np.ceil(3 * sigma))
    t = np.arange(-r, r + 1, dtype=np.float32) / np.float32(sigma)
    g = np.exp(-0.5 * t * t)
    g /= g.sum()

    def moment(x: F32, down: int, across: int) -> F32:
        kernels = g * t**across, g * t**down
        return np.asarray(cv2.sepFilter2D(x, -1, *kernels, borderType=cv2.BORDER_CONSTANT), np.float32)

    total = moment(weight, 0, 0)
    n = np.maximum(total, 1e-6)
    x, y = moment(weight, 0, 1) / n, moment(weight, 1, 0) / n
    xx, yy = moment(weight, 0, 2) / n - x * x + SLOPE, moment(weight, 2, 0) / n - y * y + SLOPE
    xy = moment(weight, 1, 1) / n - x * y
    mean = moment(value, 0, 0) / n[..., None]
    cx = moment(value, 0, 1) / n[..., None] - x[..., None] * mean
    cy = moment(value, 1, 0) / n[..., None] - y[..., None] * mean
    det = (xx * yy - xy * xy)[..., None]
    sx, sy = (yy[..., None] * cx - xy[..., None] * cy) / det, (xx[..., None] * cy - xy[..., None] * cx) / det
    centre = mean - sx * x[..., None] - sy * y[..., None]
    variance = moment(square, 0, 0) / n - (mean * mean + sx * cx + sy * cy).mean(-1)
    return np.asarray(centre, np.float32), np.asarray(np.maximum(variance, 0), np.float32), total


def _neighbours(seen: F32, open_: Bool) -> tuple[I64, I64, I32]:
    """Pairs of neighbouring undecided pixels, by their indices among these pixels, and the cost of separating them."""
    number = np.full(open_.shape, -1)
    number[open_] = np.arange(int(open_.sum()))
    h, w = open_.shape
    first, second, cost = [], [], []
    for down, across, weight in STEPS:
        here = slice(0, h - down), slice(max(-across, 0), w - max(across, 0))
        there = slice(down, h), slice(max(across, 0), w - max(-across, 0))
        both = open_[here] & open_[there]
        differ = ((seen[here] - seen[there])[both] ** 2).sum(-1)
        alike = MIN_TOGETHER + (1 - MIN_TOGETHER) * np.exp(-differ / (2 * CONTRAST**2))
        first.append(number[here][both])
        second.append(number[there][both])
        cost.append(np.round(UNIT * TOGETHER * weight * alike).astype(np.int32))
    return np.concatenate(first), np.concatenate(second), np.concatenate(cost)


def _tidy(out: Bool, inside: Bool) -> Bool:
    """The new mask (h, w) without components that hardly overlap the old one, and with small holes filled."""
    count, label = cv2.connectedComponents(out.astype(np.uint8), connectivity=4)
    overlap = np.bincount(np.asarray(label)[inside & out], minlength=count)
    overlap[0] = 0
    kept = (overlap > SPECK)[label]
    _, label, stats, _ = cv2.connectedComponentsWithStats((~kept).astype(np.uint8), connectivity=4)
    open_ = stats[:, cv2.CC_STAT_AREA] >= HOLE
    open_[0] = False
    return np.asarray(~open_[label], bool)
