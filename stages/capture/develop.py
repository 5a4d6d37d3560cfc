"""HEIC and camera raw photos as pictures of the kind that the pipeline reads: sRGB-encoded integers, or an error.

HEIC: libheif by pi_heif; it turns the picture upright as the file says (`irot`, `imir`), and the orientation in EXIF,
which repeats that, does not count (ISO/IEC 23008-12, A.2.1). Raw: LibRaw by rawpy, developed linearly: the sensor's
values over black, the camera's white balance and colour matrix, no tone curve, no brightness taken from the picture.
Saturated places become white, so that they count as clipped.
"""

from __future__ import annotations

import base64
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.colour import srgb_from_linear
from pipeline.errors import StageError
from pipeline.images import DENSEST, MAX_PIXELS, SMALL
from stages.capture.exif import Exif, read_exif
from stages.capture.icc_profile import description_of
from stages.capture.integrity import fault_of
from stages.capture.readers.described import HEIF_SUFFIXES, RAW_SUFFIXES

CHILD = Path(__file__).with_name("decode_child.py")
SECONDS = 300  # a raw file of 100 megapixels takes a tenth of it
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}  # ITU-T H.273: not sRGB, and with no largest value
FULL = 65535  # the largest value of 16 bits
KINDS = ("uint8", "uint16")


@dataclass(frozen=True, slots=True)
class Developed:
    """image: (H, W, 1, 3 or 4), sRGB-encoded uint8 or uint16. exif: of the picture as it is here; a raw one still lies
    as in the file, a HEIC one is upright. profile: name of its ICC profile."""

    image: npt.NDArray[np.generic]
    exif: Exif
    profile: str | None = None


def is_raw(path: Path) -> bool:
    """Whether a photo is a camera raw file, by its name."""
    return path.suffix.lower() in RAW_SUFFIXES


def develop(path: Path, data: bytes) -> Developed | None:
    """The picture in a HEIC or raw file; None for other formats, by the file's name. data: the file's bytes.

    Raises:
        StageError: the file is incomplete, of a kind that the libraries do not know, too large, or HDR.
    """
    if path.suffix.lower() in HEIF_SUFFIXES:
        return _heic(path, data)
    return _raw(path, data) if is_raw(path) else None


def _heic(path: Path, data: bytes) -> Developed:
    about, image = _decoded(path, data, "heic")
    transfer = HDR_TRANSFERS.get(about["transfer"])
    if transfer is not None:
        raise StageError(
            "the photo is HDR",
            where=path.name,
            value=f"the transfer function {transfer}",
            limit="an ordinary photo, encoded as sRGB",
            remedy="switch HDR photos off in the camera, or export this one as JPEG",
        )
    block = base64.b64decode(about["exif"]).removeprefix(b"Exif\0\0")
    exif = replace(read_exif(block), orientation=1)
    return Developed(image, exif, description_of(base64.b64decode(about["icc"])) or exif.colours)


def _raw(path: Path, data: bytes) -> Developed:
    fault = fault_of(data)
    if fault is not None:
        raise _undecodable(path, fault, "raw")
    _, linear = _decoded(path, data, "raw")
    encoded = np.round(srgb_from_linear(np.arange(FULL + 1) / FULL) * FULL).astype(np.uint16)
    return Developed(encoded[linear], read_exif(data))


def _decoded(path: Path, data: bytes, kind: str) -> tuple[dict[str, Any], npt.NDArray[Any]]:
    """What decode_child.py says of a file, and its picture (H, W, C)."""
    largest = min(MAX_PIXELS, max(SMALL, DENSEST * len(data)))
    command = [sys.executable, str(CHILD), kind, str(largest)]
    try:
        done = subprocess.run(command, input=data, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=SECONDS)
    except subprocess.TimeoutExpired as e:
        raise _undecodable(path, f"not decoded after {SECONDS} s", kind) from e
    head, _, body = done.stdout.partition(b"\n")
    about: dict[str, Any] = json.loads(head) if done.returncode == 0 and head else {"error": "the decoder crashed"}
    if "too_large" in about:
        raise StageError(
            "the image is too large",
            where=path.name,
            value=about["too_large"],
            limit=f"{largest / 1e6:.0f} megapixels in a file of {len(data) / 1e6:.1f} MB",
            remedy="copy the file again from the camera, or reduce its resolution",
        )
    if "error" in about:
        raise _undecodable(path, about["error"], kind)
    shape = (*about["shape"], 1)[:3]
    if len(about["shape"]) not in (2, 3) or shape[2] not in (1, 3, 4) or about["dtype"] not in KINDS:
        raise _undecodable(path, f"an array of {about['shape']} {about['dtype']}", kind)
    return about, np.frombuffer(body, about["dtype"]).reshape(shape)


def _undecodable(path: Path, why: str, kind: str) -> StageError:
    name = {"heic": "HEIC"}.get(kind, kind)
    return StageError(
        f"the {name} photo can't be read",
        where=path.name,
        value=why[:200],
        limit=f"a complete {name} file of a camera that is known",
        remedy="copy the file again from the camera; or export it as JPEG, PNG or TIFF and take this one out",
    )
