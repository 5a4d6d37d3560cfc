"""Person segmentation: a small network gives a rough mask; GrabCut and the contour refinement make it accurate.

The network (models/NOTICE) has an input of 256 x 256 RGB in [0, 1], channels first, and returns the probability of
'person' (its last layer is a sigmoid). It was trained on upright people, so the crop is rotated by the camera's roll.
It errs differently on a mirrored or slightly turned photo, so that the mean of several is right more often: on the
rendered man of docs/captures.md, Contours, it lowers the share of wrong pixels by a third.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pipeline.networks import network
from stages.masks.grabcut import cut
from stages.masks.matting import between, largest_parts
from stages.masks.refine_contour import refined_contour
from stages.masks.region import F32, U8, Bool, Disc, dilated, eroded, resized, thick, working_size

MODEL = Path(__file__).parent / "models" / "selfie_segmentation.tflite"
SIDE = 256  # the network's input
CROP = 1.6  # half-edge of the crop in radii of the region of interest
UNSURE = 2.5  # network pixels on both sides of its contour that GrabCut decides
LOOKS = ((0.0, False), (0.0, True), (0.2, False), (-0.2, True))  # turns in radians, and whether mirrored; averaged
SURE, BROAD = 0.95, 3  # probability below which a region is unsure that is broader than so many times UNSURE
MIN_PART = 0.3  # of the largest component: smaller ones are errors of the network


def probability(square: U8) -> F32:
    """(256, 256) probability of 'person' in a (256, 256, 3) 8-bit RGB picture."""
    blob = np.ascontiguousarray(square.transpose(2, 0, 1)[None].astype(np.float32) / 255)
    net = network(MODEL, cv2.dnn.readNetFromTFLite)
    net.setInput(blob)
    return np.array(net.forward(), np.float32).reshape(SIDE, SIDE)


def person_probability(image: U8, disc: Disc) -> tuple[F32, float]:
    """Probability (H, W) of 'person', and the size in photo pixels of one network pixel. image: (H, W, 3) 8-bit sRGB.

    The network runs on the whole photo, and on a crop around the subject if it shows the subject larger; inside the
    crop, the crop's result is used.
    """
    h, w = image.shape[:2]
    half = min(CROP * disc.radius, max(h, w) / 2)
    whole, scale = _averaged(image, Disc(w / 2, h / 2, 0, 0), max(h, w) / 2)
    if half > 0.7 * max(h, w) / 2 and abs(disc.roll) < 0.35:
        return whole, scale
    crop, scale = _averaged(image, Disc(disc.x, disc.y, 0, disc.roll), half)
    return np.asarray(np.where(np.isnan(crop), whole, crop), np.float32), scale


def _averaged(image: U8, centre: Disc, half: float) -> tuple[F32, float]:
    """The mean of the LOOKS: probability (H, W), NaN where the first has none; size of a network pixel."""
    scale = 2 * half / SIDE
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.4 * scale), np.uint8) if scale > 1.3 else image  # aliasing
    looks = []
    for turn, mirrored in LOOKS:
        if mirrored:
            there = Disc(image.shape[1] - centre.x, centre.y, 0, turn - centre.roll)
            looks.append(_through(np.ascontiguousarray(blurred[:, ::-1]), there, half)[:, ::-1])
        else:
            looks.append(_through(blurred, Disc(centre.x, centre.y, 0, centre.roll + turn), half))
    mean = np.nanmean(np.where(np.isfinite(looks[0]), looks, 0), 0)
    return np.where(np.isfinite(looks[0]), mean, np.nan).astype(np.float32), scale


def _through(image: U8, centre: Disc, half: float) -> F32:
    """Run the network on a square of half-edge `half` pixels around a point, rotated by its roll. Pixels outside of a
    crop are NaN."""
    h, w = image.shape[:2]
    scale = 2 * half / SIDE
    c, s = np.cos(centre.roll) * scale, np.sin(centre.roll) * scale
    # photo position = centre + turn @ (net position - net centre); both in OpenCV's pixel-centre coordinates
    turn = np.array([[c, -s], [s, c]])
    shift = np.array([centre.x - 0.5, centre.y - 0.5]) - turn @ np.array([SIDE / 2 - 0.5] * 2)
    photo_from_net = np.concatenate([turn, shift[:, None]], 1)
    square = cv2.warpAffine(image, photo_from_net, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                            borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    found = probability(np.asarray(square, np.uint8))
    out = cv2.warpAffine(found, photo_from_net, (w, h), flags=cv2.INTER_LINEAR, borderValue=float("nan"))
    if centre.roll == 0 and half >= max(h, w) / 2:
        out = np.nan_to_num(np.asarray(cv2.warpAffine(found, photo_from_net, (w, h), flags=cv2.INTER_LINEAR,
                                                      borderMode=cv2.BORDER_REPLICATE)))  # fmt: skip
    return np.asarray(out, np.float32)


def person_mask(image: U8, disc: Disc, threshold: float, longest: int, seed: int) -> Bool:
    """Hard mask of the person in the region of interest, at the working size. image: (H, W, 3) 8-bit sRGB."""
    w, h = working_size(image.shape[1], image.shape[0], longest)
    small = np.asarray(resized(image, w, h), np.uint8)
    disc = disc.scaled(w / image.shape[1])
    found, scale = person_probability(small, disc)
    return refined(small, found, scale, disc, threshold, seed)


def refined(small: U8, found: F32, scale: float, disc: Disc, threshold: float, seed: int) -> Bool:
    """Hard mask (h, w) from a network's probability (h, w): near its contour the colours decide, first by global colour
    models (grabcut.py), then by local ones (refine_contour.py). small: (h, w, 3) 8-bit sRGB.

    scale: size in pixels of one network pixel.
    """
    inside = of_subject(found >= threshold, disc)
    if not inside.any():
        return inside
    radius = max(2, round(UNSURE * scale))
    trimap = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[eroded(inside, radius)] = cv2.GC_FGD
    trimap[thick(inside & (found <= SURE), BROAD * radius)] = cv2.GC_PR_FGD
    trimap[~dilated(inside, radius)] = cv2.GC_BGD
    return of_subject(settled(small, of_subject(cut(small, trimap, seed), disc)), disc)


def settled(small: U8, narrow: Bool) -> Bool:
    """Hard mask (h, w) from one by global colour models (h, w): local ones add what these miss, and where both differ
    half of a pixel must be the subject's. small: (h, w, 3) 8-bit sRGB."""
    return np.asarray(between(small, narrow, refined_contour(small, narrow)) >= 0.5)


def of_subject(inside: Bool, disc: Disc) -> Bool:
    """The mask (h, w) reduced to large components that reach into the region of interest, with small holes filled."""
    label = np.asarray(cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)[1])
    core = np.unique(label[disc.covers(inside.shape[0], inside.shape[1], 0.7)])
    kept = largest_parts(np.isin(label, core[core > 0]), MIN_PART)
    filled = ~largest_parts_over(~kept, 0.002 * inside.size)
    return np.asarray(filled, bool)


def largest_parts_over(inside: Bool, area: float) -> Bool:
    """The mask (h, w) without connected components of less than `area` pixels."""
    _, label, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=4)
    big = stats[:, cv2.CC_STAT_AREA] >= area
    big[0] = False
    return np.asarray(big[label])
