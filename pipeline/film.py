"""Animated pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt


def animated_webp(pictures: Sequence[npt.NDArray[np.uint8]], seconds: float, quality: int) -> bytes:
    """RGB pictures (H, W, 3), which together take `seconds`, as a WebP that goes on for ever. Empty if it can't be
    encoded. The same pictures give the same bytes."""
    import cv2

    film: Any = cv2.Animation()
    film.frames = [np.ascontiguousarray(p[..., ::-1]) for p in pictures]
    film.durations = np.full(len(pictures), round(1000 * seconds / len(pictures)), np.int32)
    done, data = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, quality])
    return bytes(np.asarray(data, np.uint8)) if done else b""
