"""Reads the `cameras_sphere.npz` (or `cameras.npz`) of IDR, NeuS and data sets in their layout.

`world_mat_{i}`: (4, 4) or (3, 4), projects the world to pixels, the first pixel's centre at (0, 0). View i is the i-th
photo of `image/` (or `images/`, `rgb/`) by name. Its mask is the i-th of `mask/` if there are as many masks as photos.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.picture_size import declared_size_of
from pipeline.transforms import F64, corner_K_from_centre_K
from stages.capture.readers.cameras import given_camera
from stages.capture.readers.described import (
    PHOTO_SUFFIXES,
    Declared,
    Described,
    indices_of,
    natural_key,
)
from stages.capture.readers.npz import arrays_of
from stages.capture.readers.values import DIGITS, fault, finite

NAMES = ("cameras_sphere.npz", "cameras.npz")
PHOTOS, MASKS = ("image", "images", "rgb"), ("mask", "masks")
REMEDY = "copy the data set again, or remove the file to solve the cameras from the photos"


def find(folder: Path) -> list[Path]:
    """The npz file, only beside a folder of images: `cameras.npz` is a common name."""
    found = [folder / n for n in NAMES if (folder / n).is_file()]
    return found[:1] if any((folder / p).is_dir() for p in PHOTOS) else []


def read(folder: Path, files: Sequence[Path]) -> Described:
    """One view for each photo that has a matrix."""
    matrices = _matrices(files[0])
    photos = _pictures(folder, PHOTOS)
    masks = _pictures(folder, MASKS)
    indices = indices_of([p.name for p in photos])
    views, left_out, warnings = [], [], []
    for place, (index, photo) in enumerate(zip(indices, photos, strict=True)):
        if place not in matrices:
            left_out.append(f"{photo.name}: {files[0].name} has no world_mat_{place}")
            warnings.append(f"{left_out[-1]}; the photo is not used")
            continue
        where = f"{files[0].name}, world_mat_{place}"
        K, pose = camera_of_projection(finite(matrices[place], where)[:3, :4], where)
        camera = given_camera(corner_K_from_centre_K(K), pose, np.zeros(5), where, declared_size_of(photo))
        mask = masks[place] if len(masks) == len(photos) else None
        views.append(Declared(index, photo.name, photo, camera, None, mask=mask))
    for place in sorted(set(matrices) - set(range(len(photos)))):
        warnings.append(f"{files[0].name} has world_mat_{place}, but its photo is missing")
    return Described(tuple(views), tuple(left_out), tuple(n.split(":")[0] for n in left_out), tuple(warnings))


def camera_of_projection(P: F64, where: str) -> tuple[F64, F64]:
    """K (3, 3) with K[2, 2] = 1 and positive focal lengths, and cam_from_world (3, 4), of P (3, 4), which is defined up
    to a factor.

    P[:, :3] = K R by an RQ decomposition: a QR decomposition of the matrix with rows and columns reversed.
    Raises StageError if P is no camera.
    """
    M = P[:, :3]
    with np.errstate(all="ignore"):
        scale = float(np.cbrt(np.linalg.det(M)))
    if not np.isfinite(P).all() or abs(np.linalg.det(M / max(np.abs(M).max(), 1e-300))) < 1e-12:
        raise fault("a projection matrix is no camera", where, "its left 3 x 3 part is singular",
                    "K [R | t]", REMEDY)  # fmt: skip
    P = P / scale  # a negative factor too: det R must be +1
    q, r = np.linalg.qr(P[::-1, :3].T)
    K, R = r.T[::-1, ::-1], q.T[::-1]
    signs = np.diag(np.sign(np.diag(K)))
    K, R = K @ signs, signs @ R
    t = np.linalg.solve(K, P[:, 3])
    return K / K[2, 2], np.concatenate([R, t[:, None]], 1)


def _matrices(path: Path) -> dict[int, F64]:
    wanted = re.compile(rf"world_mat_(\d{{1,{DIGITS}}})")
    found = {int(m[1]): array for name, array in arrays_of(path, wanted, REMEDY) if (m := wanted.fullmatch(name))}
    if not found or any(m.shape not in ((3, 4), (4, 4)) for m in found.values()):
        raise fault("the cameras' file has no cameras", path.name, f"{len(found)} arrays world_mat_0, ...",
                    "a 4 x 4 world_mat_i for every photo", REMEDY)  # fmt: skip
    return found


def _pictures(folder: Path, names: Sequence[str]) -> list[Path]:
    root = next((folder / n for n in names if (folder / n).is_dir()), None)
    if root is None:
        return []
    found = (
        p for p in root.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith(".") and p.is_file()
    )
    return sorted(found, key=lambda p: natural_key(p.name))
