"""Checks one photo or mask and copies it.

A photo's bytes are copied unchanged. Only these are written as PNG: a photo whose EXIF orientation is not 1 is rotated
upright, because later stages read the stored pixels and ignore EXIF; and HEIC and raw files are developed. A TIFF of
floats that is rotated becomes EXR.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import FileRef, sha256_of
from pipeline.errors import StageError
from pipeline.images import mask_plane, peak_of, read_encoded, refuse_bombs, write_exr
from pipeline.sharpness import detail
from stages.capture.colour_checker import Patches, find_chart
from stages.capture.develop import Developed, develop
from stages.capture.exif import Exif, read_exif
from stages.capture.icc_profile import profile_name
from stages.capture.integrity import fault_of
from stages.capture.photo_figures import PhotoFigures, measure_photo
from stages.capture.photometry import clipped, mean_light
from stages.capture.quality import is_blank, small_grey

Image = npt.NDArray[np.generic]
MIN_EDGE = 64  # pixels: smaller photos have too little detail for features and for the fit
_TURNS = {3: (2, False), 6: (3, False), 8: (1, False), 2: (0, True), 4: (2, True), 5: (3, True), 7: (1, True)}


@dataclass(frozen=True, slots=True)
class ImportedPhoto:
    """A checked photo in the artifact. width, height: of the copy, pixels. turned: rotated upright and written as PNG.
    detail: see stages.capture.quality, None if the photo is blank. profile: name of its ICC profile, or what EXIF says
    in its place, None without both. clipped: picture of the clipped pixels, None if there are none. light: mean linear
    luminance. chart: its colour checker, None if not searched or not found. look: its quality figures, None if it is
    blank."""

    image: Path
    width: int
    height: int
    exif: Exif
    turned: bool
    detail: float | None = None
    profile: str | None = None
    clipped: Path | None = None
    light: float = 0.0
    chart: Patches | None = None
    look: PhotoFigures | None = None


def turn_upright(image: Image, orientation: int) -> Image:
    """The picture rotated upright. (H, W, C) -> (H, W, C) or (W, H, C); orientation 1..8 as in EXIF."""
    quarter, mirrored = _TURNS.get(orientation, (0, False))
    turned = np.rot90(image, quarter)  # rot90 is anticlockwise; 6 means a quarter turn clockwise, so three of them
    return np.ascontiguousarray(turned[:, ::-1] if mirrored else turned)


@dataclass(frozen=True, slots=True)
class Decoded:
    """A photo's stored pixels (H, W, C), as it lies in the file, with its metadata. developed: of a HEIC or raw file.
    data: the file, whose hash was checked.
    clipped (H, W): pixels that are clipped in every exposure of a merged photo, None to find them in the pixels."""

    image: Image
    exif: Exif
    profile: str | None
    developed: bool = False
    clipped: npt.NDArray[np.bool_] | None = None
    data: bytes = b""


def decoded(path: Path, ref: FileRef) -> Decoded:
    """Read one photo. Raises StageError if the file is incomplete, too large, or not finite."""
    data = _read(path, ref)
    made = _developed(path, data)
    if made is not None:
        return Decoded(made.image, made.exif, made.profile, developed=True)
    exif = read_exif(data)
    return Decoded(_decode(path, data), exif, profile_name(data) or exif.colours, data=data)


def import_photo(
    path: Path, ref: FileRef, target: Path, declared: tuple[int, int] | None, *, chart: bool = False,
    merged: Decoded | None = None,
) -> ImportedPhoto:  # fmt: skip
    """Check one photo and copy it to `target` (whose suffix becomes .png if it has to be rotated or developed, and .exr
    if it was merged from several, or holds floats and has to be rotated).

    chart: search for a colour checker. merged: pixels to take in place of the file's.
    declared: (width, height) from the camera's description, or None. If the stored pixels have this size, the given
    camera belongs to them, and the photo is not rotated, whatever its EXIF orientation.
    Raises StageError if the file is incomplete, too small or large, not finite, or not of the declared size.
    """
    found = decoded(path, ref) if merged is None else merged
    image, exif, profile = found.image, found.exif, found.profile
    h, w = image.shape[:2]
    upright = (h, w) if exif.orientation >= 5 else (w, h)
    turn = exif.orientation != 1 and (declared is None or (w, h) != declared == upright)
    size = upright if turn else (w, h)
    if declared is not None and size != declared:
        raise StageError(
            "the photo is not of the size that its camera declares",
            where=path.name,
            value=f"{size[0]} x {size[1]}",
            limit=f"{declared[0]} x {declared[1]}",
            remedy="use the photos that were calibrated, at their original size; or correct width, height and K",
        )
    if min(size) < MIN_EDGE:
        raise StageError(
            "the photo is too small",
            where=path.name,
            value=f"{size[0]} x {size[1]}",
            limit=f"at least {MIN_EDGE} pixels along each edge",
            remedy="use the original photo, not a preview",
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    ends = clipped(image) if found.clipped is None else found.clipped
    if turn:
        image = turn_upright(image, exif.orientation)
        ends = np.asarray(turn_upright(ends[..., None], exif.orientation)[..., 0], np.bool_)
    if merged is not None:
        target = target.with_suffix(".exr")
        write_exr(target, np.asarray(image, np.float32), half=True)
    elif turn and np.issubdtype(image.dtype, np.floating):
        target = target.with_suffix(".exr")  # a PNG would hold 256 of its levels, none above 1
        write_exr(target, np.asarray(image, np.float32))
    elif turn or found.developed:
        target = target.with_suffix(".png")
        _write_png(target, image)
    else:
        target.write_bytes(found.data)
    grey = small_grey(image)
    blank = is_blank(grey)
    return ImportedPhoto(target, size[0], size[1], exif, turn, None if blank else detail(grey), profile,
                    _write_clipped(ends, target), mean_light(grey), find_chart(image) if chart else None,
                    None if blank else measure_photo(image, grey, ends))  # fmt: skip


def _write_clipped(where: npt.NDArray[np.bool_], photo: Path) -> Path | None:
    """Write a photo's clipped pixels (255) to clipped_FOLDER beside its folder; None if there are none. A clean plate
    and the second photo of a pair may have the photo's name, so that each folder of photos has its own."""
    if not where.any():
        return None
    path = photo.parent.parent / f"clipped_{photo.parent.name}" / f"{photo.stem}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_png(path, where[..., None].astype(np.uint8) * 255)
    return path


def import_mask(path: Path, ref: FileRef, target: Path, photo: ImportedPhoto) -> str | None:
    """Check one mask against its photo and copy it to `target`; or return why it can't be used, and copy nothing.

    A mask of the upright size is taken as upright; one that has only the stored size is rotated with its photo.
    Raises StageError if the file is incomplete.
    """
    data = _read(path, ref)
    image = _decode(path, data)
    size = (image.shape[1], image.shape[0])
    turn = photo.turned and size != (photo.width, photo.height) and size == (photo.height, photo.width)
    if size != (photo.width, photo.height) and not turn:
        sizes = f"{size[0]} x {size[1]} pixels, its photo {photo.width} x {photo.height}"
        return f"the mask {path.name} has {sizes}; export it at the photo's size"
    plane = mask_plane(image)
    inside = float((plane.astype(np.float64) > peak_of(plane.dtype) / 2).mean())
    if inside in (0.0, 1.0):
        return (f"the mask {path.name} is {'empty' if inside == 0 else 'full'}; draw it again, 0 on the background and "
                "255 on the subject")  # fmt: skip
    target.parent.mkdir(parents=True, exist_ok=True)
    if turn:
        _write_png(target.with_suffix(".png"), turn_upright(image, photo.exif.orientation))
    else:
        target.write_bytes(data)
    return None


def _read(path: Path, ref: FileRef) -> bytes:
    """The file's bytes. Raises StageError if they changed since they were hashed."""
    if not path.is_file() or path.stat().st_size != ref.size or sha256_of(path) != ref.sha256:
        raise StageError(
            "a file changed while the capture was read",
            where=path.name,
            value="its content is different now" if path.is_file() else "it no longer exists",
            limit="files that do not change during a run",
            remedy="wait until all files are copied, then run again",
        )
    return path.read_bytes()


def _developed(path: Path, data: bytes) -> Developed | None:
    _refuse_empty(path, data)
    return develop(path, data)


def _refuse_empty(path: Path, data: bytes) -> None:
    if not data:
        raise StageError(
            "the image is empty",
            where=path.name,
            value="0 bytes",
            limit="a complete image file",
            remedy="copy the file again from the camera, or take it out of the folder",
        )


def _decode(path: Path, data: bytes) -> Image:
    _refuse_empty(path, data)
    refuse_bombs(path, len(data))  # before `fault_of`, which decodes JPEG files
    fault = fault_of(data)
    if fault is not None:
        raise StageError(
            "the image is not complete",
            where=path.name,
            value=fault,
            limit="a complete image file",
            remedy="copy the file again from the camera, or take it out of the folder",
        )
    image = read_encoded(path)
    if np.issubdtype(image.dtype, np.floating) and not np.isfinite(image).all():
        raise StageError(
            "the image has values that are not finite",
            where=path.name,
            value=f"{int((~np.isfinite(image)).sum())} NaN or Inf values",
            limit="finite radiance",
            remedy="export the image again",
        )
    return image


def _write_png(path: Path, image: Image) -> None:
    """Write stored values unchanged, RGB order, with the fastest compression: photos hardly shrink further."""
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[image.shape[2]]
    ok, buffer = cv2.imencode(".png", np.ascontiguousarray(image[..., order]), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise RuntimeError(f"{path.name}: PNG can't hold an array of {image.shape} {image.dtype}")
    path.write_bytes(buffer.tobytes())
