"""Reads FaceScape's `params.json`.

Per view i: `{i}_K` 3x3, `{i}_Rt` 3x4 world-to-camera with OpenCV axes, `{i}_distortion` k1 k2 p1 p2 k3, `{i}_width`,
`{i}_height`, `{i}_valid`, `{i}_sn` (the camera body). FaceScape has the first pixel's centre at (0, 0), so the reader
adds half a pixel to the principal point.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.capture_artifacts import GivenCamera
from pipeline.errors import StageError
from pipeline.transforms import F64, corner_K_from_centre_K
from stages.capture.readers.cameras import checked_frame, checked_K, checked_lens, given_camera
from stages.capture.readers.described import (
    PHOTO_SUFFIXES,
    Declared,
    Described,
    natural_key,
    read_json,
)
from stages.capture.readers.values import DIGITS, fault, flag, label, pixels, table, view_number

PARAMS = "params.json"
_KEY = re.compile(r"(\d+)_(K|Rt|distortion|width|height|valid|ori|sn|matches)")


def find(folder: Path) -> list[Path]:
    """params.json."""
    params = folder / PARAMS
    return [params] if params.is_file() else []


def read(folder: Path, files: Sequence[Path]) -> Described:
    """Valid views with their photos. Invalid views, and views whose photo is missing, are left out."""
    params = read_params(files[0])
    indices = view_indices(params)
    photos = _by_index(folder, set(indices))
    views, left_out, absent, warnings = [], [], [], []
    for index in indices:
        photo = photos.get(index)
        name = photo.name if photo else f"{index}"
        if not is_valid(params, index):
            left_out.append(f"{name}: params.json marks it invalid")
            absent.append(name)
        elif photo is None:
            left_out.append(f"{name}: its photo is missing")
            absent.append(name)
            warnings.append(f"params.json lists view {index}, but its photo is missing")
        else:
            camera, size = given_view(params, index)
            serial = label(params.get(f"{index}_sn", ""), _where(f"{index}_sn"))
            views.append(Declared(index, photo.name, photo, camera, size, serial))
    return Described(tuple(views), tuple(left_out), tuple(absent), tuple(warnings))


def _by_index(folder: Path, indices: set[int]) -> dict[int, Path]:
    """The photos of the views of params.json, by view number. Raises StageError if a view has two."""
    named: dict[int, Path] = {}
    for photo in sorted(folder.iterdir(), key=lambda p: natural_key(p.name)):
        usable = photo.suffix.lower() in PHOTO_SUFFIXES and not photo.name.startswith(".") and photo.is_file()
        if not usable or not photo.stem.isdecimal() or len(photo.stem) > DIGITS or int(photo.stem) not in indices:
            continue
        index = int(photo.stem)
        if index in named:
            raise StageError(
                "two photos for one view",
                where=f"view {index}",
                value=f"{named[index].name} and {photo.name}",
                limit="one file per view",
                remedy="remove one of them from the folder",
            )
        named[index] = photo
    return named


def read_params(path: Path) -> dict[str, Any]:
    """The file as a dictionary. Raises StageError if it is not a JSON object with views."""
    found = read_json(path, "params.json can't be read",
                        "copy the file again, or remove it to solve the cameras from the photos")  # fmt: skip
    if not isinstance(found, dict) or not view_indices(found):
        value = f"{len(found)} keys, none like 0_K" if isinstance(found, dict) else type(found).__name__
        raise StageError(
            "params.json has no views",
            where=path.name,
            value=value,
            limit="keys 0_K, 0_Rt, 0_distortion, 0_width, 0_height, ...",
            remedy="use FaceScape's layout, or remove the file to solve the cameras from the photos",
        )
    return found


def view_indices(params: Mapping[str, Any]) -> list[int]:
    """Indices of all views in params.json, ascending."""
    return sorted({view_number(m[1], PARAMS) for m in map(_KEY.fullmatch, params) if m})


def is_valid(params: Mapping[str, Any], index: int) -> bool:
    """`{i}_valid`; a view without it is valid. Raises StageError if it is neither true nor false."""
    return flag(params.get(f"{index}_valid", True), _where(f"{index}_valid"))


def given_view(params: Mapping[str, Any], index: int) -> tuple[GivenCamera, tuple[int, int]]:
    """One view's checked camera, and its photo's (width, height) in pixels.

    Raises:
        StageError: a key is missing, of wrong shape or not finite; K is singular; R is no rotation, or left-handed. The
            message names the key.
    """
    K = checked_K(_numbers(params, f"{index}_K"), _where(f"{index}_K"))
    pose = _numbers(params, f"{index}_Rt")
    key = f"{index}_distortion"
    d = _numbers(params, key)
    if d.ndim != 1 or d.size not in (4, 5):
        raise fault(
            "lens distortion has the wrong number of coefficients",
            _where(key),
            f"shape {d.shape}",
            "k1 k2 p1 p2 k3",
            "list five numbers; zeros for a lens without distortion",
        )
    d = np.concatenate([d, np.zeros(5 - d.size)])
    width, height = (pixels(_required(params, k), _where(k)) for k in (f"{index}_width", f"{index}_height"))
    K = checked_frame(corner_K_from_centre_K(K), (width, height), _where(f"{index}_K"))
    camera = given_camera(K, pose, checked_lens(K, d, (width, height), _where(key)), _where(f"{index}_Rt"))
    return camera, (width, height)


def _where(key: str) -> str:
    return f"params.json, key {key}"


def _required(params: Mapping[str, Any], key: str) -> Any:
    if key not in params:
        raise fault(
            "a camera parameter is missing",
            _where(key),
            "no such key",
            "every valid view has K, Rt, distortion, width and height",
            f"add {key}, or set {key.split('_')[0]}_valid to false",
        )
    return params[key]


def _numbers(params: Mapping[str, Any], key: str) -> F64:
    remedy = f"write it again from the calibration, or set {key.split('_')[0]}_valid to false"
    return table(_required(params, key), _where(key), remedy)
