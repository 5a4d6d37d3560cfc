"""Segmentation by GrabCut (colour models and contrast) from a rough mask."""

from __future__ import annotations

import cv2
import numpy as np

from stages.masks.region import U8, Bool, Disc, resized, working_size

ROUNDS = 2
ROOM = 40  # pixels around the undecided ones whose colours are used
INNER, OUTER = 0.45, 1.25  # radii of the region of interest: certainly subject within, certainly background beyond


def cut(image: U8, trimap: U8, seed: int) -> Bool:
    """Hard mask (H, W): decides the probable pixels of a trimap (H, W) of cv2.GC_* values. image: (H, W, 3) 8-bit sRGB.
    Without samples of both subject and background the trimap decides. Source: Rother, Kolmogorov, Blake, GrabCut
    (2004)."""
    unsure = (trimap == cv2.GC_PR_FGD) | (trimap == cv2.GC_PR_BGD)
    own: Bool = (trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)
    if not unsure.any():
        return own
    rows, columns = np.flatnonzero(unsure.any(1)), np.flatnonzero(unsure.any(0))
    window = (slice(max(rows[0] - ROOM, 0), rows[-1] + ROOM + 1),
              slice(max(columns[0] - ROOM, 0), columns[-1] + ROOM + 1))  # fmt: skip
    part = np.ascontiguousarray(trimap[window])
    if min(own[window].sum(), (~own[window]).sum()) < 50:
        return own
    cv2.setRNGSeed(seed)  # its clusters start at random; the generator is per thread
    cv2.grabCut(
        np.ascontiguousarray(image[window]),
        part,
        (0, 0, 1, 1),
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        ROUNDS,
        cv2.GC_INIT_WITH_MASK,
    )
    own[window] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    return own


def cut_by_region(image: U8, disc: Disc, longest: int, seed: int) -> Bool:
    """Hard mask at the working size from the region of interest alone. image: (H, W, 3) 8-bit sRGB."""
    w, h = working_size(image.shape[1], image.shape[0], longest)
    small = np.asarray(resized(image, w, h), np.uint8)
    disc = disc.scaled(w / image.shape[1])
    trimap = np.full((h, w), cv2.GC_PR_BGD, np.uint8)
    trimap[disc.covers(h, w, 0.85)] = cv2.GC_PR_FGD
    trimap[disc.covers(h, w, INNER)] = cv2.GC_FGD
    trimap[~disc.covers(h, w, OUTER)] = cv2.GC_BGD
    return cut(small, trimap, seed)
