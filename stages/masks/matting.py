"""Matting: alpha of edge pixels from the colours on both sides of the edge.

    c = alpha F + (1 - alpha) B        linear light, F and B the mean colours just inside and just outside

is solved for alpha by least squares. Where F and B hardly differ, or no mixture of them is the pixel's colour, the
blurred hard edge is used. Loose hair makes the edge wider than that: between a contour that leaves it out and one that
takes it in, B is the background continued from outside, and F the mean colour of the subject nearby.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from stages.masks.refine_contour import continued
from stages.masks.region import F32, LINEAR, U8, Bool, dilated, eroded

CONTRAST = 0.03  # difference of F and B, linear, at which colour and blurred edge have equal weight
NOISE = 8.0  # weight of the colours' variance relative to their difference
NEITHER = 16.0  # weight of what no mixture of both explains: a highlight at the edge
SNAP = 0.04  # alphas this close to 0 or 1 are noise
MARGIN = 2  # pixels beyond both contours that are matted with what is between them
NEARBY = 9  # pixels: half-edge of the window of F; twice that where it holds nothing of the subject
STRIP = 1 << 20  # pixels of an edge's box that are matted at once: a hundred bytes each
BEHIND = 8.5  # pixels: width of the window that continues the background


def soft_edge(image: U8, inside: Bool, radius: int) -> F32:
    """Alpha (H, W) of a hard mask (H, W) with a contour accurate to `radius` pixels. image: (H, W, 3) 8-bit sRGB."""
    alpha = inside.astype(np.float32)
    inner, outer = eroded(inside, radius), eroded(~inside, radius)
    band = ~(inner | outer)
    if not band.any():
        return alpha
    rows, columns = np.flatnonzero(band.any(1)), np.flatnonzero(band.any(0))
    room = 3 * radius + 2
    window = (slice(max(rows[0] - room, 0), min(rows[-1] + room + 1, len(inside))),
              slice(max(columns[0] - room, 0), min(columns[-1] + room + 1, inside.shape[1])))  # fmt: skip
    for wide, kept in _strips(window[0], STRIP // (window[1].stop - window[1].start), room):
        place = (wide, window[1])
        found = _solve(LINEAR[image[place]], inside[place], inner[place], outer[place], radius)
        alpha[kept, window[1]] = found[kept.start - wide.start : kept.stop - wide.start]
    return alpha


def _strips(rows: slice, step: int, room: int) -> Iterator[tuple[slice, slice]]:
    """Rows in strips of at least `room` rows: those that a strip needs, `room` more to either side, and those that it
    gives."""
    for first in range(rows.start, rows.stop, max(step, room, 1)):
        end = min(first + max(step, room, 1), rows.stop)
        yield slice(max(first - room, rows.start), min(end + room, rows.stop)), slice(first, end)


def between(image: U8, narrow: Bool, wide: Bool) -> F32:
    """Alpha (H, W) where only one of two hard masks (H, W) has the subject, and MARGIN pixels beyond; elsewhere 0 or 1.
    image: (H, W, 3) 8-bit sRGB. Where colours don't tell, `wide` is right."""
    core, outside = eroded(narrow & wide, MARGIN), ~dilated(wide, MARGIN)
    if (core | outside).all() or not core.any() or not outside.any():
        return wide.astype(np.float32)
    colour = LINEAR[image]
    mean, variance, known = continued(colour, outside, BEHIND)
    alpha = _blend(colour, mean_near(colour, core, NEARBY, 2 * NEARBY), (mean, variance[..., 0], known), wide)
    return np.asarray(np.where(core, 1, np.where(outside, 0, alpha)), np.float32)


def _solve(colour: F32, inside: Bool, inner: Bool, outer: Bool, radius: int) -> F32:
    foreground = _within(colour, inner, 2 * radius + 1)
    alpha = _blend(colour, foreground, _within(colour, outer, 2 * radius + 1), inside)
    alpha = np.where(alpha < SNAP, 0, np.where(alpha > 1 - SNAP, 1, alpha))
    return np.asarray(np.where(inner, 1, np.where(outer, 0, alpha)), np.float32)


def _blend(colour: F32, f: tuple[F32, F32, Bool], b: tuple[F32, F32, Bool], inside: Bool) -> F32:
    """Alpha (H, W) from the colours of subject `f` and background `b`, their variances and where they are known; where
    these don't tell, that of the blurred hard mask `inside` (H, W)."""
    (foreground, noise_f, has_f), (background, noise_b, has_b) = f, b
    difference = foreground - background
    square = _dot(difference, difference)
    by_colour = (_dot(colour - background, difference) / np.maximum(square, 1e-6)).clip(0, 1)
    rest = colour - background - by_colour[..., None] * difference
    doubt = CONTRAST**2 + NOISE * (noise_f + noise_b) + NEITHER * _dot(rest, rest)
    trust = np.where(has_f & has_b, square / (square + doubt), 0.0)
    blurred = np.asarray(cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 0.7), np.float32)
    return np.asarray(trust * by_colour + (1 - trust) * blurred, np.float32)


def _dot(a: F32, b: F32) -> F32:
    """(H, W) dot products of (H, W, 3) colours; several times faster than a sum over a short axis."""
    return np.asarray(np.einsum("ijk,ijk->ij", a, b), np.float32)


def mean_near(colour: F32, where: Bool, reach: int, further: int) -> tuple[F32, F32, Bool]:
    """Mean colour (H, W, 3) and variance (H, W) of the pixels `where` (H, W) within `reach`, or within `further` where
    there are none; and whether any exist."""
    close, far = _within(colour, where, reach), _within(colour, where, further)
    return np.where(close[2][..., None], close[0], far[0]), np.where(close[2], close[1], far[1]), far[2]


def _within(colour: F32, where: Bool, reach: int) -> tuple[F32, F32, Bool]:
    """Mean colour (H, W, 3) and variance (H, W) of the pixels `where` (H, W) within `reach`, and whether any exist."""
    size = (2 * reach + 1, 2 * reach + 1)
    weight = where.astype(np.float32)
    square = _dot(colour, colour)
    stack = np.dstack([weight, square * weight, colour * weight[..., None]])
    total = np.asarray(cv2.boxFilter(stack, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT), np.float32)
    count = np.maximum(total[..., 0], 1)
    mean = np.asarray(total[..., 2:] / count[..., None], np.float32)
    return mean, np.asarray(np.maximum(total[..., 1] / count - _dot(mean, mean), 0), np.float32), total[..., 0] > 0.5


def largest_parts(inside: Bool, share: float) -> Bool:
    """The mask (H, W) without connected components smaller than `share` of its largest one."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=8)
    if count <= 2:
        return inside
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    area[0] = 0
    return np.asarray((area >= share * area.max())[label])
