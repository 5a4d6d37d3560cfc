"""A small camera raw file (DNG 1.4) from linear colours, for a camera whose filters are Rec.709."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import tifffile

BLACK, WHITE = 256, 4095
NEUTRAL = (0.5, 1.0, 0.625)  # what the sensor has for a grey: the camera's white balance
XYZ_FROM_REC709 = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175],
                            [0.0193339, 0.119192, 0.9503041]])  # fmt: skip
ASCII, BYTE, SHORT, RATIONALS, SIGNED_RATIONALS = "s", "B", "H", "2I", "2i"


def write_dng(path: Path, linear: npt.NDArray[np.float64], orientation: int = 1, scale: int = 10_000) -> None:
    """linear: (H, W, 3), even sides; 1 is the sensor's limit in green, and larger values are cut there."""
    seen = np.clip(linear * NEUTRAL, 0, 1)
    bayer = seen[..., 1].copy()  # R G / G B
    bayer[0::2, 0::2], bayer[1::2, 1::2] = seen[0::2, 0::2, 0], seen[1::2, 1::2, 2]
    stored = np.round(BLACK + bayer * (WHITE - BLACK)).astype(np.uint16)
    matrix = [v for x in np.linalg.inv(XYZ_FROM_REC709).ravel() for v in (round(x * scale), scale)]
    white = [v for x in NEUTRAL for v in (round(x * scale), scale)]
    tags = [
        (271, ASCII, 0, "Maker", True),
        (272, ASCII, 0, "Model", True),
        (274, SHORT, 1, orientation, True),
        (33421, SHORT, 2, (2, 2), True),  # size and colours of the filters' pattern
        (33422, BYTE, 4, bytes((0, 1, 1, 2)), True),
        (41989, SHORT, 1, 50, True),  # focal length as on 35 mm film
        (50706, BYTE, 4, bytes((1, 4, 0, 0)), True),  # DNG's version
        (50708, ASCII, 0, "Maker Model", True),
        (50714, SHORT, 1, BLACK, True),
        (50717, SHORT, 1, WHITE, True),
        (50721, SIGNED_RATIONALS, 9, matrix, True),
        (50728, RATIONALS, 3, white, True),
        (50778, SHORT, 1, 21, True),  # D65
    ]
    tifffile.imwrite(path, stored, photometric="CFA", extratags=tags, metadata=None)
