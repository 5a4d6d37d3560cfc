"""Is a picture file complete? Decoders fill missing data with grey or black without an error.

JPEG: the end marker after the last scan, and no grey fill of the decoder at the end. PNG: every chunk's CRC up to
IEND. TIFF: every strip and tile inside the file. EXR: the reader itself rejects a truncated file.
"""

from __future__ import annotations

import re
import zlib

import cv2
import numpy as np
import numpy.typing as npt

from stages.capture.exif import first_ifd, is_tiff, jpeg_segments, png_chunks

_STRIPS, _TILES = (273, 279), (324, 325)  # TIFF tags: offsets, byte counts
_NEXT_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # in a scan, FF 00 is a data byte and FF D0..D7 are restarts
GREY, GREY_ROWS = 128, 32  # libjpeg's fill; two rows of its largest blocks
CUT = 8  # bytes: far less than two rows of blocks
BASELINE = (0xC0, 0xC1)  # a truncated progressive file becomes blurred, not grey


def fault_of(data: bytes) -> str | None:
    """What is missing from a JPEG, PNG or TIFF file; None if it is complete (or of another format)."""
    if data[:2] == b"\xff\xd8":
        return _jpeg_fault(data)
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return _png_fault(data)
    return _tiff_fault(data) if is_tiff(data) else None


def _jpeg_fault(data: bytes) -> str | None:
    scan = next((end for marker, _, end in jpeg_segments(data) if marker == 0xDA), None)
    if scan is None:
        return "truncated in the header"
    end = _end_of_image(data, scan)
    if end is None:
        return "truncated: the JPEG has no end marker"
    baseline = any(marker in BASELINE for marker, _, _ in jpeg_segments(data))
    return "truncated: the JPEG's last rows are missing" if baseline and _ends_in_grey(data[:end]) else None


def _end_of_image(data: bytes, scan: int) -> int | None:
    """Offset of the picture's EOI marker, scan by scan (progressive files have several scans)."""
    at = scan
    while (found := _NEXT_MARKER.search(data, at)) is not None:
        if data[found.start() + 1] == 0xD9:
            return found.start()
        at = found.start() + 2 + int.from_bytes(data[found.start() + 2 : found.start() + 4], "big")
    return None


def _ends_in_grey(data: bytes) -> bool:
    """True if the last rows are the decoder's fill. `data`: a file without its EOI marker.

    A photo may end in an exact mid grey. Then its last bytes encode that grey, and without them nothing above it
    changes. If the decoder filled the rows, the last bytes encode the pixels above the grey.
    """
    whole = _decode(data)
    if whole is None or not (whole[-GREY_ROWS:] == GREY).all():
        return False
    other = np.flatnonzero((whole.reshape(len(whole), -1) != GREY).any(1))
    above = int(other[-1]) + 1 if len(other) else 0
    shorter = _decode(data[:-CUT])
    return shorter is None or not np.array_equal(whole[:above], shorter[:above])


def _decode(data: bytes) -> npt.NDArray[np.generic] | None:
    return cv2.imdecode(np.frombuffer(data + b"\xff\xd9", np.uint8), cv2.IMREAD_UNCHANGED)


def _png_fault(data: bytes) -> str | None:
    for kind, start, end in png_chunks(data):
        if end + 4 > len(data):
            return f"truncated in its {kind.decode('latin-1')} data"
        if zlib.crc32(data[start - 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return f"its {kind.decode('latin-1')} data does not match its checksum"
        if kind == b"IEND":
            return None
    return "truncated: the PNG has no end chunk"


def _tiff_fault(data: bytes) -> str | None:
    tags = first_ifd(data)
    for offsets, counts in (_STRIPS, _TILES):
        at, size = tags.get(offsets, ()), tags.get(counts, ())
        if not isinstance(at, tuple) or not isinstance(size, tuple):
            continue
        if any(a + n > len(data) for a, n in zip(at, size, strict=False)):
            return "truncated: image data lies beyond the end of the file"
    return None
