"""Background that a mask took for the subject, as the other masks show it.

A ray beyond the visual hull of all masks meets no place that each of them calls the subject: the wall between a chin
and a chest, a part of the turntable. The hull errs too: what one mask lacks, it lacks in every view. So the colours
must agree. A region beyond the hull is cut off where its mean of

    min(d_in^2 / 2, MOST) - min(d_out^2 / 2, MOST)

is above 0: it is more like the background next to it than like the subject next to it. Where the colours are alike, the
background is nearer, so that the hull is believed. d: stages.masks.refine_contour, against samples of the mask deep
inside of the hull (d_in) and of what is outside of the mask (d_out). In such a region a pixel stays if it is clearly
the subject's (below -OWN); between it and the hull's outline, if it is not above 0. Accuracy: docs/captures.md,
Contours.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress

import cv2
import numpy as np

from pipeline.artifacts import Camera
from pipeline.hull import Cloud, cloud, render_silhouette, visual_hull
from pipeline.hull_needs import regions
from pipeline.support import Support
from stages.masks.hull_consistency import CUBE, POSSIBLE, above
from stages.masks.refine_contour import BLUR, FEWEST, unlike
from stages.masks.region import F32, U8, Bool, Disc, dilated, eroded
from stages.masks.sources import to_full_size

LEAST = 0.0005  # of a mask: smaller regions are noise of its outline
SPREAD, NEAR, MOST = 16.0, 40 / 640, 6.0  # s of 255, r of the longest edge, and the cost at which colours are strangers
AROUND = 60 / 640  # of the longest edge: how far from a region its neighbours are
OWN = 1.0  # by which a pixel of a region that is cut off must be more like the subject to stay
CLEAR = 2  # pixels outside of the mask's outline where samples of the background begin


def strict_hull(
    cameras: Sequence[Camera], alphas: Sequence[F32], votes: Sequence[bool], roi_radius: float, cells: int,
    support: Support | None,
) -> Cloud:  # fmt: skip
    """The hull of what all voting masks call the subject or do not see. alphas: (h, w) each.
    cells: voxels per edge of the cube. support: the subject is above this plane."""
    edge = CUBE * roi_radius
    hull = visual_hull(list(compress(cameras, votes)), list(compress(alphas, votes)), [-edge] * 3, [edge] * 3,
                       2 * edge / cells, min_views=0)  # fmt: skip
    return cloud(above(support, hull))


def limits(hull: Cloud, camera: Camera, disc: Disc, roi_radius: float, shape: tuple[int, int]) -> tuple[Bool, int]:
    """The hull's silhouette (h, w), with all where the hull was not carved, and a voxel in pixels of it. disc: the
    region of interest at this size. shape: h, w."""
    silhouette = render_silhouette(hull, camera, *shape) >= 0.5
    return silhouette | ~disc.covers(*shape, POSSIBLE), max(1, round(disc.radius * hull.cell / roi_radius))


def beyond(inside: Bool, silhouette: Bool, margin: int) -> list[Bool]:
    """Regions (h, w) of a mask that are more than `margin` pixels outside of a silhouette, all (h, w)."""
    return regions(inside & ~dilated(silhouette, margin), LEAST * inside.sum())


def background(image: U8, inside: Bool, silhouette: Bool, margin: int) -> Bool:
    """Pixels (h, w) of a mask that are background: beyond the silhouette, and of the background's colours. image:
    (h, w, 3) 8-bit sRGB. inside, silhouette: (h, w). margin: pixels by which the silhouette may be too small."""
    found = np.zeros_like(inside)
    parts = beyond(inside, silhouette, margin)
    if not parts:
        return found
    seen = np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR), np.float32)
    deep, outer = eroded(silhouette & inside, 2 * margin), eroded(~inside, CLEAR)
    if not (deep.any() and outer.any()):
        return found
    for part in parts:
        ring = dilated(part, 2 * margin) & inside & ~silhouette
        rather = _rather_background(seen, ring, _next_to(part, deep), _next_to(part, outer))
        if float(rather[part].mean()) > 0:
            found |= ring & _smooth(rather > np.where(part, -OWN, 0))
    return found


def cut(alpha: F32, image: U8, inside: Bool, found: Bool) -> F32:
    """Alpha (H, W) of a photo without the pixels `found` (h, w) of its hard mask `inside` (h, w); unchanged elsewhere.
    image: (H, W, 3) 8-bit sRGB."""
    h, w = alpha.shape
    near = dilated(found, CLEAR).astype(np.uint8)
    zone = np.asarray(cv2.resize(near, (w, h), interpolation=cv2.INTER_NEAREST)) > 0
    return np.where(zone, np.minimum(alpha, to_full_size(image, inside & ~found)), alpha)


def _next_to(part: Bool, samples: Bool) -> Bool:
    """The samples (h, w) around a region; all of them where too few are."""
    away = np.asarray(cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5))
    near = samples & (away <= AROUND * max(part.shape))
    return near if near.sum() >= FEWEST else samples


def _rather_background(seen: F32, of: Bool, subject: Bool, outside: Bool) -> F32:
    """(h, w) how much more like the background than like the subject the pixels `of` are; 0 elsewhere."""
    out = np.zeros(of.shape, np.float32)
    near = NEAR * max(of.shape)
    own, other = (np.minimum(0.5 * unlike(seen, of, known, SPREAD, near, MOST), MOST) for known in (subject, outside))
    out[of] = own - other
    return out


def _smooth(pixels: Bool) -> Bool:
    """The pixels (h, w) without specks and thin lines."""
    return np.asarray(cv2.medianBlur(pixels.astype(np.uint8), 5)) > 0
