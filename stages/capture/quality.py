"""Photos that can't be used: blank ones, and ones far more blurred than the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import srgb_from_linear

WORKING = 1000  # pixels, longest edge
BLANK = 2.0  # levels of 255, largest spread of a blank photo (an 8-bit camera's noise in the dark is 1)
BLURRED = 0.2  # of the median detail
MAX_BLURRED = 0.5  # of the photos: if more look blurred, blur is normal in this capture, and none is left out


def small_grey(image: npt.NDArray[np.generic]) -> npt.NDArray[np.uint8]:
    """(h, w) 8-bit, encoded as sRGB, of a decoded file (H, W, C)."""
    if image.dtype == np.uint8 and image.shape[2] >= 3:  # most photos: fast
        plane: npt.NDArray[Any] = np.asarray(cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY))
    else:
        plane = np.asarray(image[..., :3], np.float32).mean(2)
    if np.issubdtype(image.dtype, np.floating):
        plane = np.asarray(srgb_from_linear(plane / max(float(np.quantile(plane, 0.99)), 1e-6)) * 255, np.float32)
    elif image.dtype == np.uint16:
        plane = plane / np.float32(257)
    scale = min(1.0, WORKING / max(plane.shape))
    size = (max(1, round(plane.shape[1] * scale)), max(1, round(plane.shape[0] * scale)))
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA).clip(0, 255), np.uint8)


def is_blank(grey: npt.NDArray[np.uint8]) -> bool:
    """Whether 99 of 100 pixels have the same level: a lens cap, a flash that did not fire, a failed export. grey:
    (h, w)."""
    low, high = np.quantile(grey[::4, ::4], [0.005, 0.995])
    return bool(high - low <= BLANK)


def blurred(details: Sequence[float], fitted: Sequence[bool]) -> list[bool]:
    """Which photos have far less detail than the median of the fitted ones; none if that would be half of these."""
    values, own = np.array(details), np.array(fitted, bool)
    own = own if own.any() else ~own
    found = values < BLURRED * np.median(values[own])
    return [bool(f) for f in found] if found[own].mean() < MAX_BLURRED else [False] * len(details)
