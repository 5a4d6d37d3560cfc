"""Pictures for the page, as small data URIs that work on light and dark backgrounds."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import numpy.typing as npt

from stages.report.metrics import encoded

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]
LOSSLESS = 101  # of OpenCV's quality of WebP
ERROR_RANGE = 0.2  # mean absolute difference of encoded values at the heat map's top colour


def to_bytes(values: npt.NDArray[np.floating]) -> U8:
    """8-bit picture of values (H, W, C) in [0, 1]; grey becomes RGB."""
    image = np.asarray(np.round(np.nan_to_num(values).clip(0, 1) * 255), np.uint8)
    image = image[..., None] if image.ndim == 2 else image
    return np.ascontiguousarray(np.repeat(image, 3, 2) if image.shape[2] == 1 else image)


def data_uri(image: U8, side: int, *, lossless: bool = False) -> str:
    """RGB or RGBA picture (H, W, C), reduced to `side` pixels, as JPEG, or as PNG if it has alpha or is lossless."""
    h, w = image.shape[:2]
    shrink = min(1.0, side / max(h, w))
    if shrink < 1:
        size = (max(1, round(w * shrink)), max(1, round(h * shrink)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    png = lossless or image.shape[2] == 4
    order = [2, 1, 0, 3][: image.shape[2]]
    options = [] if png else [cv2.IMWRITE_JPEG_QUALITY, 88]
    done, buffer = cv2.imencode(".png" if png else ".jpg", np.ascontiguousarray(image[..., order]), options)
    if not done:
        raise RuntimeError(f"a picture of {image.shape} can't be encoded")
    return f"data:image/{'png' if png else 'jpeg'};base64,{base64.b64encode(buffer.tobytes()).decode()}"


def error_map(rendered: F32, photo: F32, mask: F32) -> U8:
    """Heat map (H, W, 3) of the mean absolute difference of the encoded subjects, from 0 to ERROR_RANGE."""
    shown, truth = encoded(rendered[..., :3] * rendered[..., 3:]), encoded(photo * mask[..., None])
    return heat(np.abs(shown - truth).mean(-1) / ERROR_RANGE)


def heat(values: F32) -> U8:
    """RGB of values in [0, 1] on a perceptually uniform scale from black to light yellow."""
    level = np.round(values.clip(0, 1) * 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1], np.uint8)


def scale_colours() -> U8:
    """(256, 3) RGB of a scale for maps, from dark blue to yellow, that is even for every kind of colour vision."""
    level = np.arange(256, dtype=np.uint8)[None]
    return np.ascontiguousarray(cv2.applyColorMap(level, cv2.COLORMAP_CIVIDIS)[0, :, ::-1])


def exact_uri(image: U8) -> str:
    """Address of a picture (H, W, 1 or 3), every pixel as it is."""
    colours = image[..., ::-1] if image.shape[2:] == (3,) else np.repeat(image.reshape(*image.shape[:2], 1), 3, 2)
    return webp_uri(lossless_webp(colours))


def lossless_webp(image: U8) -> bytes:
    """A picture (H, W, 3 or 4) in OpenCV's order of channels: about half as large as PNG."""
    done, buffer = cv2.imencode(".webp", np.ascontiguousarray(image), [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS])
    if not done:
        raise RuntimeError(f"a picture of {image.shape} can't be encoded")
    return buffer.tobytes()


def webp_uri(content: bytes) -> str:
    """Address of a WebP, which may move."""
    return f"data:image/webp;base64,{base64.b64encode(content).decode()}"


def scale_bar() -> U8:
    """The heat map's colours from 0 to ERROR_RANGE, for the legend."""
    return heat(np.repeat(np.linspace(0, 1, 256, dtype=np.float32)[None], 12, 0))


def map_picture(values: F32, space: str) -> U8:
    """A map (H, W, C) for display: colours sRGB-encoded, normals as stored, others scaled to their range."""
    if space == "srgb_png":
        return to_bytes(encoded(values[..., :3]))
    if values.shape[2] == 3 and values.min() < -1e-3:
        return to_bytes(values * 0.5 + 0.5)
    grey = values.mean(-1)
    low, high = (float(x) for x in np.percentile(grey, [1, 99]))
    if high - low < 1e-3 * max(abs(low), abs(high), 1e-6):  # constant
        return to_bytes(grey if 0 <= low <= 1 else np.full_like(grey, 0.5))
    return to_bytes((grey - low) / (high - low))


def scaled_picture(values: F32, low: float, high: float) -> U8:
    """A map (H, W, C) of one number on the scale for maps from `low` to `high`, with the scale along its lower edge."""
    share = ((values[..., 0] - low) / (high - low)).clip(0, 1)
    shown = scale_colours()[np.round(np.nan_to_num(share) * 255).astype(np.uint8)]
    width = shown.shape[1]
    bar = scale_colours()[np.linspace(0, 255, width).round().astype(np.uint8)]
    gap = np.full((max(1, width // 60), width, 3), 255, np.uint8)
    return np.concatenate([shown, gap, np.repeat(bar[None], max(2, width // 25), 0)])


def light_picture(values: F32) -> U8:
    """An environment map (H, W, 3), scaled so that its 99th percentile is just below white."""
    top = float(np.percentile(values, 99))
    return to_bytes(encoded(values / max(top, 1e-12) * 0.9))
