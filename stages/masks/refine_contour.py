"""The contour of a cut-out drawn anew by what is right beside it.

Colours of the whole subject against those of the whole background (grabCut) take a highlight at the subject's edge for
background: its colour is nowhere else in the subject, and somewhere in the background. Beside that edge, though, the
background goes on as it was. So around the contour, from `REACH` outside it to a few pixels inside,

    background at x costs   min( 1/2 min( |c - b|^2 / (s^2 + k v), d_out^2 ), MAX_COST )
    subject at x costs      min( 1/2 d_in^2, STRANGE )
    d^2                     min_i |c - c_i|^2 / s^2 + |x - x_i|^2 / r^2

c: colour at x, of 255, a little blurred. b, v: the background beyond the strip continued to x, affine in place, and the
variance about that. c_i: colours that the photo has near x further outside (d_out), further inside (d_in). s: what
colours may differ by, the photo's noise included. A colour that neither side knows is the subject's: what a surface
shows at its edge it need not show elsewhere. Neighbours cost what the other side takes the less they differ, and the
least cut decides. Where the background varies as much as the subject differs from it, or the photo is loud, the
contour stays. What it is worth is in docs/captures.md, 'Contours'.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.least_cut import ENDLESS, I32, I64, least_cut
from stages.masks.region import F32, U8, Bool

REACH = 14 / 640  # of the longest edge: how much may be missing
INWARD = 3  # pixels of the contour's inside that are open
DEPTH = 2.5  # reaches (inwards: of INWARD, and 4 pixels) within which a side is asked for its colours
CONTINUED = 0.6  # reaches: the width of the window that continues the background
LEVELS = 4.0  # s without noise, of 255
NOISE = 2.0  # what the photo's noise counts for in s
LOUD = 2.5  # noise from which colours beside the contour tell less than those of all; about 6 before the blur
VARIED = 9.0  # k
NEAR = 25 / 640  # r, of the longest edge
MAX_COST, STRANGE = 6.0, 2.0
TOGETHER, CONTRAST, MIN_TOGETHER = 4.0, 6.0, 0.15  # cost of parting neighbours: at equal colours, its scale, its end
UNIT = 100.0  # costs in whole numbers
BLUR = 0.7  # pixels
FEWEST = 50  # pixels that a side must have to be asked
SPECK, HOLE = 20, 200  # pixels: smaller parts outside and holes inside are mistakes
SLOPE = 0.1  # of the window's own variance: what holds a slope back
STEPS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.7), (1, -1, 0.7))  # to half the neighbours, and their weight


def refined_contour(image: U8, inside: Bool) -> Bool:
    """A hard mask (h, w) with a better contour. image: (h, w, 3) 8-bit sRGB, of the mask's own size.

    The mask comes back as it is if the photo shows too little of either side, or is too noisy. Pixels that both share
    are inside: how much of them is the subject is for soft_edge to say (matting.py).
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
    """Pixels to the nearest pixel that is not there, 0 for such."""
    return np.asarray(cv2.distanceTransform(where.astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _window(near: Bool, inside: Bool) -> tuple[slice, slice] | None:
    """Rows and columns of what is near; None where there is no contour."""
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
    behind = np.minimum(0.5 * np.minimum(off, _strange(seen, open_, outer, spread, near, MAX_COST)), MAX_COST)
    own = np.minimum(0.5 * _strange(seen, open_, inner, spread, near, STRANGE), STRANGE)
    pull = np.round(UNIT * (behind - own)).astype(np.int32)
    pull[(far_in > INWARD - 1)[open_]] = ENDLESS
    pull[(far_out > reach - 1)[open_]] = -ENDLESS
    out = far_in > INWARD
    a, b, cost = _neighbours(seen, open_)
    out[open_] = least_cut(a, b, cost, pull)
    return out


def _noise(seen: F32, where: Bool) -> float:
    """Robust deviation of a picture from its own surroundings."""
    rough = (seen - np.asarray(cv2.GaussianBlur(seen, (0, 0), 2.0)))[where]
    return 1.4826 * float(np.median(np.abs(rough))) if len(rough) else 0.0


def _strange(seen: F32, of: Bool, known: Bool, spread: float, near: float, most: float) -> F32:
    """d^2 of the pixels `of` from every other pixel and row of `known`; inf where half of it exceeds `most`."""
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
    """The colours `known` continued to everywhere: at each pixel the value there of the affine function of place that
    is nearest to them under a Gaussian window; the variance about it; where anything is known.

    colour: (h, w, 3). sigma: of the window, pixels. Slopes are held back by SLOPE, so that where little is known, or
    on one side alone, it is nearer to the mean. Worked out at half the size. Source: local regression, textbook.
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
    """Weighted sums to a local affine function: its value in the middle (h, w, 3), variance about it, sum of weights.

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
    middle = mean - sx * x[..., None] - sy * y[..., None]
    variance = moment(square, 0, 0) / n - (mean * mean + sx * cx + sy * cy).mean(-1)
    return np.asarray(middle, np.float32), np.asarray(np.maximum(variance, 0), np.float32), total


def _neighbours(seen: F32, open_: Bool) -> tuple[I64, I64, I32]:
    """Pairs of open pixels that touch, by their numbers among the open ones, and what parting them costs."""
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
    """Without parts that the old mask hardly knew, small holes closed."""
    count, label = cv2.connectedComponents(out.astype(np.uint8), connectivity=4)
    overlap = np.bincount(np.asarray(label)[inside & out], minlength=count)
    overlap[0] = 0
    kept = (overlap > SPECK)[label]
    _, label, stats, _ = cv2.connectedComponentsWithStats((~kept).astype(np.uint8), connectivity=4)
    open_ = stats[:, cv2.CC_STAT_AREA] >= HOLE
    open_[0] = False
    return np.asarray(~open_[label], bool)
