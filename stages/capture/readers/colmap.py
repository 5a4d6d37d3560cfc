"""Reads a COLMAP model, binary or text: `cameras`, `images`, `points3D` in `sparse/0/`, `sparse/` or the folder itself.

All camera models of pycolmap are supported. Models that k1 k2 p1 p2 k3 can represent are exact. The others are
approximated over the frame by k1 k2 p1 p2 k3, if the error is small enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from pipeline.transforms import F64
from stages.capture.readers.cameras import checked_frame, checked_K, given_camera
from stages.capture.readers.colmap_files import miscounted
from stages.capture.readers.described import (
    Declared,
    Described,
    find_photo,
    five_terms,
    indices_of,
    natural_key,
)
from stages.capture.readers.values import fault, finite, pixels, printable

FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap", "")
NAMES = ("cameras", "images", "points3D")
MORE = ("rigs", "frames")  # newer versions write these too
WHOLE = "a complete model as COLMAP writes it"
AGAIN = "export the model again, or remove it to solve the cameras from the photos"
NOTED = 0.02  # pixels: an approximation with a larger error causes a warning


def find(folder: Path) -> list[Path]:
    """The model's files, binary ones first."""
    for root in FOLDERS:
        for suffix in (".bin", ".txt"):
            files = [folder / root / (n + suffix) for n in NAMES]
            if all(f.is_file() for f in files):
                return files + [f for n in MORE if (f := folder / root / (n + suffix)).is_file()]
    return []


def read(folder: Path, files: Sequence[Path]) -> Described:
    """Registered images with their photos. Images whose photo is missing are left out with a warning."""
    wrong = miscounted(files)
    if wrong is not None:
        raise fault("the COLMAP model can't be read", files[0].parent.name, wrong, WHOLE, AGAIN)
    cameras, images = _model(files[0].parent, files[0].suffix)
    if not images:
        raise fault("the COLMAP model has no registered images", files[1].name, 0, "at least 3",
                    "run the mapper again, or remove the model to solve the cameras from the photos")  # fmt: skip
    lenses = {k: _lens(c, f"{files[0].name}, camera {k}") for k, c in cameras.items()}
    views, left_out, warnings = [], [], []
    for index, image in zip(indices_of([i.name for i in images]), images, strict=True):
        photo = find_photo(folder, image.name)
        if photo is None:
            left_out.append(f"{printable(PurePosixPath(image.name).name)}: its photo is missing")
            warnings.append(f"the COLMAP model lists {printable(image.name)}, which is not in the capture; put the "
                            "photo into images/ or into the folder itself")  # fmt: skip
            continue
        (K, d, _), camera = lenses[image.camera_id], cameras[image.camera_id]
        size = (int(camera.width), int(camera.height))
        given = given_camera(K, image.pose, d, f"{files[1].name}, {printable(image.name)}", size)
        views.append(Declared(index, photo.name, photo, given, size, f"{image.camera_id}"))
    warnings += [f"COLMAP camera {k} ({cameras[k].model_name}) is approximated by k1 k2 p1 p2 k3, "
                 f"error up to {error:.2f} pixels" for k, (_, _, error) in lenses.items() if error > NOTED]  # fmt: skip
    return Described(tuple(views), tuple(left_out), tuple(n.split(":")[0] for n in left_out), tuple(warnings))


@dataclass(frozen=True, slots=True)
class _Image:
    """A registered image. pose: (3, 4) cam_from_world."""

    name: str
    camera_id: int
    pose: F64


def _model(folder: Path, suffix: str) -> tuple[dict[int, Any], list[_Image]]:
    """COLMAP's cameras by number, and the registered images in natural order. Raises StageError."""
    from pipeline.colmap import pycolmap

    model = pycolmap.Reconstruction()
    try:
        (model.read_binary if suffix == ".bin" else model.read_text)(str(folder))
        images = [_Image(i.name, i.camera_id, np.asarray(i.cam_from_world().matrix(), np.float64))
                  for i in model.images.values() if i.has_pose]  # fmt: skip
        cameras = {i.camera_id: model.cameras[i.camera_id] for i in images} | dict(model.cameras.items())
    except (RuntimeError, ValueError, IndexError, OverflowError, MemoryError, KeyError, TypeError) as e:
        message = printable((str(e).strip().splitlines() or [type(e).__name__])[-1])
        raise fault("the COLMAP model can't be read", folder.name, message, WHOLE, AGAIN) from e
    return cameras, sorted(images, key=lambda i: natural_key(i.name))


def _lens(camera: Any, where: str) -> tuple[F64, F64, float]:
    """K (3, 3), k1 k2 p1 p2 k3, greatest error in pixels. COLMAP has the first pixel's centre at (0.5, 0.5)."""
    size = (pixels(int(camera.width), where, AGAIN), pixels(int(camera.height), where, AGAIN))
    p, model = [float(x) for x in finite(np.array(camera.params, np.float64), where, AGAIN)], camera.model_name
    exact = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 3, "RADIAL": 3, "OPENCV": 4, "FULL_OPENCV": 4}
    if model in exact and not (model == "FULL_OPENCV" and any(p[9:])):
        terms = p[exact[model] :]
        d = {0: [0.0] * 5, 1: [*terms, 0, 0, 0, 0], 2: [*terms, 0, 0, 0], 4: [*terms, 0.0], 8: terms[:5]}[len(terms)]
        K = checked_K(np.asarray(camera.calibration_matrix(), np.float64), where)
        return checked_frame(K, size, where), np.array(d, np.float64), 0.0
    if camera.is_spherical():
        raise fault("a panorama has no pinhole camera", where, model, "a perspective or fisheye lens",
                    "extract perspective photos from the panoramas")  # fmt: skip
    focal = camera.mean_focal_length()
    K = np.array([[focal, 0, camera.principal_point_x], [0, focal, camera.principal_point_y], [0, 0, 1.0]])

    checked_frame(checked_K(K, where), size, where)

    def image_from_plane(xy: F64) -> F64:
        return np.asarray(camera.img_from_cam(np.concatenate([xy, np.ones((len(xy), 1))], 1)), np.float64)

    return five_terms(image_from_plane, K, camera.width, camera.height, where)
