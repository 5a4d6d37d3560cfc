"""Do the counts in a binary COLMAP model fit its bytes? COLMAP itself allocates memory for any count, even terabytes.

Source: COLMAP's documentation, 'Output format', and its own reading of `rigs.bin` and `frames.bin`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

PARAMETERS = {
    0: 3,
    1: 4,
    2: 4,
    3: 5,
    4: 8,
    5: 8,
    6: 12,
    7: 5,
    8: 4,
    9: 5,
    10: 12,
    11: 16,
    12: 4,
    13: 5,
    14: 3,
    15: 4,
    16: 6,
    17: 2,
}  # fmt: skip  (numbers of each camera model; others are left to COLMAP)
MAX_BYTES = 1 << 31
MAX_NAME = 4096


def miscounted(files: Sequence[Path]) -> str | None:
    """What is wrong with the counts, or None. COLMAP trusts no counts in text models, so they are not checked."""
    for path in files:
        if path.stat().st_size > MAX_BYTES:
            return f"{path.name} has more than {MAX_BYTES // 2**30} GB"
        skip = _SKIPS.get(path.name)
        if skip is None:
            continue
        try:
            if _end(path.read_bytes(), skip) is None:
                return f"{path.name} is incomplete, or its counts are damaged"
        except (struct.error, ValueError):
            return f"{path.name} is incomplete"
    return None


def _end(data: bytes, skip: Callable[[bytes, int], int]) -> int | None:
    """Offset of the end of the records; None if they reach beyond the data."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(min(count, len(data))):  # a record has at least one byte
        at = skip(data, at)
        if at > len(data):
            return None
    return at if count <= len(data) else None


def _camera(data: bytes, at: int) -> int:
    (model,) = struct.unpack_from("<i", data, at + 4)
    return at + 24 + 8 * PARAMETERS.get(model, 1)


def _image(data: bytes, at: int) -> int:
    end = data.index(b"\0", at + 64, at + 65 + MAX_NAME)
    (points,) = struct.unpack_from("<Q", data, end + 1)
    return int(end + 9 + 24 * points)


def _point(data: bytes, at: int) -> int:
    (track,) = struct.unpack_from("<Q", data, at + 43)
    return int(at + 51 + 8 * track)


def _rig(data: bytes, at: int) -> int:
    (sensors,) = struct.unpack_from("<I", data, at + 4)
    at += 16 if sensors else 8
    for _ in range(min(max(sensors - 1, 0), len(data))):
        at += 9 + (56 if data[at + 8 : at + 9] == b"\1" else 0)
        if at > len(data):
            break
    return at


def _frame(data: bytes, at: int) -> int:
    (entries,) = struct.unpack_from("<I", data, at + 64)
    return int(at + 68 + 16 * entries)


_SKIPS = {"cameras.bin": _camera, "images.bin": _image, "points3D.bin": _point, "rigs.bin": _rig, "frames.bin": _frame}
