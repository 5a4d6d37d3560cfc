"""Decodes one HEIC or raw file in a process of its own: a damaged file may crash the libraries that read it.

    python decode_child.py heic|raw LARGEST < FILE

LARGEST: pixels that a picture may have. On stdout: a line of JSON, then the picture's bytes. The line has `shape` and
`dtype` of the picture; for HEIC also `exif` and `icc` (base64) and `transfer` (ITU-T H.273). Or it has `error` or
`too_large`.
It needs nothing of this project, so that it starts quickly; `develop.py` is its other side.
"""

from __future__ import annotations

import base64
import io
import json
import os
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

Decoded = tuple[dict[str, Any], npt.NDArray[Any]]


class TooLarge(Exception):
    """The header declares more pixels than the picture may have."""


def heic(data: bytes, largest: int) -> Decoded:
    """8 or 16 bits, upright by the file's own transformations. TooLarge, or whatever the library raises."""
    import pi_heif

    file = pi_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)
    width, height = file.size
    _check_size(width, height, largest)
    info = file.info
    found = {"exif": info.get("exif"), "icc": info.get("icc_profile")}
    texts = {name: base64.b64encode(bytes(block or b"")).decode() for name, block in found.items()}
    profile = info.get("nclx_profile") or {}
    return {**texts, "transfer": int(profile.get("transfer_characteristics", 0))}, np.asarray(file)


def raw(data: bytes, largest: int) -> Decoded:
    """Linear Rec.709 in 16 bits, as it lies in the file. TooLarge, or whatever the library raises."""
    import rawpy

    with rawpy.imread(io.BytesIO(data)) as file:
        _check_size(file.sizes.raw_width, file.sizes.raw_height, largest)
        picture = file.postprocess(
            gamma=(1, 1),
            output_bps=16,
            output_color=rawpy.ColorSpace.sRGB,
            use_camera_wb=True,
            no_auto_bright=True,
            adjust_maximum_thr=0.0,  # else the white level depends on the picture's brightest pixel
            highlight_mode=rawpy.HighlightMode.Clip,
            user_flip=0,  # the photo is turned as others are, by its EXIF
        )
    return {}, picture


def _check_size(width: int, height: int, largest: int) -> None:
    if width * height > largest:
        raise TooLarge(f"{width} x {height}")


def main(kind: str, largest: str) -> None:
    """Decode stdin to stdout. What a library prints goes to stderr."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        about, picture = (heic if kind == "heic" else raw)(sys.stdin.buffer.read(), int(largest))
        picture = np.ascontiguousarray(picture)
        head = {**about, "shape": picture.shape, "dtype": str(picture.dtype)}
        body = picture.tobytes()
    except TooLarge as e:
        head, body = {"too_large": str(e)}, b""
    except Exception as e:  # the libraries name dozens of their own
        said = e.args[0] if e.args else type(e).__name__
        head, body = {"error": said.decode(errors="replace") if isinstance(said, bytes) else str(said)}, b""
    with answer:
        answer.write(json.dumps(head).encode() + b"\n" + body)


if __name__ == "__main__":
    main(*sys.argv[1:])
