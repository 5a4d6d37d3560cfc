"""Subject against a uniform background (black, grey, green ...): whatever hangs together with the frame is background.

Colour alone can't do it: brows, nostrils and beards are as black as a black background. They don't reach the frame,
the background does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stages.masks.region import F32, U8, Bool
from stages.masks.soften import largest_parts, soft_edge

RING = 0.015  # of the shorter edge: width of the border that is looked at
NEAR = 24  # 8-bit levels: first guess of what is background
SAMPLES = 4000  # border pixels per view
MAX_SPREAD = 6.0  # levels, robust standard deviation: above it a background is not uniform
MIN_SHARE, MIN_SHARE_ANY = 0.5, 0.25  # of all border pixels, and of one view's, that must be background
HOLE = 0.005  # of the photo: an enclosed patch of background colour this large may be a hole
EDGE = 3  # pixels: the threshold's contour is right to this


@dataclass(frozen=True, slots=True)
class Background:
    """A uniform background: 8-bit sRGB colour, and how far a pixel may be from it (levels, largest channel)."""

    colour: tuple[float, float, float]
    tolerance: float


def border_colours(image: U8) -> U8:
    """(N, 3) pixels of the outermost ring, evenly thinned to at most SAMPLES."""
    h, w = image.shape[:2]
    width = max(2, round(RING * min(h, w)))
    ring = np.ones((h, w), bool)
    ring[width:-width, width:-width] = False
    found = image[ring]
    return np.ascontiguousarray(found[:: -(-len(found) // SAMPLES)])


def find_background(borders: Sequence[U8]) -> Background | None:
    """The one colour around the subject in all views, or None if there is no such colour. borders: (N_i, 3) each."""
    if not borders:
        return None
    pooled = np.concatenate(borders).astype(np.float32)
    colour = np.median(pooled, axis=0)
    for _ in range(5):
        near = np.abs(pooled - colour).max(1) <= NEAR
        if not near.any():
            return None
        colour = np.median(pooled[near], axis=0)
    near = np.abs(pooled - colour).max(1) <= NEAR
    spread = 1.4826 * np.median(np.abs(pooled[near] - colour).max(1))
    tolerance = float(np.clip(5 * spread, 5, NEAR))
    shares = [float((np.abs(b.astype(np.float32) - colour).max(1) <= tolerance).mean()) for b in borders]
    if spread > MAX_SPREAD or np.median(shares) < MIN_SHARE or min(shares) < MIN_SHARE_ANY:
        return None
    return Background((float(colour[0]), float(colour[1]), float(colour[2])), tolerance)


def key_out(image: U8, background: Background) -> F32:
    """Alpha (H, W) of the subject in (H, W, 3) 8-bit sRGB."""
    return soft_edge(image, _inside(image, background), EDGE)


def _inside(image: U8, background: Background) -> Bool:
    apart = [np.abs(image[..., k].astype(np.float32) - np.float32(background.colour[k])) for k in range(3)]
    away = np.maximum(np.maximum(apart[0], apart[1]), apart[2])
    like = away <= background.tolerance
    count, label, stats, _ = cv2.connectedComponentsWithStats(like.astype(np.uint8), connectivity=4)
    frame = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    outer = np.zeros(count, bool)
    # a dark collar cut by the frame is a small patch there; the background is not
    outer[[i for i in np.unique(frame) if i and stats[i, cv2.CC_STAT_AREA] >= 1e-3 * like.size]] = True
    for i in np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= HOLE * like.size):
        if i and not outer[i]:  # a hole is as flat as the background around; dark skin or cloth is not
            outer[i] = bool(away[label == i].std() <= 0.25 * background.tolerance)
    inside = largest_parts(~outer[label], 0.02)
    opened = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(opened) > 0
