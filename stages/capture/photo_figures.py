"""Quality figures of one photo: sharpness, clipping, brightness, structure, faces.

The subject is not segmented yet, so the figures are measured in the centre of the frame, where it usually is: an
ellipse with half the frame's width and height.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import srgb_from_linear
from pipeline.faces.find import SURE, face_boxes, find_face
from stages.capture.photometry import mean_light

U8 = npt.NDArray[np.uint8]
F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
FACE_EDGE = 512  # pixels, longest edge of the picture in which faces are detected: the networks' inputs are 128 and 192
THUMB = 32  # pixels, edge of the thumbnail by which photos are compared
SECOND_FACE = 0.5  # of the largest face's size: smaller faces are people in the background, or posters
CENTRE, BRIGHT = 0.5, 0.9  # share of the frame's edges; quantile that represents the lit part of the subject


@dataclass(frozen=True, slots=True)
class PhotoFigures:
    """Figures of one photo's centre. I: its levels; Gs: a Gaussian filter with a standard deviation of s pixels.

    detail: E[(G1 I - G2 I)^2] / E[(G2 I - G8 I)^2], which blur reduces; unlike pipeline.sharpness.detail it hardly
    depends on sensor noise, which differs between cameras. clipped: share of clipped pixels. bright: level (0 to 255,
    encoded) that a tenth of the pixels exceed. structure: mean of |G1 I - G4 I| in levels, which features need. light:
    mean linear luminance. face: whether a face with its landmarks is found. faces: number of faces of similar size.
    thumb: (THUMB, THUMB) mean levels of the whole frame.
    """

    detail: float
    clipped: float
    bright: float
    structure: float
    light: float
    face: bool
    faces: int
    thumb: F32


def measure_photo(image: npt.NDArray[np.generic], grey: U8, clipped: Bool) -> PhotoFigures:
    """Figures of a decoded photo (H, W, C). grey: (h, w), stages.capture.quality.small_grey of it. clipped: (H, W)."""
    crop = grey[_centre(grey.shape)]
    inside = _ellipse(*crop.shape)
    smooth = crop.astype(np.float32)
    g1, g2, g4, g8 = (np.asarray(cv2.GaussianBlur(smooth, (0, 0), s), np.float32) for s in (1.0, 2.0, 4.0, 8.0))
    where = clipped[_centre(clipped.shape)]
    small = _small_colour(image)
    h, w = small.shape[:2]
    found = find_face(small, w / 2, h / 2, max(h, w) / 2)
    sizes = [size for _, size in face_boxes(small, w / 2, h / 2, max(h, w) / 2, SURE)]
    return PhotoFigures(
        detail=float(np.square(g1 - g2).mean() / max(float(np.square(g2 - g8).mean()), 1e-3)),
        clipped=float(where[_ellipse(*where.shape)].mean()),
        bright=float(np.quantile(crop[inside], BRIGHT)),
        structure=float(np.abs(g1 - g4)[inside].mean()),
        light=mean_light(crop),
        face=found is not None,
        faces=sum(s >= SECOND_FACE * max(sizes) for s in sizes),
        thumb=np.asarray(cv2.resize(grey, (THUMB, THUMB), interpolation=cv2.INTER_AREA), np.float32),
    )


def _centre(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The central rectangle of an (H, W) picture, CENTRE of each edge."""
    h, w = (round((1 - CENTRE) / 2 * n) for n in shape[:2])
    return slice(h, shape[0] - h), slice(w, shape[1] - w)


def _ellipse(height: int, width: int) -> Bool:
    """(H, W) pixels of the inscribed ellipse."""
    y, x = np.ogrid[:height, :width]
    out: Bool = ((x + 0.5) / width * 2 - 1) ** 2 + ((y + 0.5) / height * 2 - 1) ** 2 <= 1
    return out


def _small_colour(image: npt.NDArray[np.generic]) -> U8:
    """(h, w, 3) 8-bit, encoded as sRGB, longest edge at most FACE_EDGE, of a decoded file (H, W, C)."""
    h, w = image.shape[:2]
    scale = min(1.0, FACE_EDGE / max(h, w))
    plane = np.ascontiguousarray(np.repeat(image, 3, 2) if image.shape[2] == 1 else image[..., :3])
    values = plane if plane.dtype in (np.uint8, np.uint16) else plane.astype(np.float32)
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    small = np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA))
    if small.dtype == np.uint8:
        return np.asarray(small, np.uint8)
    if small.dtype == np.uint16:
        return np.asarray(np.round(small / 257.0), np.uint8)
    top = max(float(np.quantile(small, 0.99)), 1e-6)
    return np.asarray(np.round(srgb_from_linear((small / top).clip(0, 1)) * 255), np.uint8)
