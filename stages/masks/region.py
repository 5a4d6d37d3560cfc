"""Projection of the region of interest into a photo, the working size of the masks, and morphology."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.colour import linear_from_srgb, srgb_from_linear
from pipeline.transforms import inverse_rigid, matrix, project

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

LINEAR: F32 = linear_from_srgb(np.arange(256) / 255).astype(np.float32)  # of 8-bit sRGB


@dataclass(frozen=True, slots=True)
class Disc:
    """The region of interest in a photo. x, y: centre in pixels from the corner. radius: pixels. roll: radians from the
    photo's upward direction to asset +Y, clockwise positive."""

    x: float
    y: float
    radius: float
    roll: float

    def scaled(self, factor: float) -> Disc:
        """The same disc in a photo resized by `factor`."""
        return Disc(self.x * factor, self.y * factor, self.radius * factor, self.roll)

    def covers(self, height: int, width: int, share: float = 1.0) -> Bool:
        """(H, W) pixels within `share` of the radius."""
        y, x = np.ogrid[:height, :width]
        out: Bool = np.hypot(x + 0.5 - self.x, y + 0.5 - self.y) <= share * self.radius
        return out


def region(camera: Camera, roi_radius: float) -> Disc | None:
    """Projection of the sphere around the asset's origin; None if the origin is behind the camera."""
    K, cam_from_world = matrix(camera.K), inverse_rigid(matrix(camera.world_from_cam))
    d = np.array(camera.distortion, np.float64)
    points = np.array([[0, 0, 0], [0, 0.1 * roi_radius, 0]])
    uv, z = project(K, cam_from_world, d, points)
    if not np.isfinite(uv).all():
        return None
    up = uv[1] - uv[0]
    length = float(np.hypot(*up))
    # from directly above or below, the picture has no meaningful up direction
    roll = float(np.arctan2(up[0], -up[1])) if length > 0.2 * 0.1 * roi_radius * K[1, 1] / z[0] else 0.0
    return Disc(float(uv[0, 0]), float(uv[0, 1]), float(roi_radius * np.sqrt(K[0, 0] * K[1, 1]) / z[0]), roll)


def eight_bit(image: npt.NDArray[np.generic], white: float = 1.0) -> U8:
    """(H, W, 3) 8-bit sRGB of a decoded file: 1, 3 or 4 channels, 8 or 16 bit sRGB, or linear float. white: the linear
    value that becomes 255 in float files, which have no white of their own."""
    rgb = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[..., :3]
    if rgb.dtype == np.uint8:
        return np.ascontiguousarray(rgb)
    if np.issubdtype(rgb.dtype, np.integer):
        return np.asarray(np.round(rgb.astype(np.float32) * (255 / np.iinfo(rgb.dtype).max)), np.uint8)
    encoded = srgb_from_linear((np.nan_to_num(rgb.astype(np.float32)) / np.float32(white)).clip(0, 1))
    return np.asarray(np.round(encoded * 255), np.uint8)


def resized(image: npt.NDArray[np.generic], width: int, height: int) -> npt.NDArray[np.generic]:
    """`image` (H, W, ...) at another size: area average if smaller, cubic interpolation if larger (clamped by OpenCV
    for 8 bit, to [0, 1] for float)."""
    if image.shape[:2] == (height, width):
        return image
    smaller = width * height < image.shape[0] * image.shape[1]
    pixels: Any = image  # OpenCV's stubs know no generic arrays
    out = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
    return np.asarray(out if out.dtype == np.uint8 else out.clip(0, 1))


def working_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Width and height with the longer edge at most `longest`."""
    factor = min(1.0, longest / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def disc_element(radius: int) -> U8:
    """Disc as structuring element, (2 radius + 1, 2 radius + 1)."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def eroded(mask: Bool, radius: int) -> Bool:
    """(H, W) erosion by a disc of `radius` pixels; pixels beyond the frame count as inside."""
    out = cv2.erode(mask.astype(np.uint8), disc_element(radius), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray(out) > 0


def thick(parts: Bool, radius: int) -> Bool:
    """What lies within twice `radius` pixels of a disc of `radius` in the mask (H, W): a rim that is thinner, beside or
    around it, is left out."""
    return parts & dilated(eroded(parts, radius), 2 * radius)


def dilated(mask: Bool, radius: int) -> Bool:
    """(H, W) dilation by a disc of `radius` pixels."""
    return ~eroded(~mask, radius)
