"""Reads FaceScape's `params.json`.

Per view i: `{i}_K` 3x3, `{i}_Rt` 3x4 world-to-camera with OpenCV axes, `{i}_distortion` k1 k2 p1 p2 k3, `{i}_width`,
`{i}_height`, `{i}_valid`, `{i}_sn` (the camera body). FaceScape has the first pixel's centre at (0, 0), so half a pixel
is added to the principal point on the way in.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts import GivenCamera
from pipeline.errors import StageError
from pipeline.transforms import F64, corner_K_from_centre_K, rigid, rows

ORTHONORMAL_LIMIT = 1e-3  # float32 and a few printed digits stay below it, a scaled or sheared matrix does not
_KEY = re.compile(r"(\d+)_(K|Rt|distortion|width|height|valid|ori|sn|matches)")


@dataclass(frozen=True, slots=True)
class DeclaredView:
    """What params.json says of one valid view. width, height: pixels. serial: the camera body, "" if not named."""

    index: int
    camera: GivenCamera
    width: int
    height: int
    serial: str


def read_params(path: Path) -> dict[str, Any]:
    """The file as a dictionary. Raises StageError if it is not a JSON object that names views."""
    try:
        found = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as e:
        raise StageError(
            "params.json can't be read",
            where=path.name,
            value=str(e)[:200],
            limit="a JSON object",
            remedy="copy the file again, or remove it to have the cameras solved from the photos",
        ) from e
    if not isinstance(found, dict) or not view_indices(found):
        value = f"{len(found)} keys, none like 0_K" if isinstance(found, dict) else type(found).__name__
        raise StageError(
            "params.json names no views",
            where=path.name,
            value=value,
            limit="keys 0_K, 0_Rt, 0_distortion, 0_width, 0_height, ...",
            remedy="use FaceScape's layout, or remove the file to have the cameras solved",
        )
    return found


def view_indices(params: Mapping[str, Any]) -> list[int]:
    """Indices of all views that params.json speaks of, ascending."""
    return sorted({int(m[1]) for m in map(_KEY.fullmatch, params) if m})


def is_valid(params: Mapping[str, Any], index: int) -> bool:
    """`{i}_valid`; a view without it is taken as valid."""
    return bool(params.get(f"{index}_valid", True))


def declared_view(params: Mapping[str, Any], index: int) -> DeclaredView:
    """One view's camera, checked.

    Raises:
        StageError: naming the key: missing, wrong shape, not finite, K singular, R not a rotation or left-handed.
    """
    K = _intrinsics(params, f"{index}_K")
    pose = _pose(params, f"{index}_Rt")
    key = f"{index}_distortion"
    d = _numbers(params, key)
    if d.ndim != 1 or d.size not in (4, 5):
        raise _fault(
            "lens distortion has the wrong number of coefficients",
            key,
            f"shape {d.shape}",
            "k1 k2 p1 p2 k3",
            "list five numbers; zeros for a lens without distortion",
        )
    d = np.concatenate([d, np.zeros(5 - d.size)])
    camera = GivenCamera(K=rows(corner_K_from_centre_K(K)), cam_from_world=rows(pose), distortion=tuple(map(float, d)))
    serial = str(params.get(f"{index}_sn", ""))
    return DeclaredView(index, camera, _pixels(params, f"{index}_width"), _pixels(params, f"{index}_height"), serial)


def _intrinsics(params: Mapping[str, Any], key: str) -> F64:
    K = _numbers(params, key)
    if K.shape != (3, 3):
        raise _fault("camera matrix has the wrong shape", key, f"shape {K.shape}", "3 x 3", "write K as three rows")
    scale = max(float(np.abs(K).max()), 1e-300)
    if abs(float(np.linalg.det(K / scale))) * scale**2 < 1e-9 or min(K[0, 0], K[1, 1]) <= 0:
        raise _fault(
            "camera matrix K is singular",
            key,
            f"fx = {K[0, 0]:g}, fy = {K[1, 1]:g}, determinant {float(np.linalg.det(K)):.3g}",
            "fx and fy above 0",
            "write the focal lengths in pixels",
        )
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-6 or abs(K[1, 0]) > 1e-6 * K[0, 0]:
        raise _fault(
            "camera matrix K is not upper triangular",
            key,
            K.tolist(),
            "rows (fx, s, cx), (0, fy, cy), (0, 0, 1)",
            "check that the matrix is not transposed",
        )
    return K


def _pose(params: Mapping[str, Any], key: str) -> F64:
    """4x4 cam_from_world, its rotation made exact."""
    m = _numbers(params, key)
    if m.shape not in ((3, 4), (4, 4)) or (m.shape == (4, 4) and np.abs(m[3] - [0, 0, 0, 1]).max() > 1e-6):
        raise _fault(
            "camera pose has the wrong shape",
            key,
            f"shape {m.shape}",
            "3 x 4: rotation, then translation",
            "write Rt as three rows of four",
        )
    R = m[:3, :3]
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > ORTHONORMAL_LIMIT:
        raise _fault(
            "camera pose has no rotation matrix",
            key,
            f"|R R^T - 1| = {error:.3g}",
            f"at most {ORTHONORMAL_LIMIT:g}",
            "write a pure rotation, without scale or shear",
        )
    if np.linalg.det(R) < 0:
        raise _fault(
            "camera pose is left-handed",
            key,
            "det R = -1 (mirrored)",
            "det R = +1",
            "use OpenCV's axes: x right, y down, z forward; flip one axis where the pose is written",
        )
    u, _, vt = np.linalg.svd(R)
    return rigid(u @ vt, m[:3, 3])


def _pixels(params: Mapping[str, Any], key: str) -> int:
    value = _numbers(params, key)
    if value.ndim != 0 or value != np.round(value) or value < 1:
        raise _fault(
            "image size is not a whole number of pixels",
            key,
            params[key],
            "a whole number above 0",
            "write the photo's size in pixels",
        )
    return int(value)


def _numbers(params: Mapping[str, Any], key: str) -> F64:
    if key not in params:
        raise _fault(
            "a camera parameter is missing",
            key,
            "no such key",
            "every valid view has K, Rt, distortion, width and height",
            f"add {key}, or set {key.split('_')[0]}_valid to false",
        )
    try:
        found = np.array(params[key], np.float64)
    except (TypeError, ValueError) as e:
        raise _fault(
            "a camera parameter is not a table of numbers",
            key,
            str(params[key])[:80],
            "numbers only",
            "write it as plain JSON numbers in rows of equal length",
        ) from e
    if not np.isfinite(found).all():
        raise _fault(
            "a camera parameter is not finite",
            key,
            params[key],
            "finite numbers only (no NaN, no Infinity)",
            f"write it again from the calibration, or set {key.split('_')[0]}_valid to false",
        )
    return found


def _fault(what: str, key: str, value: object, limit: object, remedy: str) -> StageError:
    return StageError(what, where=f"params.json, key {key}", value=value, limit=limit, remedy=remedy)
