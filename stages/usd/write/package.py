"""Writes .usdz: an uncompressed zip whose members start at multiples of 64 bytes.

The USD library's own writer stores modification times; here the same content must give the same bytes.
"""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.images import read_encoded

AR_SIDE = 2048  # texels: the limit of phones
ALIGNMENT = 64
LOCAL_HEADER = 30
PADDING_ID = 0x1986  # the extra-field id that USD's own writer uses for its padding
STAMP = (1980, 1, 1, 0, 0, 0)  # the earliest date in a zip


def write_package(path: Path, members: list[tuple[str, bytes]]) -> None:
    """Write the members in order, the root layer first (a viewer opens the first file)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=False) as z:
        for name, content in members:
            info = zipfile.ZipInfo(name, STAMP)
            info.create_system = 0
            start = z.fp.tell() if z.fp else 0
            info.extra = _padding(start + LOCAL_HEADER + len(name.encode()))
            z.writestr(info, content)


def read_package(path: Path) -> list[tuple[str, bytes]]:
    """The members of a package, in order."""
    with zipfile.ZipFile(path) as z:
        return [(name, z.read(name)) for name in z.namelist()]


def _padding(offset: int) -> bytes:
    """An extra field that moves the data from `offset` to the next multiple of 64; its own header takes 4 bytes."""
    missing = -offset % ALIGNMENT
    if missing == 0:
        return b""
    if missing < 4:
        missing += ALIGNMENT
    return struct.pack("<HH", PADDING_ID, missing - 4) + bytes(missing - 4)


def bounded_png(source: Path | npt.NDArray[np.integer]) -> bytes:
    """A PNG of at most AR_SIDE texels per side: the file itself if it is small enough, else reduced by means over
    blocks.

    `source`: a file, or (H, W, C) as stored. The means are of stored values, which is exact for data and approximate
    for colours. Every 8-bit picture keeps its channels.
    """
    import cv2

    if isinstance(source, Path):
        image = read_encoded(source)
        if max(image.shape[:2]) <= AR_SIDE and image.dtype == np.uint8:
            return source.read_bytes()
    else:
        image = source
    if image.dtype != np.uint8:
        image = np.round(image / 257.0).astype(np.uint8)
    if max(image.shape[:2]) > AR_SIDE:
        image = np.atleast_3d(cv2.resize(image, (AR_SIDE, AR_SIDE), interpolation=cv2.INTER_AREA))
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[image.shape[2]]
    done, content = cv2.imencode(".png", np.ascontiguousarray(image[..., order]))
    if not done:
        raise RuntimeError(f"PNG can't hold an array of {image.shape} {image.dtype}")
    return bytes(content.tobytes())
