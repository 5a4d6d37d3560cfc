"""Photos, their depths and cameras as the flat arrays that stages.bake.detail_kernels reads.

Only fitted views are used: a held-out photo must not enter a map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.images import linear_levels, linear_of, read_alpha, read_encoded, read_linear, rgb_of, shrink_whole
from pipeline.meshes import F32, F64, Mask, Mesh
from pipeline.threads import side_by_side
from pipeline.transforms import inverse_rigid, matrix, rays
from pipeline.visibility import FittedPhoto, Occluder
from stages.bake import detail_kernels as kernels

DEPTH_SIDE = 768  # largest side of a depth picture in pixels: rays are expensive
JUMP = 12.0  # depth difference between neighbours, in pixel sizes, that marks a depth edge
MIN_ALPHA = 0.99  # of a mask: pixels at the edge of the head contain background
CODE = 65535.0

U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Photos:
    """cameras (views, ROW) as in detail_kernels; pixels (P, 3); depth (D,) metres, 0 where a photo must not be used;
    clipped (P,), empty if no pixel is clipped. parallel: the same of the parallel-polarised photos of pairs, None
    without any."""

    cameras: F64
    pixels: U16
    depth: F32
    clipped: U8
    parallel: Parallel | None = None


@dataclass(frozen=True, slots=True)
class Parallel:
    """The parallel-polarised photos, at the places of their cross-polarised ones. peaks (views,): radiance of code
    65535 in the unit of those; 0 for a photo without a pair. pixels (P, 3), clipped (P,) as in Photos."""

    peaks: F64
    pixels: U16
    clipped: U8


def read_photos(
    views: Sequence[FittedPhoto], responses: F64, mesh: Mesh, texel: float, step: Callable[[int, int], None]
) -> Photos:
    """Read all fitted photos, not finer than `texel` (metres on the surface), and compute the depth of the mesh in
    each.

    responses (views, 3, 3): the fitted colour response A_n of each photo. [NeuFace eq. 19]
    """
    occluder = Occluder(mesh)
    rows, pixels, depths, clipped = [], [], [], []
    others = []
    places = [0, 0]

    def read(view: FittedPhoto) -> _Read:
        return _read(view, _factor(view, mesh, texel), occluder)

    for i, one in enumerate(side_by_side(read, views)):
        step(i, len(views))
        rows.append(_row(views[i], responses[i], one.factor, one.shape, one.depth.shape, one.peak, places))
        pixels.append(one.pixels)
        others.append(one.parallel)
        depths.append(one.depth.ravel())
        clipped.append(one.clipped)
        places = [places[0] + len(pixels[-1]), places[1] + one.depth.size]
    cameras = np.array(rows)
    # weight 1: a sharp photo from straight ahead at the median distance and focal length
    centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    reach = np.linalg.norm(cameras[:, 27:30] - centre, axis=1)
    cameras[:, 40] *= _sharpness(pixels, cameras) / np.median(cameras[:, 40] / reach)
    ends = np.concatenate(clipped) if any(c.any() for c in clipped) else np.zeros(0, np.uint8)
    parallel = None
    if any(view.parallel is not None for view in views):
        peaks, coded, over = zip(*others, strict=True)
        parallel = Parallel(np.array(peaks), np.concatenate(coded), np.concatenate(over))
    return Photos(cameras, np.concatenate(pixels), np.concatenate(depths), ends, parallel)


@dataclass(frozen=True, slots=True)
class _Read:
    """One photo, not finer than `factor` pixels: shape (h, w, 3), pixels (h w, 3) and their radiance at the largest
    code, its depth picture, clipped (h w,), and the same of the parallel-polarised photo."""

    factor: int
    shape: tuple[int, ...]
    pixels: U16
    peak: float
    depth: F32
    clipped: U8
    parallel: tuple[float, U16, U8]


def _read(view: FittedPhoto, factor: int, occluder: Occluder) -> _Read:
    assert view.photo is not None
    stored = read_encoded(view.photo)
    pixels, peak, shape = _coded_photo(stored, factor)
    alpha = np.ones(stored.shape[:2], np.float32) if view.mask is None else read_alpha(view.mask)
    depth = _depth(view, alpha, occluder)
    return _Read(factor, shape, pixels, peak, depth, _clipped(view, shape, factor), _parallel(view, shape, factor))


def _coded_photo(stored: npt.NDArray[Any], factor: int) -> tuple[U16, float, tuple[int, ...]]:
    """Codes (h w, 3) of a photo as it is stored (H, W, C), their peak, and (h, w, 3). Of 8-bit photos in full size each
    level is coded once, not each pixel: the codes are the same."""
    if factor > 1 or stored.dtype != np.uint8:
        photo = shrink_whole(linear_of(stored), factor)
        peak = max(float(photo.max()), 1e-6)
        return _coded(photo, peak).reshape(-1, 3), peak, photo.shape
    rgb = rgb_of(stored)
    levels = linear_levels(rgb.dtype)
    peak = max(float(levels[rgb.max()]), 1e-6)
    return _coded(levels, peak)[rgb].reshape(-1, 3), peak, rgb.shape


def _coded(linear: F32, peak: float) -> U16:
    """The square root of linear values, `peak` at the largest code."""
    return np.round(np.sqrt(linear.clip(0) / peak).clip(0, 1) * CODE).astype(np.uint16)


def _parallel(view: FittedPhoto, shape: tuple[int, ...], factor: int) -> tuple[float, U16, U8]:
    """Peak, pixels and clipped pixels of a view's parallel-polarised photo; peak 0 without one."""
    count = shape[0] * shape[1]
    if view.parallel is None:
        return 0.0, np.zeros((count, 3), np.uint16), np.ones(count, np.uint8)
    photo = shrink_whole(read_linear(view.parallel), factor) / np.float32(view.parallel_exposure)
    peak = max(float(photo.max()), 1e-6)
    return peak, _coded(photo, peak).reshape(-1, 3), _ends(view.parallel_clipped, shape, factor)


def _clipped(view: FittedPhoto, shape: tuple[int, ...], factor: int) -> U8:
    """(h w,) 1 where a block of `factor` x `factor` photo pixels contains a clipped pixel."""
    return _ends(view.clipped, shape, factor)


def _ends(clipped: Path | None, shape: tuple[int, ...], factor: int) -> U8:
    if clipped is None:
        return np.zeros(shape[0] * shape[1], np.uint8)
    return (shrink_whole(read_alpha(clipped), factor) > 0).astype(np.uint8).ravel()


def _factor(view: FittedPhoto, mesh: Mesh, texel: float) -> int:
    """Side of the largest block of photo pixels that is not wider than a texel at the point nearest to the camera."""
    origin = matrix(view.camera.world_from_cam)[:3, 3]
    distance = float(np.linalg.norm(mesh.vertices - origin, axis=1).min())
    return max(1, int(texel * matrix(view.camera.K)[0, 0] / max(distance, 1e-9)))


def _row(
    view: FittedPhoto,
    response: F64,
    factor: int,
    photo: tuple[int, ...],
    depth: tuple[int, ...],
    peak: float,
    starts: list[int],
) -> F64:
    """One camera's numbers in the order of detail_kernels."""
    K, world_from_cam = matrix(view.camera.K), matrix(view.camera.world_from_cam)
    row = np.zeros(kernels.ROW)
    row[:12] = inverse_rigid(world_from_cam)[:3].ravel()
    row[12:17] = np.array([K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]]) / factor
    row[17] = depth[1] / (view.camera.width / factor)
    row[18:22] = photo[1], photo[0], depth[1], depth[0]
    row[22:27] = view.camera.distortion
    row[27:30] = world_from_cam[:3, 3]
    row[30:39] = np.linalg.inv(response).ravel()
    row[39:43] = peak, K[0, 0] / factor, *starts
    return row


def _depth(view: FittedPhoto, alpha: F32, occluder: Occluder) -> F32:
    """(h, w) distance to the mesh through each pixel's centre; 0 outside the mesh or the mask, and near depth edges.
    Rays are cast inside the mask alone, and one pixel around, for the edges."""
    camera = view.camera
    shrunk = max(1, -(-max(camera.width, camera.height) // DEPTH_SIDE))
    h, w = camera.height // shrunk, camera.width // shrunk
    window = np.ones((3, 3), np.uint8)
    solid = cv2.erode(cv2.resize(alpha, (w, h), interpolation=cv2.INTER_AREA), window) > MIN_ALPHA
    row, column = np.nonzero(cv2.dilate(solid.astype(np.uint8), window))
    place = np.stack([column + 0.5, row + 0.5], -1) * np.array([camera.width / w, camera.height / h])
    origin, directions = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion), place)
    distance = np.full((h, w), np.inf)
    distance[row, column] = occluder.distance(origin, directions)
    far = np.where(np.isfinite(distance), distance, 1e9).astype(np.float32)
    jump = JUMP * shrunk / matrix(camera.K)[0, 0]
    uneven = cv2.dilate(far, window) - cv2.erode(far, window) > jump * far
    return np.where(solid & ~uneven & np.isfinite(distance), far, 0).astype(np.float32)


def _sharpness(pixels: list[U16], cameras: F64) -> F64:
    """(views,) sharpness of each photo, 1 for the sharpest third: the strength of the finest differences over that of
    differences twice as wide. The ratio falls with blur and hardly depends on the content."""
    found = []
    for codes, camera in zip(pixels, cameras, strict=True):
        green = codes[:, 1].reshape(int(camera[19]), int(camera[18])).astype(np.float32)
        once, twice = cv2.GaussianBlur(green, (0, 0), 0.7), cv2.GaussianBlur(green, (0, 0), 1.4)
        seen: Mask = green > 0.02 * CODE
        fine, coarse = np.abs(green - once)[seen], np.abs(once - twice)[seen]
        found.append(float(fine.mean() / max(coarse.mean(), 1e-6)) if seen.any() else 0.0)
    return np.asarray((np.array(found) / max(float(np.quantile(found, 2 / 3)), 1e-9)).clip(0.1, 1.0))
