"""Pictures of a comparison: small data URIs, and the two scales of differences."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]
B_COLOUR, A_COLOUR = (
    np.array([0, 114, 178], np.float32),
    np.array([213, 94, 0], np.float32),
)  # ends of the signed scale, different for every colour vision
MIDDLE = np.float32(245)


@dataclass(frozen=True, slots=True)
class Picture:
    """A data URI and its caption."""

    uri: str
    caption: str


@dataclass(frozen=True, slots=True)
class Row:
    """Pictures beside each other."""

    title: str
    note: str
    pictures: tuple[Picture, ...]


def signed(values: F32, reach: float) -> U8:
    """RGB (..., 3) of values from -reach (orange) over 0 (near white) to +reach (blue), clipped."""
    share = np.nan_to_num(values / reach).clip(-1, 1)[..., None]
    end = np.where(share > 0, B_COLOUR, A_COLOUR)
    return np.asarray(np.round(MIDDLE * (1 - np.abs(share)) + np.abs(share) * end), np.uint8)


def signed_bar() -> U8:
    """The signed scale from left to right, for the legend."""
    return signed(np.repeat(np.linspace(-1, 1, 256, dtype=np.float32)[None], 10, 0), 1)


def fitted(image: npt.NDArray[np.floating], width: int, height: int) -> F32:
    """A picture (H, W[, C]) at another size: areas are averaged where it shrinks."""
    smaller = width <= image.shape[1]
    kind = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(
        cv2.resize(np.ascontiguousarray(image, np.float32), (width, height), interpolation=kind), np.float32
    )
