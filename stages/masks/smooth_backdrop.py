"""A backdrop as it is in one photo: its shade changes smoothly from place to place.

A colour key allows for the backdrop's shades in all photos at once. Cloth or skin of a colour between them is then
taken for backdrop, in strips that reach the frame. A network does not know the backdrop at all. In one photo, though,
the backdrop is a smooth surface of colours, which what both call background shows; against that surface a wrong part
of a mask stands out, on either side of its contour. A shadow on the backdrop stands out too, but lies open toward it,
while a strip that was cut out lies within the subject.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.masks.matting import largest_parts
from stages.masks.region import F32, U8, Bool, dilated, thick

PART = 0.25  # of the largest part of the background: a smaller one may be a strip of cloth that a key has cut out
# of the polynomial of the shade of each channel, in the place, fit after fit. What a mask lacks is part of its
# background: a plane can't follow that, and leaves it out before a cubic could
DEGREES = (1, 1, 1, 1, 2, 2, 3, 3, 3)
LONGEST = 256  # pixels: the size at which it is fitted
LEAST = 0.05  # share of the photo that must be background
APART = 0.02  # of the longest side: from the subject; nearer its edge is mixed with the backdrop
NOISE, LEAST_TOLERANCE = 6.0, 6.0  # tolerance as a multiple of the deviation, and in levels
FINER = 0.5  # of the key's tolerance: only a surface this much closer to the photo tells more
SMOOTH, MOSTLY = 2.0, 0.9  # of a backdrop: deviation in levels, share of the background that lies on the surface
THIN = 1 / 160  # of the longest side: what is thinner is a difference of two contours
WITHIN = 0.5  # share of a part's border that is the subject or the frame
EVEN = 2.0  # median difference from the surface, of that of the background: highlights are not even


@dataclass(frozen=True, slots=True)
class Shades:
    """surface: (h, w, 3) colours of the backdrop at a reduced size, 8-bit levels. deviation: of the background from
    it, robust, in levels. share: of the background that lies on it."""

    surface: F32
    deviation: float
    share: float

    @property
    def tolerance(self) -> float:
        """Difference in levels up to which a pixel is like the backdrop."""
        return max(LEAST_TOLERANCE, NOISE * self.deviation)

    @property
    def is_backdrop(self) -> bool:
        """Whether the background of the photo is a smooth backdrop, and nothing else."""
        return self.deviation <= SMOOTH and self.share >= MOSTLY


def shades(image: U8, subject: Bool) -> Shades | None:
    """The shade of the background of a photo (H, W, 3), 8-bit sRGB; None where too little is seen of it. subject: its
    mask (H, W)."""
    scale = min(1.0, LONGEST / max(subject.shape))
    h, w = (max(1, round(scale * s)) for s in subject.shape)
    small = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), np.float64)
    inside = cv2.resize(subject.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA) > 0
    seen = ~dilated(inside, max(1, round(APART * max(h, w))))
    if seen.mean() < LEAST:
        return None
    seen = largest_parts(seen, PART)
    y, x = np.meshgrid(np.linspace(-1, 1, h), np.linspace(-1, 1, w), indexing="ij")
    weight = np.ones(int(seen.sum()))
    for degree in DEGREES:
        terms = np.stack([x**a * y**b for a in range(degree + 1) for b in range(degree + 1 - a)], -1)
        surface = terms @ np.linalg.lstsq(weight[:, None] * terms[seen], weight[:, None] * small[seen], rcond=None)[0]
        away = np.abs(small - surface).max(-1)[seen]
        deviation = 1.4826 * float(np.median(away))
        on = away <= max(LEAST_TOLERANCE, NOISE * deviation)
        weight = on / np.sqrt(np.maximum(away, 1))  # least absolute differences, of what may be backdrop
    return Shades(surface.astype(np.float32), deviation, float(on.mean()))


def given_back(image: U8, own: Bool, tolerance: float) -> Bool:
    """(H, W) parts of the subject that a key took for backdrop. image: (H, W, 3) 8-bit sRGB. own: its mask (H, W).
    tolerance: the key's, in levels."""
    found = shades(image, own)
    if found is None or found.tolerance > FINER * tolerance:
        return np.zeros(own.shape, bool)
    return _lacking(_away(image, found), own, found)


def corrected(image: U8, inside: Bool) -> Bool:
    """A mask (H, W) of another method with the parts that differ from a smooth backdrop within it, and without those
    that are backdrop. The same mask where the background is none. image: (H, W, 3) 8-bit sRGB."""
    found = shades(image, inside)
    if found is None or not found.is_backdrop:
        return inside
    away = _away(image, found)
    whole = inside | _lacking(away, inside, found)
    return whole & ~_beside(away, whole, found)


def _away(image: U8, found: Shades) -> F32:
    """(H, W) difference from the backdrop in levels of the channel in which it is largest. One channel at a time: a
    large photo in floats takes 12 bytes a pixel."""
    h, w = image.shape[:2]
    away = np.zeros((h, w), np.float32)
    for k in range(3):
        shade = cv2.resize(found.surface[..., k], (w, h), interpolation=cv2.INTER_LINEAR)
        np.maximum(away, np.abs(image[..., k] - shade), out=away)
    return away


def _thick(parts: Bool) -> Bool:
    return thick(parts, max(1, round(THIN * max(parts.shape))))


def _lacking(away: F32, own: Bool, found: Shades) -> Bool:
    """Parts (H, W) unlike the backdrop of whose border at least WITHIN is the subject, own (H, W), or the frame."""
    parts = _thick((away > found.tolerance) & ~own)
    label, total, held = _borders(parts, own)
    keep = held >= WITHIN * np.maximum(total, 1)
    return np.asarray(keep[label] & parts)


def _beside(away: F32, inside: Bool, found: Shades) -> Bool:
    """Parts (H, W) of a mask (H, W) that are as even as the backdrop, like it, and beside it."""
    like = away <= found.tolerance
    parts = _thick(like & inside)
    label, total, held = _borders(parts, inside)
    even = EVEN * np.median(away[like & ~inside]) if (like & ~inside).any() else 0.0
    keep = total > held
    for k in np.flatnonzero(keep):
        keep[k] = bool(np.median(away[label == k]) <= even)
    return np.asarray(keep[label] & parts)


def _borders(parts: Bool, own: Bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(H, W) label of each connected part, 0 elsewhere; and for each label the length of its border, and of the border
    with the subject, own (H, W), or the frame."""
    count, label = cv2.connectedComponents(np.pad(parts.astype(np.uint8), 1), connectivity=4)
    around = np.pad(own | parts, 1, constant_values=True)
    total, held = np.zeros(count), np.zeros(count)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        edge = (label > 0) & (np.roll(label, step, axis) != label)
        total += np.bincount(label[edge], minlength=count)
        held += np.bincount(label[edge & np.roll(around, step, axis)], minlength=count)
    return np.asarray(label[1:-1, 1:-1]), total, held
