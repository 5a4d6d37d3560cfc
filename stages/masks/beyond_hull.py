"""Background that a mask took for the subject, as the other masks show it.

What lies beyond the visual hull (hull_votes: no place on a pixel's ray is the subject's in the other photos) is the
wall between a chin and a chest, or a part of the turntable. The hull errs too: what some masks lack, it lacks in every
view. So a thick part that many photos contradict is cut off whatever it looks like, a thin one if a third of them do,
and of the rest the colours have the last word. A region is cut off where its mean of

    min(d_in^2 / 2, MOST) - min(d_out^2 / 2, MOST)

is above 0: it is more like the background next to it than like the subject next to it. Where the colours are alike, the
background is nearer, so that the hull is believed. d: stages.masks.refine_contour, against samples of the mask deep
inside of the hull (d_in) and of what is outside of the mask (d_out). In such a region a pixel stays if it is clearly
the subject's (below -OWN). Within RIM of a region, up to the hull's outline, a pixel stays if it is not above 0.
Accuracy: docs/captures.md, Contours.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.hull_needs import regions
from stages.masks.hull_votes import DOUBT
from stages.masks.refine_contour import BLUR, FEWEST, unlike
from stages.masks.region import F32, U8, Bool, dilated, eroded
from stages.masks.sources import to_full_size

LEAST = 0.0005  # of a mask: smaller regions are noise of its outline
SPREAD, NEAR, MOST = 16.0, 40 / 640, 6.0  # s of 255, r of the longest edge, and the cost at which colours are strangers
AROUND = 60 / 640  # of the longest edge: how far from a region its neighbours are
OWN = 1.0  # by which a pixel of a region that is cut off must be more like the subject to stay
CLEAR = 2  # pixels outside of the mask's outline where samples of the background begin
RIM, DEEP = 3 / 640, 8 / 640  # of the longest edge: around a region; inside of the hull, where samples begin
# colours don't count from: a region's share of the mask, its thickness (of the longest edge), share of the photos
LARGE, THICK, MANY = 0.002, 7 / 640, 0.12
MOSTLY = 90  # percentile of a region's shares that is compared with that
MAJORITY = 0.35  # share of the photos that see a pixel's places from which its region may have any shape
AGAINST = 2.0  # photos, besides the one that may be wrong (hull_votes.FORGIVEN)


def beyond(inside: Bool, outer: Bool) -> list[Bool]:
    """Regions (h, w) of a mask among its pixels `outer` (h, w) beyond the hull, without thin lines."""
    return regions(_without_lines(inside & outer), LEAST * inside.sum())


def many(voters: int) -> float:
    """The share of `voters` photos from which they are many: MANY, and AGAINST of them, because of eight photos two may
    have the same wrong mask."""
    return max(MANY, AGAINST / max(voters, 1))


def surely(inside: Bool, share: F32, enough: float) -> list[Bool]:
    """Regions (h, w) of a mask that are background whatever they look like: large, thick, and contradicted by `enough`
    of the photos (many); or of any shape, where MAJORITY of the photos contradict each pixel. share (h, w):
    hull_votes.contradicting."""
    broad = [r for r in regions(_without_lines(inside & (share > DOUBT)), LARGE * inside.sum())
             if 2 * cv2.distanceTransform(r.astype(np.uint8), cv2.DIST_L2, 5).max() >= THICK * max(r.shape)
             and np.percentile(share[r], MOSTLY) >= enough]  # fmt: skip
    most = inside & (share >= max(MAJORITY, enough))
    return broad + regions(_without_lines(most), LEAST * inside.sum())


def background(image: U8, inside: Bool, outer: Bool, share: F32, enough: float = MANY) -> Bool:
    """Pixels (h, w) of a mask that are background. image: (h, w, 3) 8-bit sRGB. inside: (h, w). outer (h, w):
    hull_votes.beyond_all; share (h, w): hull_votes.contradicting; enough: of it (many)."""
    found = np.zeros_like(inside)
    parts = beyond(inside, outer)
    if not parts:
        return found
    longest = max(inside.shape)
    seen = np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR), np.float32)
    deep, around = eroded(inside & ~outer, max(2, round(DEEP * longest))), eroded(~inside, CLEAR)
    if not (deep.any() and around.any()):
        return found

    def with_rim(part: Bool) -> tuple[Bool, F32]:
        """A region and what lies around it (h, w), and how much more like the background that is."""
        ring = dilated(part, max(1, round(RIM * longest))) & inside
        return ring, _rather_background(seen, ring, _next_to(part, deep), _next_to(part, around))

    for part in surely(inside, share, enough):
        _, rather = with_rim(part)
        found |= _smooth(part | (rather > 0))
    for part in parts:
        ring, rather = with_rim(part)
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


def _without_lines(pixels: Bool) -> Bool:
    """The pixels (h, w) without what is one or two wide."""
    return dilated(eroded(pixels, 1), 1)


def _smooth(pixels: Bool) -> Bool:
    """The pixels (h, w) without specks and thin lines."""
    return np.asarray(cv2.medianBlur(pixels.astype(np.uint8), 5)) > 0
