"""Writes .usdz: an uncompressed zip whose members start at multiples of 64 bytes.

Own writer instead of the library's, because the same content has to give the same bytes: that one stores the files'
modification times.
"""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

ALIGNMENT = 64
LOCAL_HEADER = 30
PADDING_ID = 0x1986  # the extra-field id that USD's own writer uses for its padding
STAMP = (1980, 1, 1, 0, 0, 0)  # the earliest a zip can hold


def write_package(path: Path, members: list[tuple[str, bytes]]) -> None:
    """Members in order, the root layer first (a viewer opens the first file)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=False) as z:
        for name, content in members:
            info = zipfile.ZipInfo(name, STAMP)
            info.create_system = 0
            start = z.fp.tell() if z.fp else 0
            info.extra = _padding(start + LOCAL_HEADER + len(name.encode()))
            z.writestr(info, content)


def _padding(offset: int) -> bytes:
    """An extra field that moves the data from `offset` to the next multiple of 64; its own header takes 4 bytes."""
    missing = -offset % ALIGNMENT
    if missing == 0:
        return b""
    if missing < 4:
        missing += ALIGNMENT
    return struct.pack("<HH", PADDING_ID, missing - 4) + bytes(missing - 4)
