"""Reading and writing pictures. Arrays are RGB(A), row 0 on top; each docstring states whether values are linear."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import REC709, Chromaticities, linear_from_srgb, srgb_from_linear
from pipeline.errors import StageError
from pipeline.picture_size import PNG, declared_size_of, png_claims_more, without_orientation

F32 = npt.NDArray[np.float32]
SOFTWARE = "NeuFace Asset"  # in every EXR; without a version, so that equal maps have equal bytes
ROWS_TEXELS = 1 << 20  # texels converted at once
WRITERS = 8  # largest number of threads that compress an EXR; its bytes do not depend on it
MAX_BYTES = 1 << 32  # that many pixels of RGBA in 32-bit floats, uncompressed
SMALL, DENSEST = 1 << 22, 10_000  # pixels; per byte: a white PNG of one bit a pixel has 8,000
KINDS = (np.uint8, np.uint16, np.float32, np.float64)
MARKS = (b"\x89PNG", b"\xff\xd8", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"RIFF", b"#?")  # RIFF: WebP is 16383 wide
HALF_MAX = 65504.0  # largest 16-bit float; suns are often stored with more, or as infinite
MAX_PIXELS = 1 << 28  # the largest map; no camera has more. A larger file is a mistake or a decompression bomb


def read_encoded(path: Path) -> npt.NDArray[Any]:
    """(H, W, C) values as stored, RGB order. Raises StageError if the file is empty, corrupt or far too large."""
    size = path.stat().st_size if path.is_file() else 0
    refuse_bombs(path, size)
    image = _decoded(path) if size else None
    if image is None:
        raise StageError(
            "the image can't be decoded",
            where=path.name,
            value=f"{size} bytes, not a readable image",
            limit="a complete JPEG, PNG, TIFF or EXR file",
            remedy="copy the file again from the camera, or remove it from the folder",
        )
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise _too_large(path, f"{image.shape[1]} x {image.shape[0]}")
    if image.ndim == 2:
        image = image[..., None]
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(image.shape[2])
    if order is None or image.dtype not in KINDS:
        raise StageError(
            "the image's pixel format is not supported",
            where=path.name,
            value=f"{image.shape[2]} channels of {image.dtype}",
            limit="1, 3 or 4 channels of 8- or 16-bit unsigned integers, or of floats",
            remedy="export the image again as 8- or 16-bit RGB",
        )
    return np.ascontiguousarray(image[..., order])


def refuse_bombs(path: Path, size: int) -> None:
    """Raise StageError if a header declares more pixels than any camera has, or if a file is larger than any photo.
    Nothing is decoded."""
    if size > MAX_BYTES:
        raise _too_large(path, f"{size / 1e9:.1f} GB")
    if size:
        declared = declared_size_of(path)
        if declared is not None and abs(declared[0] * declared[1]) > MAX_PIXELS:
            raise _too_large(path, f"{declared[0]} x {declared[1]}")
        if declared is not None and declared[0] * declared[1] > max(SMALL, DENSEST * size):
            raise StageError(
                "the image declares more pixels than its file can hold",
                where=path.name,
                value=f"{declared[0]} x {declared[1]} in {size} bytes",
                limit=f"{DENSEST} pixels per byte",
                remedy="copy the file again from the camera, or remove it from the folder",
            )


def _too_large(path: Path, value: str) -> StageError:
    return StageError(
        "the image is too large",
        where=path.name,
        value=value,
        limit=f"{MAX_PIXELS / 1e6:.0f} megapixels, {MAX_BYTES / 1e9:.0f} GB",
        remedy="reduce its resolution",
    )


def _decoded(path: Path) -> npt.NDArray[Any] | None:
    """(H, W) or (H, W, C) in OpenCV's channel order, or None. OpenCV's wheel can't read EXR: OpenEXR does it here."""
    if path.suffix.lower() != ".exr":
        data = path.read_bytes()
        if not data.startswith(MARKS):  # OpenCV supports more formats, but their size was not checked
            return None
        if data.startswith(PNG) and png_claims_more(data):
            return None
        try:
            return cv2.imdecode(np.frombuffer(without_orientation(data), np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            return None
    try:
        planes, names = read_exr(path)
    except (RuntimeError, OSError, ValueError, TypeError, KeyError, MemoryError):  # what OpenEXR raises when damaged
        return None
    wanted = _shown(names)
    if wanted is None:
        raise StageError(
            "the image's pixel format is not supported",
            where=path.name,
            value="the channels " + ascii(", ".join(names))[1:-1][:200],
            limit="R, G and B, with A or without; those of one layer (diffuse.R, ...); or one channel alone, such as Y",
            remedy="export the image again with the channels R, G and B",
        )
    return planes[..., [names.index(n) for n in wanted]]


def _shown(names: Sequence[str]) -> list[str] | None:
    """The channels of an EXR that are its picture, in OpenCV's order: the plain colours, or those of the only layer
    that has any; else luminance, or the only channel. None if that leaves several to choose from."""
    of_layer: dict[str, dict[str, str]] = {}
    for name in names:
        layer, dot, channel = name.rpartition(".")
        of_layer.setdefault(layer + dot, {}).setdefault(channel.upper(), name)
    coloured = {layer: own for layer, own in of_layer.items() if {"R", "G", "B"} <= own.keys()}
    own = coloured.get("") or (next(iter(coloured.values())) if len(coloured) == 1 else None)
    if own is not None:
        return [own[c] for c in "BGRA" if c in own]
    if coloured:
        return None
    return ["Y"] if "Y" in names else list(names) if len(names) == 1 else None


def read_linear(path: Path) -> F32:
    """(H, W, 3) linear Rec.709 float32. Integer files are taken as sRGB, float files as linear."""
    return linear_of(read_encoded(path))


def linear_of(stored: npt.NDArray[Any]) -> F32:
    """The same of a file's decoded pixels (H, W, C)."""
    rgb = rgb_of(stored)
    if not np.issubdtype(rgb.dtype, np.integer):
        return rgb.astype(np.float32)
    out: F32 = linear_levels(rgb.dtype)[rgb]
    return out


def rgb_of(stored: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(H, W, 3) colours of a picture as it is stored, (H, W, C): grey three times, and without alpha."""
    return np.repeat(stored, 3, axis=2) if stored.shape[2] == 1 else stored[..., :3]


def linear_levels(kind: np.dtype[Any]) -> F32:
    """Linear value of each level of a picture of unsigned integers, taken as sRGB: 256 or 65536 values."""
    levels = np.iinfo(kind).max
    return np.asarray(linear_from_srgb(np.arange(levels + 1, dtype=np.float64) / levels), np.float32)


def read_alpha(path: Path) -> F32:
    """(H, W) in [0, 1]: a mask's grey value, or the alpha channel of an RGBA file."""
    plane = mask_plane(read_encoded(path))
    return (plane.astype(np.float32) / peak_of(plane.dtype)).clip(0, 1)


def mask_plane(stored: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The values (H, W) of a mask as it is stored, (H, W, C): alpha, or the grey value without one. The alpha of a grey
    picture that is opaque everywhere is none: many programs save black and white with it. A coloured picture is a
    cut-out, whose subject may fill the frame."""
    if stored.shape[2] < 4:
        return stored[..., 0]
    opaque = bool((stored[..., 3] >= peak_of(stored.dtype)).all())
    grey = opaque and bool((stored[..., 1:3] == stored[..., :1]).all())
    return stored[..., 0 if grey else 3]


def peak_of(kind: np.dtype[Any]) -> float:
    """The value of white in a file of this kind."""
    return float(np.iinfo(kind).max) if np.issubdtype(kind, np.integer) else 1.0


PNG_EFFORT = [cv2.IMWRITE_PNG_COMPRESSION, 6]  # a fifth smaller than by default; 40 ms for a map of 1024 x 1024


def write_png(path: Path, image: npt.NDArray[Any], bits: int = 8, *, signed: bool = False) -> None:
    """Write (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) values in [0, 1] without a transfer curve.

    signed: values in [-1, 1], stored as v / 2 + 1 / 2.
    """
    shift: Callable[[npt.NDArray[Any]], npt.NDArray[Any]] = (lambda v: 0.5 * v + 0.5) if signed else (lambda v: v)
    _encode(path, ".png", _whole(image, bits, shift))


def write_png_from_linear(path: Path, image: F32) -> None:
    """Write linear (H, W, 3) as 8-bit sRGB."""
    _encode(path, ".png", _whole(image, 8, lambda v: srgb_from_linear(np.asarray(v, np.float32).clip(0, 1))))


def _whole(
    image: npt.NDArray[Any], bits: int, shown: Callable[[npt.NDArray[Any]], npt.NDArray[Any]]
) -> npt.NDArray[Any]:
    """Integers in OpenCV's channel order, converted some rows at a time, so that a large map is not in memory twice."""
    data = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    peak, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    order = [2, 1, 0, 3][: data.shape[2]] if data.ndim == 3 else None
    out = np.empty(data.shape, kind)
    rows = max(1, ROWS_TEXELS // max(data.shape[1], 1))
    for first in range(0, len(data), rows):
        values = np.minimum(np.fmax(np.asarray(shown(data[first : first + rows]), np.float32), 0), 1)  # NaN is 0
        whole = np.round(values * peak).astype(kind)
        out[first : first + rows] = whole if order is None else whole[..., order]
    return out


def _encode(path: Path, kind: str, data: npt.NDArray[Any]) -> None:
    ok, buffer = cv2.imencode(kind, data, PNG_EFFORT if kind == ".png" else [])
    if not ok:
        raise RuntimeError(f"{path.name}: {kind} can't hold an array of {data.shape} {data.dtype}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(buffer.tobytes())


def write_exr(
    path: Path,
    image: F32,
    channels: tuple[str, ...] | None = None,
    *,
    half: bool = False,
    step: float = 0.0,
    primaries: Chromaticities | None = REC709,
    units: str = "",
) -> None:
    """Write (H, W, C) float values. `channels` names them; default Y, RGB, RGBA, else c0, c1, ...

    half: as 16-bit floats; a larger value becomes the largest of them, 65504. step: values become its nearest
    multiples, a power of two, so that noise below it takes no room. primaries: recorded in pictures with
    channels R, G, B; None if they are not a colour (normals). units: recorded if given ("mm").
    """
    import OpenEXR

    data = np.atleast_3d(np.asarray(image, np.float32))
    count = data.shape[2]
    names = channels or {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}.get(
        count, tuple(f"c{i}" for i in range(count))
    )
    if len(names) != count:
        raise ValueError(f"{len(names)} channel names for {count} channels")
    planes = {n: _plane(data[..., i], half=half, step=step) for i, n in enumerate(names)}
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": SOFTWARE,
    }
    if primaries is not None and {"R", "G", "B"} <= set(names):
        header["chromaticities"] = primaries
    if units:
        header["units"] = units
    path.parent.mkdir(parents=True, exist_ok=True)
    OpenEXR.set_global_thread_count(min(os.cpu_count() or 1, WRITERS))
    try:
        OpenEXR.File(header, planes).write(str(path))
    finally:
        OpenEXR.set_global_thread_count(0)  # after a fork, the threads of a pool would be missing


def _plane(values: F32, *, half: bool, step: float) -> npt.NDArray[Any]:
    """One channel as the writer needs it, in 16 or 32 bits a value."""
    if step:
        values = stepped(values, step)
    if half:
        return np.ascontiguousarray(values.clip(-HALF_MAX, HALF_MAX).astype(np.float16))
    return np.ascontiguousarray(values)


def stepped(values: npt.NDArray[np.floating], step: float) -> F32:
    """The nearest multiples of a step, a power of two: noise below it takes no room in a compressed file."""
    return np.asarray(np.round(values / step) * step, np.float32)


def read_exr(path: Path) -> tuple[F32, tuple[str, ...]]:
    """(H, W, C) float32 and the channels' names, RGBA first in that order, others by name."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as f:
        planes = {n: np.asarray(c.pixels, np.float32) for n, c in f.channels().items()}
    names = tuple(sorted(planes, key=lambda n: ("RGBA".find(n) if n in "RGBA" else 9, n)))
    return np.stack([planes[n] for n in names], -1), names


def shrink(image: F32, factor: int) -> F32:
    """Mean over factor x factor blocks of (H, W) or (H, W, C); H and W must be multiples of the factor."""
    if factor == 1:
        return image
    h, w = image.shape[0] // factor, image.shape[1] // factor
    if (h * factor, w * factor) != image.shape[:2]:
        raise ValueError(f"{image.shape[1]} x {image.shape[0]} is not a multiple of {factor}")
    small = cv2.resize(np.asarray(image, np.float32), (w, h), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32).reshape(h, w, *image.shape[2:])


def shrink_whole(image: F32, factor: int) -> F32:
    """As `shrink`, without the last columns and rows that do not fill a block."""
    return shrink(image[: image.shape[0] // factor * factor, : image.shape[1] // factor * factor], factor)
