"""Keying by a uniform background (black, green, ...) or a clean plate: background is what is connected to the border.

Colour alone is not enough: brows, nostrils and beards are as black as a black background. But they are not connected
to the frame's border.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stages.masks.matting import largest_parts, soft_edge
from stages.masks.region import F32, U8, Bool
from stages.masks.smooth_backdrop import given_back

RING = 0.015  # of the shorter edge: width of the border
NEAR = 24  # 8-bit levels: initial tolerance of background pixels
SAMPLES = 4000  # border pixels per view
MAX_SPREAD = 6.0  # levels, robust standard deviation: above it a background is not uniform
MIN_SHARE, MIN_SHARE_ANY = 0.5, 0.25  # of all border pixels, and of one view's, that must be background
HOLE = 0.005  # of the photo: smallest enclosed area of background colour that may be a hole
UNCHANGED = 0.3  # share of a photo that is certainly background
PLATE_NOISE, PLATE_LEVELS = 6.0, (8.0, 32.0)  # tolerance to the plate: multiple of the noise, limits in levels
EDGE = 3  # pixels: accuracy of the threshold's contour


@dataclass(frozen=True, slots=True)
class Background:
    """A uniform background: 8-bit sRGB colour, and tolerance in levels of the channel with the largest difference."""

    colour: tuple[float, float, float]
    tolerance: float


def border_colours(image: U8) -> U8:
    """(N, 3) pixels of the border of a photo (H, W, 3), evenly subsampled to at most SAMPLES."""
    h, w = image.shape[:2]
    width = max(2, round(RING * min(h, w)))
    ring = np.ones((h, w), bool)
    ring[width:-width, width:-width] = False
    found = image[ring]
    return np.ascontiguousarray(found[:: -(-len(found) // SAMPLES)])


def find_background(borders: Sequence[U8]) -> Background | None:
    """The uniform background of all views, or None. borders: (N_i, 3) border pixels of each view."""
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
    return soft_edge(image, keyed(image, background), EDGE)


def keyed(image: U8, background: Background) -> Bool:
    """Hard mask (H, W) of the subject in (H, W, 3) 8-bit sRGB: what differs from the background's colour, and what
    differs from its shade in this photo."""
    own = _inside(_farthest(image, lambda k: np.float32(background.colour[k])), background.tolerance)
    return own | given_back(image, own, background.tolerance)


def key_out_plate(image: U8, plate: U8) -> F32:
    """Alpha (H, W) of the subject, from a photo and its clean plate of the same camera, (H, W, 3) 8-bit sRGB.

    Exposure may have changed: the plate is scaled to the photo by one gain, over the pixels that differ least.
    """
    like = _farthest(image, lambda k: plate[..., k].astype(np.float32))
    same = like <= np.quantile(like, UNCHANGED)
    gain = float(np.median((image[same].astype(np.float32) + 1) / (plate[same].astype(np.float32) + 1)))
    away = _farthest(image, lambda k: plate[..., k].astype(np.float32) * np.float32(gain))
    away = np.asarray(cv2.GaussianBlur(away, (0, 0), 1.0), np.float32)  # reduces noise
    tolerance = float(np.clip(PLATE_NOISE * np.median(away[same]), *PLATE_LEVELS))
    return soft_edge(image, _inside(away, tolerance), EDGE)


def _farthest(image: U8, other: Callable[[int], F32 | np.float32]) -> F32:
    """(H, W) difference of a photo (H, W, 3) from what `other` gives for a channel, levels of the channel in which it
    is largest. One channel at a time: a large photo in floats takes 12 bytes a pixel."""
    away = np.zeros(image.shape[:2], np.float32)
    for k in range(3):
        plane = image[..., k].astype(np.float32)
        plane -= other(k)
        np.maximum(away, np.abs(plane, out=plane), out=away)
    return away


def _inside(away: F32, tolerance: float) -> Bool:
    """(H, W) hard mask of the subject. away: (H, W) difference from the background in levels."""
    like = away <= tolerance
    count, label, stats, _ = cv2.connectedComponentsWithStats(like.astype(np.uint8), connectivity=4)
    frame = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    outer = np.zeros(count, bool)
    # a dark collar at the frame's border is a small area; the background is large
    outer[[i for i in np.unique(frame) if i and stats[i, cv2.CC_STAT_AREA] >= 1e-3 * like.size]] = True
    for i in np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= HOLE * like.size):
        if i and not outer[i]:  # a hole is as uniform as the background; dark skin or cloth is not
            outer[i] = bool(away[label == i].std() <= 0.25 * tolerance)
    inside = largest_parts(~outer[label], 0.02)
    opened = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(opened) > 0
