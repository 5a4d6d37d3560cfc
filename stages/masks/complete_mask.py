"""A mask with a part that it lacks and the other masks need, as the photo's colours tell (pipeline.needed_parts)."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.artifacts import Camera
from pipeline.hull import Cloud, render_silhouette
from pipeline.hull_needs import MARGIN, margin_of
from stages.masks.grabcut import cut
from stages.masks.region import U8, Bool, dilated, eroded

KEPT, FOUND = 0.9, 0.5  # share of the mask, and of the missing part, that a new mask must have


def completed(image: U8, inside: Bool, part: Bool, hull: Cloud, camera: Camera, seed: int) -> Bool | None:
    """A hard mask (h, w) with the missing part, as the colours tell; None if they do not tell. image: (h, w, 3) 8-bit
    sRGB. inside, part: (h, w)."""
    h, w = inside.shape
    margin = margin_of(camera, w, hull.cell, MARGIN)
    shown = render_silhouette(hull, camera, h, w) >= 0.5
    trimap = np.full((h, w), cv2.GC_BGD, np.uint8)
    trimap[dilated(inside | shown, margin)] = cv2.GC_PR_BGD
    trimap[inside | part] = cv2.GC_PR_FGD
    trimap[eroded(inside, margin)] = cv2.GC_FGD
    new = cut(image, trimap, seed)
    kept = (new & inside).sum() >= KEPT * inside.sum()
    return new if kept and (new & part).sum() >= FOUND * part.sum() else None
