"""Whether a part of a visual hull is the subject, or space that no photo could carve.

A hull is an upper limit of the subject. Where a mask lacks what the hull of the others has, either of the two may be
wrong: beside a shoulder that leaves most frames, a hull has parts that no photo could carve. Two things tell:

- Other masks need the part: without it, the hull no longer covers them.
- Nearly all views have the part in their frames, so that many directions could have carved it, and did not. A part that
  lies before or behind the rest of the subject in the other views is needed by none of them: a notch in the neck of a
  statue.

Measured: of the parts that single masks lacked, a statue's neck is in the frame of .98 to 1 of 58 views; empty space
beside the shoulders of two persons in that of .41 to .50 of 29 and 34 views (medians over the voxels).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.artifacts import Camera
from pipeline.hull import BAND_CELLS, Hull, cloud, render_silhouette
from pipeline.transforms import inverse_rigid, matrix, project

F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
LEAST = 0.01  # of a mask: the largest region that it loses; noise of its outline is smaller
MASKS = 2  # that lose so much: one may be wrong itself
KNOWN = 0.9  # of the views: they have the part in their frames
FEW = 0.5  # of the views
AWAY = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # voxels from what more views have in their frames
A_LITTLE = 0.002  # of a mask: the largest region that it may lose with a far part
MARGIN = 1.0  # voxels by which a silhouette of the hull may be too small


def voxels_at(hull: Hull, camera: Camera, where: Bool) -> Bool:
    """(X, Y, Z) voxels inside the hull whose centres project into `where`, (h, w) of the camera's whole frame."""
    inside = hull.level <= 0
    uv, z = project(matrix(camera.K), inverse_rigid(matrix(camera.world_from_cam)),
                    np.array(camera.distortion), hull.centres(inside))  # fmt: skip
    h, w = where.shape
    at = np.floor(np.nan_to_num(uv, nan=-1.0) * (w / camera.width, h / camera.height))
    seen = (z > 0) & (at >= 0).all(1) & (at < (w, h)).all(1)
    column, row = at[seen].astype(np.intp).T
    hit = np.zeros(len(uv), np.bool_)
    hit[seen] = where[row, column]
    out = np.zeros(hull.level.shape, np.bool_)
    out[inside] = hit
    return out


def masks_in_need(
    hull: Hull, part: Bool, cameras: Sequence[Camera], alphas: Sequence[F32], least: float = LEAST
) -> list[int]:
    """Positions of the masks that the hull covers less without a part of it: by a region that is larger than `least` of
    the mask and lies more than MARGIN voxels beside what is left. part: (X, Y, Z). alphas: (h, w) each, small."""
    if not part.any():
        return []
    rest = replace(
        hull, level=np.where(part, np.float32(BAND_CELLS * hull.cell), hull.level), occupied=hull.occupied & ~part
    )
    whole, left = cloud(hull), cloud(rest) if (rest.level <= 0).any() else None
    out = []
    for i, (camera, alpha) in enumerate(zip(cameras, alphas, strict=True)):
        (h, w), inside = alpha.shape, alpha >= 0.5
        covered = render_silhouette(whole, camera, h, w) >= 0.5
        if left is not None:
            still = render_silhouette(left, camera, h, w) >= 0.5
            covered &= ~grown(still, margin_of(camera, w, hull.cell, MARGIN))
        if regions(covered & inside, least * inside.sum()):
            out.append(i)
    return out


def is_subject(hull: Hull, part: Bool, cameras: Sequence[Camera], alphas: Sequence[F32]) -> bool:
    """Whether nearly all views have the part in their frames, or at least MASKS masks need it. part: (X, Y, Z) voxels
    inside the hull, which these views carved."""
    if not part.any():
        return False
    known = float(np.median(hull.seen[part])) >= KNOWN * len(cameras)
    return known or len(masks_in_need(hull, part, cameras, alphas)) >= MASKS


def without_far_parts(hull: Hull, cameras: Sequence[Camera], alphas: Sequence[F32]) -> Hull:
    """The hull without what at most FEW of the views have in their frames, no mask needs, and is far from the body that
    more views have: a tail of empty space behind a neck. alphas: (h, w) each, small."""
    inside = hull.level <= 0
    known = _main_piece(inside & (hull.seen > FEW * len(cameras)))
    rare = inside & ~known
    if not rare.any() or not known.any():
        return hull
    away = ndimage.distance_transform_edt(~known)
    first, last = 0, next((i for i, r in enumerate(AWAY) if r >= away[rare].max()), len(AWAY) - 1)
    while first < last:  # the least distance beyond which no mask needs anything
        middle = (first + last) // 2
        needed = masks_in_need(hull, rare & (away > AWAY[middle]), cameras, alphas, A_LITTLE)
        first, last = (middle + 1, last) if needed else (first, middle)
    beyond = np.where(rare, hull.cell * (away - AWAY[first]), -np.inf).astype(np.float32)
    level = np.maximum(hull.level, beyond.clip(-BAND_CELLS * hull.cell, BAND_CELLS * hull.cell))
    return replace(hull, level=level, occupied=hull.occupied & (beyond <= 0.5 * hull.cell))


def _main_piece(voxels: Bool) -> Bool:
    """The largest connected piece of (X, Y, Z) voxels."""
    label, count = ndimage.label(voxels)
    return np.asarray(label == 1 + np.bincount(label.ravel())[1:].argmax()) if count else voxels


def margin_of(camera: Camera, width: int, cell: float, voxels: float) -> int:
    """Pixels of a picture `width` wide that this many voxels at the origin cover, at least 1. cell: asset units."""
    depth = abs(float(inverse_rigid(matrix(camera.world_from_cam))[2, 3]))
    K = matrix(camera.K)
    pixels = float(np.sqrt(K[0, 0] * K[1, 1])) / max(depth, 1e-9)
    return max(1, round(voxels * pixels * cell * width / camera.width))


def grown(mask: Bool, radius: int) -> Bool:
    """(h, w) dilation of a mask by `radius` pixels; there is no mask beyond the frame."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc)) > 0


def regions(mask: Bool, least: float) -> list[Bool]:
    """The connected regions (h, w) of a mask with more than `least` pixels."""
    count, label, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [np.asarray(label == k) for k in range(1, count) if facts[k, cv2.CC_STAT_AREA] > least]
