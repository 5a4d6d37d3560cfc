"""Merging photos of one view at several exposures into one linear photo with more range.

    E = sum_i w_i z_i / e_i / sum_i w_i,    w_i = e_i^2 / var(z_i),    var(z) = GAIN z + READ^2 + q(z)^2

Symbols
    z_i     linear value in photo i, 1 at the end of its range; the response is known: sRGB, or linear of raw and float
    e_i     its exposure, relative to the photo that names the view
    E       value of the merged photo, in that photo's unit, without its upper end
    w_i     inverse variance of z_i / e_i; 0 where the photo is clipped. [Debevec and Malik 1997] for the sum,
            [Hasinoff et al. 2010, Noise-optimal capture for high dynamic range photography] for the weights
    q(z)    standard deviation of rounding to the file's levels, 1 / sqrt(12) of a level, in linear values

The variance is that of the expected value, E e_i of a first pass, and not of the noisy z_i: else dark pixels that
happen to be darker would count more, and the sum would be too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import srgb_from_linear
from pipeline.images import F32, linear_of
from stages.capture.photometry import clipped

GAIN, READ = 2e-4, 1e-3  # photon noise of a pixel that holds 5,000 electrons; read noise of 5 of them
SLOPE_TOE, TOE, SLOPE = 12.92, 0.0031308, 1.055 / 2.4  # of sRGB's encoding, IEC 61966-2-1
Bool = npt.NDArray[np.bool_]
Stored = npt.NDArray[np.generic]


@dataclass(frozen=True, slots=True)
class Merged:
    """radiance (H, W, 3): E. clipped (H, W): pixels that every photo clips, where E is a lower limit."""

    radiance: F32
    clipped: Bool


def variance(z: F32, levels: int) -> F32:
    """(...) var(z) of linear values z in [0, 1]. levels: of the file less one, 255 or 65535; 0 for a float file."""
    out = GAIN * np.maximum(z, 0) + READ**2
    if levels:
        encoded = srgb_from_linear(np.clip(z, 0, 1))
        steep = np.where(z <= TOE, SLOPE_TOE, SLOPE * ((encoded + 0.055) / 1.055) ** -1.4)
        out = out + (1 / (levels * steep)) ** 2 / 12
    return np.asarray(out, np.float32)


def levels_of(stored: Stored) -> int:
    """Levels of a decoded file less one, 0 for floats."""
    whole = np.issubdtype(stored.dtype, np.integer)
    return int(np.iinfo(stored.dtype.name).max) if whole else 0


def merge(photos: Sequence[Stored], exposures: Sequence[float], shifts: Sequence[tuple[float, float]] = ()) -> Merged:
    """E of decoded files (H, W, C) of one size. exposures: e_i, positive; shifts: pixels (x, y) by which the content of
    each lies further right and down than in the one that names the view.

    Where all are clipped, the shortest photo's value is a lower limit.
    """
    usable = [_usable(p, n == int(np.argmin(exposures))) for n, p in enumerate(photos)]
    moved = list(shifts) or [(0.0, 0.0)] * len(photos)
    usable = [_back(u.astype(np.float32), s) > 0.999 for u, s in zip(usable, moved, strict=True)]
    shortest = int(np.argmin(exposures))
    expected: F32 | None = None
    for _ in range(2):
        total = np.zeros((*photos[0].shape[:2], 3), np.float64)
        weight = np.zeros_like(total)
        for photo, e, free, shift in zip(photos, exposures, usable, moved, strict=True):
            z = _back(linear_of(photo), shift)
            likely = z if expected is None else expected * np.float32(e)
            w = e * e / variance(likely, levels_of(photo)) * free[..., None]
            total += w * (z / e)
            weight += w
        found = total / np.where(weight > 0, weight, 1)
        lowest = _back(linear_of(photos[shortest]), moved[shortest]) / exposures[shortest]
        expected = np.where(weight > 0, found, lowest).astype(np.float32)
    assert expected is not None
    return Merged(expected, ~np.any(usable, axis=0))


def _usable(stored: Stored, shortest: bool) -> Bool:
    """(H, W) pixels that are not clipped. Beside clipped pixels a camera's interpolation of colours mixes them in, so
    that all but the shortest photo lose a pixel more."""
    ends = clipped(stored)
    return ~ends if shortest else cv2.dilate(ends.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0


def _back(image: F32, shift: tuple[float, float]) -> F32:
    """A picture moved back by (x, y) pixels; what comes in at the edge is 0."""
    if shift == (0.0, 0.0):
        return image
    h, w = image.shape[:2]
    place = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, place, (w, h), flags=flags), np.float32)


# ------------------------------------------------------------------ do the photos show the same?
FEWEST = 400  # pixels that two photos must both show
DARK, LIGHT = 0.01, 0.9  # linear values between which a photo tells a brightness
SMALL = 1024  # pixels of the longer edge at which photos are compared
STILL = 0.15  # pixels: a smaller shift is none
FARTHEST = 0.02  # of the longer edge: a larger shift is no tremble of a tripod
ALIKE = 0.8  # of the difference of the fine structure: a shift has to leave less
DIFFERENT, MOVED = 0.25, 0.02  # relative difference of a place that moved; share of such places
TALE = 0.5  # stops that the pixels may contradict the stated exposures


@dataclass(frozen=True, slots=True)
class Compared:
    """How a photo agrees with the one that names the view. shift: (x, y) pixels. stops: its brightness over what its
    exposure says, log2. moved: share of the places that differ. known: whether both show enough."""

    shift: tuple[float, float]
    stops: float
    moved: float
    known: bool

    @property
    def same(self) -> bool:
        """Whether they can be merged."""
        return self.known and self.moved <= MOVED and abs(self.stops) <= TALE


def compare(base: Stored, other: Stored, exposure: float) -> Compared:
    """Compare two decoded files of one size. exposure: of the other over that of the base."""
    factor = max(1, round(max(base.shape[:2]) / SMALL))
    pictures = [_reduced(linear_of(p), factor) for p in (base, other)]
    a, b = (p.mean(2) for p in pictures)
    tells, shown = (_tells(p) for p in pictures)
    both = tells & shown
    if both.sum() < FEWEST:
        return Compared((0.0, 0.0), 0.0, 0.0, known=False)
    stops = float(np.median(np.log2(b[both] / a[both])) - np.log2(exposure))
    shift = _shift(_structure(a, both), _structure(b, both))
    if np.hypot(*shift) * factor < STILL:
        shift = (0.0, 0.0)
    if max(abs(s) for s in shift) > FARTHEST * max(a.shape):
        return Compared((shift[0] * factor, shift[1] * factor), stops, 1.0, known=True)
    back = _back(b, shift)
    both = tells & (_back(shown.astype(np.float32), shift) > 0.999)
    both = cv2.erode(both.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # clipped neighbours are in the mean below
    level = exposure * 2.0**stops
    soft = [cv2.blur(x, (3, 3)) for x in (a, back / level)]
    differ = np.abs(soft[0] - soft[1]) > DIFFERENT * 0.5 * (soft[0] + soft[1])
    share = float(differ[both].mean()) if both.any() else 0.0
    known = both.sum() >= FEWEST / 4 or shift != (0.0, 0.0)
    return Compared((shift[0] * factor, shift[1] * factor), stops, share, known=bool(known))


def _reduced(image: F32, factor: int) -> F32:
    h, w = image.shape[0] // factor, image.shape[1] // factor
    return np.asarray(cv2.resize(image[: h * factor, : w * factor], (w, h), interpolation=cv2.INTER_AREA), np.float32)


def _tells(image: F32) -> Bool:
    """(H, W) pixels none of whose channels is clipped or lost in the dark."""
    return np.asarray((image.min(2) > DARK) & (image.max(2) < LIGHT))


def _structure(image: F32, known: Bool) -> F32:
    """Fine structure of the logarithm where both photos tell it, so that exposure does not matter."""
    log = np.log(np.clip(image, DARK, LIGHT))
    fine = log - cv2.GaussianBlur(log, (0, 0), 8)
    return np.asarray(fine * cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)), np.float32)


def _shift(a: F32, b: F32) -> tuple[float, float]:
    """(x, y) by which b lies further right and down, by phase correlation; none if it does not make them more alike, as
    where a highlight is in one photo only."""
    window = cv2.createHanningWindow((a.shape[1], a.shape[0]), cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(a, b, window)
    found = (float(x), float(y))
    return found if _unlike(a, _back(b, found)) < ALIKE * _unlike(a, b) else (0.0, 0.0)


def _unlike(a: F32, b: F32) -> float:
    return float(np.abs(a - b).mean())
