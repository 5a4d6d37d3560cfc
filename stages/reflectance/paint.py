"""Painted masks: texels whose functions are replaced by those of the tissue around them.

A blemish, a marker or a hair that was measured is marked in the field's texture coordinates. Albedo, lobes, rest, and
what is known of shadows are continued from around (`fill.py`); the normal is the surface's. All functions change at the
same texels, so that the place answers light as its surroundings do.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.errors import StageError
from pipeline.images import F32, read_encoded
from stages.reflectance.config import mask_files
from stages.reflectance.fill import harmonic
from stages.reflectance.texels import Points

Marks = npt.NDArray[np.bool_]
HALF = 0.5  # of the largest value: brighter pixels mark
REMEDY = "paint white on black over albedo.exr of an earlier run with the same settings; save square 8-bit PNG files"


def read_masks(folder: Path) -> list[Marks]:
    """The masks (N, N) of a folder, each of its own size: true where it is painted.

    Raises:
        StageError: there is no mask, or one can't be read, is not square, or has no marked pixel.
    """
    found = mask_files(folder)
    if not found:
        what = "no PNG file" if folder.is_dir() else "no such folder"
        raise _refused("there are no painted masks", folder, what, "a folder with PNG files")
    return [_mask(path) for path in found]


def _mask(path: Path) -> Marks:
    image = read_encoded(path)
    if image.shape[0] != image.shape[1]:
        value = f"{image.shape[1]} x {image.shape[0]}"
        raise _refused("a painted mask is not square", path, value, "a square picture of any size")
    top = float(np.iinfo(image.dtype.name).max) if np.issubdtype(image.dtype, np.integer) else 1.0
    values = image.astype(np.float64) / top
    bright = values[..., :3].max(2) if values.shape[2] >= 3 else values[..., 0]
    shown = bright * (values[..., -1] if values.shape[2] in (2, 4) else 1.0)  # transparent pixels mark nothing
    if not (shown > HALF).any():
        raise _refused("a painted mask marks nothing", path, f"brightest value {shown.max():.2f}", f"above {HALF:g}")
    return np.asarray(shown > HALF)


def marked(masks: list[Marks], points: Points) -> Marks:
    """(T,) texels whose centre is under a marked pixel of any mask. Row 0 is at v = 1, as in the field's maps."""
    size, out = points.size, np.zeros(len(points.texel), np.bool_)
    row, column = (points.texel // size + 0.5) / size, (points.texel % size + 0.5) / size
    for mask in masks:
        side = len(mask)
        out |= mask[(row * side).astype(np.int64), (column * side).astype(np.int64)]
    return out


def replaced(values: F32, marks: Marks, known: Marks, position: npt.NDArray[np.float64]) -> F32:
    """(T, C) values with those of marked and of unknown texels continued from the others.

    Raises:
        StageError: nothing is left to continue from.
    """
    if marks.any() and not (known & ~marks).any():
        raise _refused("the painted masks leave nothing", "reflectance.paint", "all texels that a camera sees",
                       "some tissue around the marked places")  # fmt: skip
    return harmonic(values, known & ~marks, position)


def _refused(what: str, where: object, value: object, limit: object) -> StageError:
    return StageError(what, where=where, value=value, limit=limit, remedy=REMEDY)
