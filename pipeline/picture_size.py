"""The size of a picture from its header, so that a decompression bomb is rejected before it is decoded; attributes of
an EXR; and a TIFF whose orientation the decoder does not apply.

A file of a few kilobytes can declare a picture that fills the memory. Only headers are read here, and lengths in them
are compared with the size of the file. Sources: PNG (ISO 15948), JPEG (T.81), TIFF 6.0, OpenEXR file layout.
"""

from __future__ import annotations

import re
import struct
from mmap import ACCESS_READ, mmap
from pathlib import Path

Data = bytes | mmap
PNG = b"\x89PNG\r\n\x1a\n"
_SOF = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # frame headers; the others in that range are tables
_ALONE = {0x01, *range(0xD0, 0xD9)}  # JPEG markers without a length
_TIFF_WIDTH, _TIFF_HEIGHT, _ORIENTATION = 256, 257, 274
_MAX_TAGS, _HEAD = 1000, 65_536


def declared_size(data: Data) -> tuple[int, int] | None:
    """(width, height) in the header of a PNG, JPEG, TIFF, EXR or Radiance file; None if it is not found."""
    try:
        if data[:8] == PNG:
            return struct.unpack_from(">II", data, 16)
        if data[:2] == b"\xff\xd8":
            return _jpeg(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data, "<" if data[:1] == b"I" else ">")
        if data[:4] in (b"II+\0", b"MM\0+"):
            return _big_tiff(data, "<" if data[:1] == b"I" else ">")
        if data[:4] == b"\x76\x2f\x31\x01":
            return _exr(data)
        if data[:2] == b"#?":
            return _radiance(data)
    except (struct.error, ValueError, IndexError, OverflowError):  # the header is damaged: the decoder will report it
        return None
    return None


def declared_size_of(path: Path) -> tuple[int, int] | None:
    """`declared_size` of a file, of which only the header is read; None for an empty file."""
    if not path.stat().st_size:
        return None
    with path.open("rb") as f, mmap(f.fileno(), 0, access=ACCESS_READ) as data:
        return declared_size(data)


def png_claims_more(data: Data) -> bool:
    """Whether a chunk of a PNG is longer than what is left of the file. A decoder may make room for it: up to 4 GB."""
    at = 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        if at + 12 + length > len(data):
            return True
        if data[at + 4 : at + 8] == b"IEND":
            return False
        at += 12 + length
    return False


def without_orientation(data: bytes) -> bytes:
    """The same file with the orientation 1 if it is a TIFF or BigTIFF. OpenCV turns the pixels of a TIFF even where it
    leaves those of other files as they are stored."""
    big = data[:4] in (b"II+\0", b"MM\0+")
    if not big and data[:4] not in (b"II*\0", b"MM\0*"):
        return data
    order = "<" if data[:1] == b"I" else ">"
    try:
        wrong = [
            at for at in _entries(data, order, big=big) if data[at : at + 2] == struct.pack(f"{order}H", _ORIENTATION)
        ]
    except struct.error:  # the directory is cut off: the decoder will report it
        return data
    upright = struct.pack(f"{order}HH{'Q' if big else 'I'}H", _ORIENTATION, 3, 1, 1)
    wrong = [at for at in wrong if data[at : at + len(upright)] != upright]
    if not wrong:
        return data  # a copy of a large file takes time and memory
    changed = bytearray(data)
    for at in wrong:
        changed[at : at + len(upright)] = upright
    return bytes(changed)


def _entries(data: bytes, order: str, *, big: bool) -> list[int]:
    """Offsets of the entries of a TIFF's first directory, those that lie in the file. Raises struct.error."""
    offset, length, size = ("Q", 8, 20) if big else ("I", 2, 12)
    (first,) = struct.unpack_from(f"{order}{offset}", data, 8 if big else 4)
    if first > len(data):
        return []
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, first)
    start = first + length
    return [start + size * i for i in range(min(count, _MAX_TAGS, (len(data) - start) // size))]


def _jpeg(data: Data) -> tuple[int, int] | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF or marker in _ALONE:
            at += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if marker in _SOF:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + length
    return None


def _tiff(data: Data, order: str) -> tuple[int, int] | None:
    (first,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, first)
    found = {}
    for entry in range(count):
        tag, kind = struct.unpack_from(f"{order}HH", data, first + 2 + 12 * entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            form = {3: "H", 4: "I"}[kind] if kind in (3, 4) else "I"
            (found[tag],) = struct.unpack_from(f"{order}{form}", data, first + 10 + 12 * entry)
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None


def _big_tiff(data: Data, order: str) -> tuple[int, int] | None:
    """TIFF with offsets of eight bytes."""
    (first,) = struct.unpack_from(f"{order}Q", data, 8)
    (count,) = struct.unpack_from(f"{order}Q", data, first)
    found = {}
    for entry in range(min(count, _MAX_TAGS)):
        tag, kind = struct.unpack_from(f"{order}HH", data, first + 8 + 20 * entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            form = {3: "H", 4: "I"}.get(kind, "Q")
            (found[tag],) = struct.unpack_from(f"{order}{form}", data, first + 20 + 20 * entry)
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None


def _radiance(data: Data) -> tuple[int, int] | None:
    """Size in a Radiance header: lines of text up to an empty one, then the size."""
    size = re.search(rb"\n\n[-+]Y (\d{1,9}) [-+]X (\d{1,9})\n", data[:_HEAD])
    return (int(size[2]), int(size[1])) if size else None


def _exr(data: Data) -> tuple[int, int] | None:
    window = exr_attribute(data, b"dataWindow")
    if window is None:
        return None
    left, top, right, bottom = struct.unpack("<4i", window[:16])
    return right - left + 1, bottom - top + 1


def exr_attribute(data: Data, name: bytes) -> bytes | None:
    """The value of an attribute in an EXR's header, None if it has none or is damaged. Each is name, type, size in
    bytes, value; an empty name ends the header."""
    at = 8
    while at < len(data) and data[at]:
        name_end = data.find(b"\0", at)
        type_end = data.find(b"\0", name_end + 1)
        if name_end < at or type_end < name_end or type_end + 5 > len(data):
            return None
        (size,) = struct.unpack_from("<i", data, type_end + 1)
        value = type_end + 5
        if size < 0 or value + size > len(data):
            return None
        if data[at:name_end] == name:
            return bytes(data[value : value + size])
        at = value + size
    return None
