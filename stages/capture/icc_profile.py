"""Name of a photo's embedded ICC profile, to detect photos whose colours are not sRGB.

Source: ICC.1:2022, sections 7.2 (header), 7.3 (tag table), 10.15 (multiLocalizedUnicodeType); ICC.1:2001-04 for the
older textDescriptionType. In JPEG the profile is in APP2 segments, in PNG in an iCCP chunk, compressed, in TIFF in the
tag 34675. A camera that is set to Adobe RGB says so in EXIF alone; an EXR says its primaries in its header.
"""

from __future__ import annotations

import struct
import zlib

from pipeline.colour import REC709
from pipeline.picture_size import exr_attribute
from stages.capture.exif import ICC_PROFILE, UNCALIBRATED, first_ifd, is_tiff, jpeg_segments, png_chunks

HEADER, MAX_BYTES = 128, 8_000_000
OTHER_PRIMARIES = "other primaries"  # of an EXR; no profile has this name
ALIKE = 0.01  # largest difference of chromaticities: programs round them, and write white as .3127 or .313
_MARK = b"ICC_PROFILE\0"


def profile_name(data: bytes) -> str | None:
    """The profile's description; None if the JPEG, PNG or TIFF file has none, or a damaged one. Of an EXR whose
    primaries are not Rec.709 OTHER_PRIMARIES."""
    if data[:4] == b"\x76\x2f\x31\x01":
        return _primaries(data)
    return description_of(_profile(data) or b"")


def foreign(profile: str) -> tuple[str, str, str]:
    """What a warning says of photos with this profile, which is not sRGB: what they are, how their colours are read,
    and how they should be."""
    if profile == OTHER_PRIMARIES:
        return "have other primaries than Rec.709 in their header", "Rec.709", "linear Rec.709"
    if profile == UNCALIBRATED:
        return "are not sRGB by their EXIF", "sRGB", "sRGB"
    return f"have the colour profile {profile!r}", "sRGB", "sRGB"


def _primaries(data: bytes) -> str | None:
    written = exr_attribute(data, b"chromaticities")
    if written is None or len(written) != 32:
        return None
    found = struct.unpack("<8f", written)
    return None if all(abs(a - b) <= ALIKE for a, b in zip(found, REC709, strict=True)) else OTHER_PRIMARIES


def description_of(block: bytes) -> str | None:
    """The description in an ICC profile's bytes; None if it has none, or is damaged."""
    if len(block) < HEADER + 4:
        return None
    count = struct.unpack_from(">I", block, HEADER)[0]
    for i in range(min(count, 100)):
        entry = HEADER + 4 + 12 * i
        if entry + 12 > len(block):
            return None
        name, offset, size = struct.unpack_from(">4sII", block, entry)
        if name == b"desc" and offset + size <= len(block) and size >= 12:
            return _text(block[offset : offset + size])
    return None


def is_srgb(name: str | None) -> bool:
    """Whether a photo with this profile is sRGB; without a profile sRGB is assumed."""
    return name is None or "srgb" in name.lower().replace(" ", "")


def _profile(data: bytes) -> bytes | None:
    if data[:2] == b"\xff\xd8":
        parts = [data[a:b] for marker, a, b in jpeg_segments(data) if marker == 0xE2]
        mine = sorted((p[12], p[14:]) for p in parts if p[:12] == _MARK and len(p) > 14)
        return b"".join(p for _, p in mine) or None
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        for kind, a, b in png_chunks(data):
            if kind == b"iCCP":
                packed = data[a:b].partition(b"\0")[2][1:]
                try:
                    return zlib.decompressobj().decompress(packed, MAX_BYTES)
                except zlib.error:
                    return None
    if is_tiff(data):
        block = first_ifd(data).get(ICC_PROFILE, ())
        return bytes(int(v) & 0xFF for v in block) if isinstance(block, tuple) else None
    return None


def _text(tag: bytes) -> str | None:
    if tag[:4] == b"desc":
        length = struct.unpack_from(">I", tag, 8)[0]
        return tag[12 : 12 + length].split(b"\0")[0].decode("latin-1").strip() or None
    if tag[:4] == b"mluc" and len(tag) >= 28:
        length, offset = struct.unpack_from(">II", tag, 20)
        return tag[offset : offset + length].decode("utf-16-be", "replace").strip("\0 ") or None
    return None
