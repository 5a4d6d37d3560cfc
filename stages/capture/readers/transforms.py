"""Reads `transforms.json` of instant-ngp and nerfstudio.

Once for all frames, or for each frame: `fl_x`, `fl_y`, `cx`, `cy` (pixels; the first pixel's centre at (0.5, 0.5)),
`w`, `h`, or `camera_angle_x` (radians, over the width); `k1`..`k6`, `p1`, `p2` of OpenCV's models, or `is_fisheye` /
`camera_model: OPENCV_FISHEYE`. `frames[i]`: `file_path`, `transform_matrix` (world from camera, OpenGL axes: y up,
z backwards), `mask_path`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from pipeline.capture_artifacts import GivenCamera
from pipeline.transforms import F64, OPENCV_CAM_FROM_OPENGL_CAM, inverse_rigid
from stages.capture.readers.cameras import checked_frame, checked_K, checked_lens, checked_pose, given_camera
from stages.capture.readers.described import (
    Declared,
    Described,
    find_photo,
    five_terms,
    indices_of,
    read_json,
)
from stages.capture.readers.sizes import picture_size
from stages.capture.readers.values import fault, flag, label, number, pixels, printable, table

NAMES = ("transforms.json", "transforms_train.json")
MODELS = (
    "",
    "PERSPECTIVE",
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
)  # fmt: skip  (the coefficients that a model lacks are 0 or not written)
Lenses = dict[object, tuple[F64, F64]]  # approximations of lenses by all their parameters: most frames share one lens
REMEDY = "copy the file again, or remove it to solve the cameras from the photos"


def find(folder: Path) -> list[Path]:
    """transforms.json, or transforms_train.json."""
    return [folder / n for n in NAMES if (folder / n).is_file()][:1]


def read(folder: Path, files: Sequence[Path]) -> Described:
    """Frames with their photos. Frames whose photo is missing are left out with a warning."""
    data = _object(files[0])
    frames = data["frames"]
    names = [label(f.get("file_path", ""), f"{files[0].name}, frame {i}, file_path") for i, f in enumerate(frames)]
    views, left_out, warnings = [], [], []
    approximated: Lenses = {}
    for index, name, frame in zip(indices_of(names), names, frames, strict=True):
        photo = find_photo(folder, name) if name else None
        if photo is None:
            left_out.append(f"{printable(PurePosixPath(name).name) or f'frame {index}'}: its photo is missing")
            warnings.append(f"{files[0].name} lists {printable(name) or '(no file_path)'}, which is missing; put the "
                            "photo back or remove the frame from the file")  # fmt: skip
            continue
        where = f"{files[0].name}, {printable(name)}"
        size = _size(data | frame, photo, where)
        named = frame.get("mask_path")
        mask = None if named in (None, "") else find_photo(folder, label(named, f"{where}, mask_path"))
        camera = _camera(data | frame, size, where, approximated)
        views.append(Declared(index, photo.name, photo, camera, size, mask=mask))
    absent = tuple(note.split(":")[0] for note in left_out)
    return Described(tuple(views), tuple(left_out), absent, tuple(warnings))


def _object(path: Path) -> dict[str, Any]:
    found = read_json(path, "the cameras' file can't be read", REMEDY)
    frames = found.get("frames") if isinstance(found, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise fault("the cameras' file has no frames", path.name, "no list 'frames'",
                    "frames with file_path and transform_matrix", REMEDY)  # fmt: skip
    return dict(found)


def _size(values: Mapping[str, Any], photo: Path, where: str) -> tuple[int, int]:
    w, h = (values.get(k) for k in ("w", "h"))
    if w is None or h is None:
        return picture_size(photo)
    return pixels(w, f"{where}, w"), pixels(h, f"{where}, h")


def _camera(values: Mapping[str, Any], size: tuple[int, int], where: str, approximated: Lenses) -> GivenCamera:
    width, height = size
    if "transform_matrix" not in values:
        raise fault("a frame has no pose", where, "no transform_matrix", "a 4 x 4 matrix", "write the pose, or "
                    "remove the frame from the file")  # fmt: skip
    world_from_cam = checked_pose(_matrix(values, where), where) @ OPENCV_CAM_FROM_OPENGL_CAM
    K = np.array([[_focal(values, size, "x", where), 0, _number(values, "cx", width / 2, where)],
                  [0, _focal(values, size, "y", where), _number(values, "cy", height / 2, where)],
                  [0, 0, 1.0]])  # fmt: skip
    K = checked_frame(checked_K(K, where), size, where)
    d = np.array([_number(values, k, 0.0, where) for k in ("k1", "k2", "p1", "p2", "k3")])
    higher = np.array([_number(values, k, 0.0, where) for k in ("k4", "k5", "k6")])
    model = _model(values, where)
    checked_lens(K, d, size, where)
    checked_lens(K, np.array([*higher[:2], 0, 0, higher[2]]), size, where)
    fisheye = flag(values.get("is_fisheye", False), f"{where}, is_fisheye") or model == "OPENCV_FISHEYE"
    rational = bool(np.any(higher)) and model != "OPENCV"  # k4 is 0 in OPENCV, but some programs write another value
    if fisheye or rational:
        key = (fisheye, size, *K.ravel(), *d, *higher)
        if key not in approximated:
            approximated[key] = _approximation(fisheye, K, d, higher, size, where)
        K, d = approximated[key]
    return given_camera(K, inverse_rigid(world_from_cam), d, where, size)


def _model(values: Mapping[str, Any], where: str) -> str:
    """The lens model in capital letters, "" if none is named. Raises StageError for one whose pictures these equations
    do not describe."""
    found = label(values.get("camera_model", ""), f"{where}, camera_model").upper()
    if found not in MODELS:
        raise fault("the lens model is not supported", f"{where}, camera_model", printable(found),
                    ", ".join(m for m in MODELS if m),
                    "undistort the photos, or remove the file to solve the cameras from the photos")  # fmt: skip
    return found


def _approximation(
    fisheye: bool, K: F64, d: F64, higher: F64, size: tuple[int, int], where: str
) -> tuple[F64, F64]:  # fmt: skip
    """K and k1 k2 p1 p2 k3 that approximate a fisheye or a rational lens. Raises StageError if the error is too
    large."""
    radial = np.array([d[0], d[1], d[4], higher[0]])

    def image_from_plane(xy: F64) -> F64:
        return (_fisheye(xy, radial) if fisheye else _rational(xy, d, higher)) @ K[:2, :2].T + K[:2, 2]

    found, five, _ = five_terms(image_from_plane, K, size[0], size[1], where)
    return found, five


def _fisheye(xy: F64, k: F64) -> F64:
    """OpenCV's fisheye model. r = |xy|, theta = atan r; theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8)."""
    r = np.maximum(np.linalg.norm(xy, axis=1), 1e-12)
    t = np.arctan(r)
    bent = t * (1 + t**2 * (k[0] + t**2 * (k[1] + t**2 * (k[2] + t**2 * k[3]))))
    return np.asarray(xy * (bent / r)[:, None], np.float64)


def _rational(xy: F64, d: F64, higher: F64) -> F64:
    """OpenCV's rational model: (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)."""
    x, y, r2 = xy[:, 0], xy[:, 1], (xy * xy).sum(1)
    above = 1 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))
    radial = above / (1 + r2 * (higher[0] + r2 * (higher[1] + r2 * higher[2])))
    p1, p2 = d[2], d[3]
    return np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                     y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1)  # fmt: skip


def _focal(values: Mapping[str, Any], size: tuple[int, int], axis: str, where: str) -> float:
    """Focal length in pixels from fl_x / fl_y or the angle of view. If only one axis is given, it is used for both."""
    for a in (axis, "x", "y"):
        if values.get(f"fl_{a}") is not None:
            return _number(values, f"fl_{a}", 0.0, where)
    for a, edge in ((axis, size["xy".index(axis)]), ("x", size[0]), ("y", size[1])):
        if values.get(f"camera_angle_{a}") is not None:
            return edge / 2 / float(np.tan(_angle(values, f"camera_angle_{a}", where) / 2))
    raise fault("a camera has no focal length", where, "neither fl_x nor camera_angle_x", "fl_x in pixels",
                "write fl_x and fl_y, or remove the file to solve the cameras from the photos")  # fmt: skip


def _angle(values: Mapping[str, Any], key: str, where: str) -> float:
    """An angle of view in radians. Raises StageError if it is not between 0 and pi."""
    found = _number(values, key, 0.0, where)
    if not 0 < found < np.pi:
        raise fault("an angle of view is out of range", f"{where}, {key}", found, "above 0, below pi (radians)",
                    "write it in radians, or write fl_x and fl_y in pixels")  # fmt: skip
    return found


def _number(values: Mapping[str, Any], key: str, default: float, where: str) -> float:
    return number(values.get(key, default), f"{where}, {key}")


def _matrix(values: Mapping[str, Any], where: str) -> F64:
    return table(values["transform_matrix"], f"{where}, transform_matrix")
