"""Width and height of a picture if the cameras' file does not contain them."""

from __future__ import annotations

from pathlib import Path

from pipeline.picture_size import declared_size_of


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels as stored: from the header, or else by decoding the picture.

    Raises StageError if the file is no picture.
    """
    declared = declared_size_of(path)
    if declared is not None and min(declared) > 0:
        return declared
    from pipeline.images import read_encoded

    image = read_encoded(path)
    return image.shape[1], image.shape[0]
