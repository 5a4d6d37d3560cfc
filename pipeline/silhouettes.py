"""Silhouettes as signed distances: how far a point in space is outside the silhouette of one view.

A pixel belongs to the subject where alpha >= 0.5; the soft alpha gives the contour to a fraction of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from pipeline.artifacts import Camera
from pipeline.transforms import inverse_rigid, matrix, undistort

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

BLUR = 0.7  # pixels, against the staircase of hard masks
SPREAD = float(np.sqrt(BLUR**2 + 1 / 12))  # of an edge seen through the blur and a pixel's square
NEAR = 1.2  # pixels from the contour up to which the distance is computed from the blurred alpha


@dataclass(frozen=True, slots=True)
class Silhouette:
    """A view prepared for lookups. distance: (h, w) signed, in pixels of the photo, on a grid of size / (sx, sy)."""

    K: F64
    cam_from_world: F64
    distortion: F64
    focal: float
    width: int
    height: int
    radius: float  # on the z = 1 plane; beyond it the lens polynomial may fold back into the frame
    distance: F32


def silhouette(camera: Camera, alpha: F32, about: F64, cell: float) -> Silhouette:
    """Signed distances of one view, on a grid no finer than needed (a third of a voxel's footprint). alpha (H, W);
    about (3,): where the footprint is measured; cell: edge of a voxel."""
    import cv2

    K, d = matrix(camera.K), np.array(camera.distortion, np.float64)
    cam_from_world = inverse_rigid(matrix(camera.world_from_cam))
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    depth = max(float((cam_from_world[:3, :3] @ about + cam_from_world[:3, 3])[2]), 1e-6)
    footprint = cell * focal / depth * alpha.shape[1] / camera.width
    factor = max(1.0, min(footprint / 3, max(alpha.shape) / 128))
    size = (max(2, round(alpha.shape[1] / factor)), max(2, round(alpha.shape[0] / factor)))
    small = np.asarray(alpha, np.float32)
    if size != alpha.shape[::-1]:
        small = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_AREA), np.float32)
    scale = np.sqrt(camera.width * camera.height / (size[0] * size[1]))
    return Silhouette(
        K,
        cam_from_world,
        d,
        focal,
        camera.width,
        camera.height,
        lens_radius(camera),
        signed_pixels(small) * np.float32(scale),
    )


def lens_radius(camera: Camera) -> float:
    """Radius on the z = 1 plane that includes the whole frame, with a small margin."""
    K, w, h = matrix(camera.K), camera.width, camera.height
    edge = np.array([(x, y) for x in (0, w / 2, w) for y in (0, h / 2, h)], np.float64)
    flat = np.asarray(np.linalg.solve(K[:2, :2], (edge - K[:2, 2]).T).T, np.float64)
    xy = undistort(flat, np.array(camera.distortion, np.float64))
    return 1.1 * float(np.linalg.norm(xy, axis=1).max())


def signed_pixels(alpha: F32) -> F32:
    """(H, W) distance to the subject's contour in pixels, negative inside.

    Near the contour it is computed from the blurred alpha: a straight edge after a pixel's box filter (variance 1/12 in
    any direction) and a Gaussian blur is close to the integral of a normal distribution; its inverse is the distance.
    Further away it is the distance to the nearest pixel on the other side, minus that pixel's own. Where the blur would
    move a pixel to the other side (thin parts) it is 0. If there is no pixel on the other side, it is the diagonal.
    """
    import cv2

    inside = alpha >= 0.5
    diagonal = float(np.hypot(*alpha.shape))
    if inside.all() or not inside.any():
        return np.full(alpha.shape, -diagonal if inside.all() else diagonal, np.float32)
    blurred = np.asarray(cv2.GaussianBlur(alpha, (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE), np.float32)
    clear = special.ndtr(-NEAR / SPREAD)
    near = (blurred > clear) & (blurred < 1 - clear)
    out = np.zeros(alpha.shape, np.float32)
    out[near] = -SPREAD * special.ndtri(blurred[near].astype(np.float64))
    out = np.where(inside, np.minimum(out, 0), np.maximum(out, 0)).astype(np.float32)
    beyond = np.abs(out).clip(0, 0.7)
    for side, sign in ((inside, -1), (~inside, 1)):
        # two pixels at similar distances may be at different depths behind the contour: the median removes outliers
        far = np.asarray(cv2.medianBlur(_to_other_side(beyond, ~side), 3), np.float32)
        out = np.where(side & ~near, sign * far, out)
    return out


def _to_other_side(beyond: F32, other: Bool) -> F32:
    """Distance (H, W) to the nearest pixel of `other`, minus its distance behind the contour; >= 0."""
    import cv2

    distance, label = cv2.distanceTransformWithLabels(
        np.where(other, 0, 1).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(label.max()) + 1, np.float32)
    of_label[label[other]] = beyond[other]
    return np.asarray(np.maximum(distance - of_label[label], 0), np.float32)


@dataclass(frozen=True, slots=True)
class Stack:
    """Silhouettes as the compiled loops take them (silhouette_kernels)."""

    views: F64
    shapes: npt.NDArray[np.int64]
    starts: npt.NDArray[np.int64]
    distances: F32


def stack(views: Sequence[Silhouette]) -> Stack:
    """Of all views together."""
    sizes = [v.distance.size for v in views]
    return Stack(
        np.stack([_numbers(v) for v in views]),
        np.array([v.distance.shape for v in views], np.int64),
        np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        np.concatenate([v.distance.ravel() for v in views]),
    )


def _numbers(view: Silhouette) -> F64:
    """(27,) a view as silhouette_kernels has it."""
    radius = view.radius if np.any(view.distortion) else np.inf
    lens = [*view.cam_from_world[:3].ravel(), *view.K[:2].ravel(), *view.distortion]
    return np.array([*lens, view.focal, view.width, view.height, radius], np.float64)


def outside(view: Silhouette, points: F64, reach: float) -> tuple[F32, Bool, Bool]:
    """Distance (N,) of points (N, 3) outside the silhouette, asset units; whether the view sees all within `reach`
    (N,); whether it sees any of it (N,)."""
    from pipeline.silhouette_kernels import outside_one

    n, (rows, columns) = len(points), view.distance.shape
    value, whole, part = np.empty(n, np.float32), np.empty(n, bool), np.empty(n, bool)
    outside_one(np.asarray(points, np.float64), _numbers(view), rows, columns, view.distance.ravel(), float(reach),
                value, whole, part)  # fmt: skip
    return value, whole, part
