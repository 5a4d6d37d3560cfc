"""Segmentation of an object on a support, for objects that no network recognises, from the sparse points of SfM.

Symbols: points (N, 3) asset coordinates; R radius of the region of interest; plane n . x = o, n towards the cameras.
The object is the largest connected group of points above the support plane (pipeline.support) within REACH of the
region of interest. Its projected points give the silhouette. A smooth base has few points, or none. So the object may
go on between its lowest points and the support, and the photo decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage, spatial

from pipeline.artifacts import Camera, CameraSet, Located
from pipeline.support import CLEAR, Support, find_support
from pipeline.transforms import F64, inverse_rigid, matrix, project
from stages.masks.grabcut import cut
from stages.masks.region import U8, Bool, dilated, eroded, resized, working_size

AROUND, REACH = 2.5, 1.6  # R: where the support is searched; how far the object may extend
LINK, COMPANY = 0.1, 4  # R: distance of connected points; fewest neighbours within it
MIN_POINTS = 200
STRAYS = 0.05  # share of the points that may lie below the lowest ones that count
BASE = 0.3  # share of the height of the points that is their lowest part
LOWERED = (0.0, 0.25, 0.5, 0.75, 1.0)  # shares of a lowest point's height at which the base is looked for
SPACING = 0.07  # R: gaps between projected points that are closed
GREY = 6  # levels: a photo whose channels differ less is grey
TEXTURE_PIXELS, TEXTURE_GAIN = 2.0, 6.0


@dataclass(frozen=True, slots=True)
class SupportedObject:
    """An object. points: (N, 3) on it. support: its support plane, None if not found. base: (M, 3) between its lowest
    points and the support, where it may go on."""

    points: F64
    support: Support | None
    roi_radius: float
    base: F64


def object_of(poses: Located[CameraSet], seed: int) -> SupportedObject | None:
    """The object among the sparse points of the cameras; None without points."""
    ref = poses.artifact.points
    if ref is None:
        return None
    with np.load(poses.path(ref), allow_pickle=False) as data:
        points = np.asarray(data["points"], np.float64)
    return find_supported_object(points, poses.artifact.cameras, poses.artifact.roi_radius, seed)


def find_supported_object(
    points: F64, cameras: Sequence[Camera], roi_radius: float, seed: int
) -> SupportedObject | None:
    """The object among points (N, 3), or None if it has too few points."""
    centres = np.array([matrix(c.world_from_cam)[:3, 3] for c in cameras])
    distance = np.linalg.norm(points, axis=1)
    support = find_support(points[distance < AROUND * roi_radius], centres, roi_radius, seed)
    own = distance < REACH * roi_radius
    if support is not None:
        own &= points @ support.normal - support.offset > CLEAR * roi_radius
    found = _largest_cluster(points[own], LINK * roi_radius)
    if len(found) < MIN_POINTS:
        return None
    return SupportedObject(found, support, roi_radius, base_of(found, support))


def base_of(points: F64, support: Support | None) -> F64:
    """(M, 3) the lowest of an object's points (N, 3) and what is between them and its support; none without one."""
    if support is None:
        return np.zeros((0, 3))
    height = points @ support.normal - support.offset
    bottom = float(np.quantile(height, STRAYS))
    low = height < bottom + BASE * (height.max() - bottom)
    return np.concatenate([points[low] - (1 - t) * height[low, None] * support.normal for t in LOWERED])


def _largest_cluster(points: F64, link: float) -> F64:
    """The points of the largest group in which each is within about `link` of others; outliers are isolated."""
    if len(points) <= COMPANY:
        return points
    farthest = spatial.cKDTree(points).query(points, COMPANY + 1)[0][:, -1]
    points = points[farthest < link]
    if not len(points):
        return points
    index = ((points - points.min(0)) / link).astype(np.intp) + 1
    grid = np.zeros(index.max(0) + 2, bool)
    grid[tuple(index.T)] = True
    label, _ = ndimage.label(ndimage.binary_dilation(grid, np.ones((3, 3, 3))))
    of = np.asarray(label)[tuple(index.T)]
    return np.asarray(points[of == np.bincount(of).argmax()], np.float64)


def cut_by_points(image: U8, camera: Camera, solid: SupportedObject, longest: int, seed: int) -> Bool:
    """Hard mask at the working size: silhouette of the object's points, then GrabCut at its edge. image: (H, W, 3)
    8-bit sRGB."""
    w, h = working_size(image.shape[1], image.shape[0], longest)
    small = np.asarray(resized(image, w, h), np.uint8)
    inside, gap = silhouette_of_points(camera, solid.points, solid.roi_radius, h, w)
    may_be = inside | silhouette_of_points(camera, solid.base, solid.roi_radius, h, w)[0]
    trimap = np.where(may_be, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[eroded(inside, max(1, gap // 2))] = cv2.GC_FGD
    trimap[~dilated(may_be, 2 * gap)] = cv2.GC_BGD
    return cut(distinct(small), trimap, seed)


def silhouette_of_points(camera: Camera, points: F64, roi_radius: float, height: int, width: int) -> tuple[Bool, int]:
    """(height, width) silhouette of projected points (N, 3), gaps closed and holes filled; and the gap in pixels."""
    K, d = matrix(camera.K), np.array(camera.distortion, np.float64)
    uv, z = project(K, inverse_rigid(matrix(camera.world_from_cam)), d, points)
    scale = width / camera.width
    front = np.isfinite(uv).all(1)
    if not front.any():
        return np.zeros((height, width), bool), 1
    gap = max(1, int(np.ceil(SPACING * roi_radius * K[0, 0] * scale / float(np.median(z[front])))))
    gap = min(gap, max(height, width) // 4)
    pad = 2 * gap + 2  # so that areas are also closed and filled across the frame's border
    canvas = np.zeros((height + 2 * pad, width + 2 * pad), np.uint8)
    at = np.floor(uv[front] * scale).astype(np.int64) + pad
    at = at[(at >= 0).all(1) & (at[:, 0] < canvas.shape[1]) & (at[:, 1] < canvas.shape[0])]
    canvas[at[:, 1], at[:, 0]] = 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * gap + 1, 2 * gap + 1))
    closed = ndimage.binary_fill_holes(cv2.morphologyEx(canvas, cv2.MORPH_CLOSE, disc))
    return np.asarray(closed)[pad:-pad, pad:-pad] > 0, gap


def distinct(image: U8) -> U8:
    """(H, W, 3) features that separate subject and background: the colours; for a grey photo brightness, its local mean
    and its local standard deviation, because a grey level alone is not distinctive."""
    spread = image.max(2).astype(np.int16) - image.min(2)
    if float(np.quantile(spread, 0.9)) > GREY:
        return image
    grey = image[..., 1].astype(np.float32)
    mean = np.asarray(cv2.GaussianBlur(grey, (0, 0), TEXTURE_PIXELS), np.float32)
    square = np.asarray(cv2.GaussianBlur(grey * grey, (0, 0), TEXTURE_PIXELS), np.float32)
    varies = TEXTURE_GAIN * np.sqrt(np.maximum(square - mean * mean, 0))
    return np.ascontiguousarray(np.dstack([grey, mean, varies.clip(0, 255)]).astype(np.uint8))
