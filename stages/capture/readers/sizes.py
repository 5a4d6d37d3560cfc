"""Width and height of a picture from its header."""

from __future__ import annotations

from pathlib import Path

from stages.capture.exif import jpeg_segments

START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
HEAD = 1 << 18  # bytes: previews inside the metadata come before a JPEG's own size


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels as stored. JPEG and PNG by their headers, others by reading them.

    Raises StageError if the file is no picture.
    """
    with path.open("rb") as f:
        head = f.read(HEAD)
    if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) >= 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if head[:2] == b"\xff\xd8":
        for marker, start, _ in jpeg_segments(head):
            if marker in START_OF_FRAME and start + 5 <= len(head):
                return int.from_bytes(head[start + 3 : start + 5], "big"), int.from_bytes(
                    head[start + 1 : start + 3], "big"
                )
    from pipeline.images import read_encoded

    image = read_encoded(path)
    return image.shape[1], image.shape[0]
