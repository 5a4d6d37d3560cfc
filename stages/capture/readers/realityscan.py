"""Reads the XMP sidecars of RealityScan (RealityCapture): `photo.xmp` beside `photo.jpg`, names in `xcr:`.

`Rotation`: 9 numbers, row by row, camera from world with OpenCV's axes. `Position`: the camera's centre in the world.
`FocalLength35mm`: focal length where the longer edge of the frame is 36 mm. `PrincipalPointU`, `V`: offset from the
frame's centre as a share of the longer edge. `DistortionModel`, `DistortionCoeficients` (their spelling): k1 k2 k3
k4 t1 t2 of Brown's model. Each may be an attribute or an element. Source: 'RealityCapture XMP Camera Math'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pipeline.transforms import F64
from stages.capture.readers.cameras import checked_frame, checked_lens, given_camera
from stages.capture.readers.described import (
    PHOTO_SUFFIXES,
    Declared,
    Described,
    description,
    five_terms,
    indices_of,
    natural_key,
)
from stages.capture.readers.sizes import picture_size
from stages.capture.readers.values import fault, label, printable, words

SPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
MARK = b"capturingreality.com/ns/xcr"
FULL_FRAME_MM = 36.0
REMEDY = "export the registration again (Export > Metadata (XMP)), or remove the .xmp files to solve the cameras"


def find(folder: Path) -> list[Path]:
    """Sidecars with a pose, in natural order. Other tools write .xmp files too, without a pose."""
    found = sorted(folder.glob("*.xmp"), key=lambda p: natural_key(p.name))
    return [p for p in found if MARK in (text := description(p)) and b"Position" in text]


def read(folder: Path, files: Sequence[Path]) -> Described:
    """Photos that have a sidecar. The others are left out, because their pose is unknown."""
    photos = [
        p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith(".") and p.is_file()
    ]
    by_stem = {p.stem: p for p in sorted(photos)}
    views, left_out, warnings = [], [], []
    for index, sidecar in zip(indices_of([f.name for f in files]), files, strict=True):
        photo = by_stem.pop(sidecar.stem, None)
        if photo is None:
            left_out.append(f"{sidecar.stem}: its photo is missing")
            warnings.append(f"{sidecar.name} has no photo beside it; put the photo back or remove the file")
            continue
        size = picture_size(photo)
        K, pose, d = _camera(_fields(sidecar), size, sidecar.name)
        views.append(Declared(index, photo.name, photo, given_camera(K, pose, d, sidecar.name, size), size))
    left_out += [f"{p.name}: it was not registered (no .xmp with a pose)" for _, p in sorted(by_stem.items())]
    return Described(tuple(views), tuple(left_out), tuple(n.split(":")[0] for n in left_out), tuple(warnings))


def _fields(path: Path) -> dict[str, str]:
    try:
        root = ElementTree.fromstring(description(path))
    except (ElementTree.ParseError, ValueError, LookupError) as e:
        raise fault("a camera's file can't be read", path.name, printable(str(e)), "XMP of RealityScan", REMEDY) from e
    found: dict[str, str] = {}
    for element in root.iter():
        found |= {k.removeprefix(SPACE): v for k, v in element.attrib.items() if k.startswith(SPACE)}
        if element.tag.startswith(SPACE):
            found[element.tag.removeprefix(SPACE)] = element.text or ""
    return found


def _camera(fields: Mapping[str, str], size: tuple[int, int], where: str) -> tuple[F64, F64, F64]:
    """K (3, 3), cam_from_world (3, 4), k1 k2 p1 p2 k3."""
    edge = float(max(size))
    R = _numbers(fields, "Rotation", 9, where).reshape(3, 3)
    centre = _numbers(fields, "Position", 3, where)
    focal = float(_numbers(fields, "FocalLength35mm", 1, where)[0]) / FULL_FRAME_MM * edge
    u, v = (float(_numbers(fields, k, 1, where, "0")[0]) for k in ("PrincipalPointU", "PrincipalPointV"))
    K = np.array([[focal, 0, size[0] / 2 + u * edge], [0, focal, size[1] / 2 + v * edge], [0, 0, 1.0]])
    pose = np.concatenate([R, (-R @ centre)[:, None]], 1)
    model = label(fields.get("DistortionModel", "perspective"), where, REMEDY).lower()
    if not (model == "perspective" or model.startswith("brown")):
        raise fault("the lens model is not supported", where, printable(model), "perspective or Brown",
                    "choose a Brown model in the alignment settings and export again")  # fmt: skip
    k1, k2, k3, k4, t1, t2 = _numbers(fields, "DistortionCoeficients", 6, where, "0 0 0 0 0 0")
    d = checked_lens(checked_frame(K, size, where), np.array([k1, k2, t1, t2, k3]), size, where)
    if model == "perspective" or k4 == 0:
        return K, pose, d * (model != "perspective")

    def image_from_plane(xy: F64) -> F64:
        x, y, r2 = xy[:, 0], xy[:, 1], (xy * xy).sum(1)
        bent = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        across = x * bent + 2 * t1 * x * y + t2 * (r2 + 2 * x * x)
        down = y * bent + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
        return np.stack([focal * across + K[0, 2], focal * down + K[1, 2]], -1)

    K, d, _ = five_terms(image_from_plane, K, size[0], size[1], where)
    return K, pose, d


def _numbers(fields: Mapping[str, str], key: str, count: int, where: str, default: str | None = None) -> F64:
    text = fields.get(key, default)
    if text is None:
        raise fault("a camera parameter is missing", f"{where}, xcr:{key}", "missing", "a registered photo", REMEDY)
    return words(text, count, f"{where}, xcr:{key}", REMEDY)
