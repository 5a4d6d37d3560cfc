"""Dense stereo in the cameras: a depth map for each photo from its best neighbours.

A sweep along the hull's normals fails where the hull has nothing to do with the surface: photos from an arc, deep
concavities. Here each photo gets a depth map between the hull's front and back: plane sweep with NCC and semi-global
aggregation on a small picture, then PatchMatch with slanted planes on a larger one. A depth counts if the depth maps of
at least two other views show the same point.

Symbols as in stereo_kernels: w = 1 / z inverse depth; A, b of a pair of views. Pictures (V, H, W) of the subject only,
without distortion, padded with NaN.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy import ndimage
from torch import Tensor

from pipeline import transforms
from pipeline.maths.correlation import FLOOR
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering import stereo_kernels as kernels
from stages.inverse_rendering.depth_kernels import agreeing
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import WHOLE, PhotoView
from stages.inverse_rendering.stereo import GREY, noise_of, surface_points, without_distortion

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.intp]
COARSE, FINE = 160, 320  # pixels of the subject's longest side in the sweep and in the refinement
BORDER = 6  # pixels around the subject
BLUR = 0.6  # pixels, against noise and aliasing
NEIGHBOURS, REFINED = 6, 4  # of a view; of these, the best ones with which its depths are refined
BASELINE, NARROW, WIDE = 13.0, 5.0, 10.0  # degrees: best angle between neighbours, and its spread to either side
APART = 5.0  # degrees between two neighbours of one view, so that they lie on different sides of it
MIN_ANGLE, MAX_ANGLE = 2.0, 40.0  # degrees
HALF = 3  # the sweep's windows have 2 HALF + 1 pixels
PLANES_PER_PIXEL, MIN_PLANES, MAX_PLANES = 1.4, 16, 256
P1, P2 = 0.03, 0.25  # penalties of the aggregation: step of one plane, larger step
STRIDE, ROUNDS, PULL = 2, 2, 0.04
SAME_DEPTH, SAME_PIXEL, AGREEING = (
    3.0,
    1.0,
    2,
)  # sizes of a fine pixel on the surface; fine pixels; number of other views
MIN_COSINE = 0.2  # between a depth map's surface and the ray
SPECKLE = 60  # pixels
MIN_SCORE = 0.4  # NCC below which a depth is not used
CLEAR = 7  # pixels: side of the square around a blank pixel in which no depth is estimated: highlights have no place
WHITE = 0.9  # of the photo's largest value: a clipped pixel is blank if all its channels exceed it
MARGIN = 1.0  # cells by which the range of a ray exceeds the hull


@dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures at one scale.

    grey (V, H, W), NaN beyond a frame and outside of the subject; usable (V, H, W): subject, neither clipped nor
    doubtful; K (V, 3, 3); nearest, farthest (V, H, W): inverse depths where rays enter and leave the hull, NaN where
    they miss it. noise: standard deviation.
    """

    grey: F32
    usable: Bool
    K: F64
    nearest: F32
    farthest: F32
    noise: float


@dataclass(frozen=True, slots=True)
class DepthMaps:
    """Consistent depths of all views: inverse (V, H, W) inverse depths, NaN where there is none; slope (V, H, W, 2) per
    pixel; weight (V, H, W) in [0, 1]; K (V, 3, 3), world_from_cam (V, 4, 4)."""

    inverse: F32
    slope: F32
    weight: F32
    K: F64
    world_from_cam: F64


def depth_maps(
    hull: Start,
    views: list[PhotoView],
    check: Callable[[], None] = lambda: None,
    alone: tuple[int, ...] = (),
) -> DepthMaps:
    """Consistent depth maps of all views within the hull. check: raises if the run was cancelled. alone: positions of
    views that are nobody's neighbour, so that the other views' depths do not depend on them."""
    poses = np.stack([v.world_from_cam for v in views])
    neighbours = neighbours_of(hull, views, alone)
    coarse, fine = (pictures_of(views, hull, side) for side in (COARSE, FINE))
    planes = np.full((*fine.grey.shape, 3), np.nan, np.float32)
    score = np.full(fine.grey.shape, kernels.FAILED, np.float32)

    def one(i: int) -> None:
        check()
        if len(neighbours[i]) >= kernels.MIN_OTHERS:
            _depth_of_view(i, neighbours[i], coarse, fine, poses, planes[i], score[i])

    with _threads() as pool:
        list(pool.map(one, range(len(views))))
    return _consistent(planes, score, neighbours, fine, poses)


def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, min(os.cpu_count() or 1, torch.get_num_threads())))


# ------------------------------------------------------------------ pictures
def pictures_of(views: list[PhotoView], hull: Start | None, side: int) -> Pictures:
    """Grey pictures, gamma-encoded, in which the subject's longest side has at most `side` pixels. hull: None if the
    ranges of the rays are not needed."""
    with _threads() as pool:
        parts = list(pool.map(lambda view: _picture(view, side), views))
    h, w = (max(p[0].shape[a] for p in parts) for a in (0, 1))
    grey = np.full((len(parts), h, w), np.nan, np.float32)
    usable = np.zeros(grey.shape, bool)
    for i, (image, mask, _, _) in enumerate(parts):
        grey[i, : image.shape[0], : image.shape[1]] = image
        usable[i, : image.shape[0], : image.shape[1]] = mask
    K = np.stack([p[2] for p in parts])
    nearest, farthest = (np.full(grey.shape, np.nan, np.float32) for _ in range(2))
    for i, view in enumerate(views):
        if hull is not None:
            nearest[i], farthest[i] = hull_range(hull, K[i], view.world_from_cam, usable[i])
            usable[i] &= np.isfinite(nearest[i])
    noise = max(float(np.median([p[3] for p in parts])) / (2 * np.sqrt(np.pi) * BLUR), FLOOR)
    return Pictures(grey, usable, K, nearest, farthest, noise)


def _picture(view: PhotoView, side: int) -> tuple[F32, Bool, F64, float]:
    """The subject's part of a photo, its usable pixels, K and the noise."""
    usable = view.alpha > 0.5
    if view.asked is not None:
        usable &= view.asked > 0.5
    rows, columns = (np.flatnonzero(usable.any(a)) for a in (1, 0))
    if not len(rows):
        return np.zeros((2, 2), np.float32), np.zeros((2, 2), bool), view.K.copy(), 0.0
    scale = min(1.0, side / max(np.ptp(rows) + 1, np.ptp(columns) + 1))
    size = tuple(max(round(n * scale), 2) for n in view.size)
    K = view.K.copy()
    K[:2] *= np.array([[size[0] / view.size[0]], [size[1] / view.size[1]]])
    bad = np.asarray(_blank(view), np.float32)
    linear = np.nan_to_num(np.clip(view.rgb @ GREY, 0, None))
    layers = [np.asarray(cv2.resize(x, size, interpolation=cv2.INTER_AREA)) for x in (linear, usable * 1.0, bad)]
    grey = layers[0].astype(np.float32) ** np.float32(1 / 2.2)
    noise = noise_of(grey, layers[1] > 0.99)
    image, subject, bad = (without_distortion(x.astype(np.float32), K, view.distortion) for x in (grey, *layers[1:]))
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), np.float32)
    near_blank = cv2.dilate((bad > 0.3).astype(np.uint8), np.ones((CLEAR, CLEAR), np.uint8)) > 0
    inner = cv2.erode((subject > WHOLE).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    image[~inner] = np.nan  # the outline against the background is no texture
    mask = inner & ~near_blank
    box = [(max(int(n[0] * scale) - BORDER, 0), int(n[-1] * scale) + BORDER + 2) for n in (rows, columns)]
    K[0, 2] -= box[1][0]
    K[1, 2] -= box[0][0]
    part = slice(*box[0]), slice(*box[1])
    return image[part], mask[part], K, noise


def _blank(view: PhotoView) -> Bool:
    """(H, W) pixels without a usable value: doubtful ones, and those whose channels are all clipped. With one clipped
    channel the others still show texture."""
    red, green, blue = (view.rgb[..., k] for k in range(3))  # planes: numpy is slow along an axis of three
    bad = ~(np.isfinite(red) & np.isfinite(green) & np.isfinite(blue))
    if view.clipped is not None:
        least = np.minimum(np.minimum(red, green), blue)
        bad |= (view.clipped > 0) & (least > WHITE * np.nanmax(view.rgb))
    if view.doubtful is not None:
        bad |= view.doubtful
    return np.asarray(bad)


def hull_range(hull: Start, K: F64, world_from_cam: F64, mask: Bool) -> tuple[F32, F32]:
    """Inverse depths (H, W) where the rays of a mask (H, W) enter and leave the hull, NaN where they miss it."""
    rows, columns = np.nonzero(mask)
    out = np.full((2, *mask.shape), np.nan, np.float32)
    if not len(rows):
        return out[0], out[1]
    o, d, length = pixel_rays(K, world_from_cam, rows, columns)
    geometry = hull.surface("cpu")
    near, far = box_interval(o, d, *geometry.box())
    front, hit, _ = geometry.trace(o, d, near, far)
    beyond = far + hull.cell
    back, hit_back, _ = geometry.trace(o + beyond[:, None] * d, -d, torch.full_like(far, hull.cell), beyond - near)
    room = MARGIN * hull.cell
    z0, z1 = (front - room).clamp(min=1e-6).numpy() / length, (beyond - back + room).numpy() / length
    good = (hit & hit_back).numpy() & (z1 > z0)
    out[0, rows[good], columns[good]] = 1 / z0[good]
    out[1, rows[good], columns[good]] = 1 / z1[good]
    return out[0], out[1]


def pixel_rays(K: F64, world_from_cam: F64, rows: Ints, columns: Ints) -> tuple[Tensor, Tensor, F32]:
    """Origins and unit directions (N, 3) of pixels without distortion, and (N,) the length of a ray at depth 1."""
    return rays_at(K, world_from_cam, np.stack([columns + 0.5, rows + 0.5], -1))


def rays_at(K: F64, world_from_cam: F64, uv: F64) -> tuple[Tensor, Tensor, F32]:
    """The same of places uv (N, 2) in pixels."""
    centre, d = transforms.rays(K, world_from_cam, np.zeros(5), uv)
    length = 1 / (d @ world_from_cam[:3, 2])
    direction = torch.from_numpy(d.astype(np.float32))
    o = torch.from_numpy(centre.astype(np.float32)).expand_as(direction).contiguous()
    return o, direction, length.astype(np.float32)


# ------------------------------------------------------------------ pairs of views
def neighbours_of(hull: Start, views: list[PhotoView], alone: tuple[int, ...] = ()) -> list[Ints]:
    """For each view up to NEIGHBOURS others: about BASELINE degrees away, on different sides, seeing the same surface.

    alone: positions of views that are no neighbours, but have some.
    """
    points, normals = surface_points(hull.values, hull.lo, hull.cell)
    if not len(points):
        return [np.zeros(0, np.intp) for _ in views]
    every = max(len(points) // 800, 1)
    points, normals = points[::every], normals[::every]
    centres = np.stack([v.world_from_cam[:3, 3] for v in views])
    rays = centres[:, None] - points
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    facing = np.einsum("vpk,pk->vp", rays, normals) > 0.1
    common = (facing[:, None] & facing[None]).sum(-1) / np.maximum(facing.sum(-1), 1)[:, None]
    axes = centres - points.mean(0)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    off = angle - BASELINE
    value = common * np.exp(-0.5 * (off / np.where(off < 0, NARROW, WIDE)) ** 2)
    value[(angle < MIN_ANGLE) | (angle > MAX_ANGLE)] = 0
    value[:, list(alone)] = 0
    return [_spread(value[i], angle) for i in range(len(views))]


def _spread(value: F64, angle: F64) -> Ints:
    """The best views, each time after a reduction of those close to the ones that are chosen."""
    value = value.copy()
    chosen: list[int] = []
    while len(chosen) < NEIGHBOURS and value.max() > 1e-3:
        best = int(value.argmax())
        chosen.append(best)
        value *= 1 - 0.8 * np.exp(-0.5 * (angle[best] / APART) ** 2)
        value[best] = 0
    return np.array(chosen, np.intp)


def pair(K: F64, poses: F64, i: int, others: Ints) -> tuple[F64, F64]:
    """A (M, 3, 3) and b (M, 3) from view i to the others: K_n R K_i^-1 and K_n t."""
    a, b = np.empty((len(others), 3, 3)), np.empty((len(others), 3))
    for n, k in enumerate(others):
        relative = transforms.inverse_rigid(poses[k]) @ poses[i]
        a[n], b[n] = K[k] @ relative[:3, :3] @ np.linalg.inv(K[i]), K[k] @ relative[:3, 3]
    return a, b


# ------------------------------------------------------------------ one view
def _depth_of_view(i: int, others: Ints, coarse: Pictures, fine: Pictures, poses: F64, plane: F32, score: F32) -> None:
    """Write planes (H, W, 3) and scores (H, W) of view i at the fine scale."""
    start, step = swept(i, others, coarse, poses)
    if not np.isfinite(start).any():
        return
    plane[:] = _enlarged(start, coarse.K[i], fine.K[i], fine.usable[i])
    others = others[:REFINED]
    a, b = pair(fine.K, poses, i, others)
    a, b = a.astype(np.float32), b.astype(np.float32)
    noise, reach, pull = np.float32(fine.noise), np.float32(step), np.float32(PULL)
    kernels.refine(
        fine.grey[i], fine.usable[i], fine.nearest[i], fine.farthest[i], fine.grey[others], a, b, noise, STRIDE, ROUNDS,
        reach, pull, i, plane, score,
    )  # fmt: skip


def swept(i: int, others: Ints, pictures: Pictures, poses: F64) -> tuple[F32, float]:
    """Inverse depths (H, W) of view i by plane sweep and semi-global aggregation, and the step between planes."""
    mask = pictures.usable[i]
    shape = mask.shape
    found, score = np.full(shape, np.nan, np.float32), np.full(shape, kernels.FAILED, np.float32)
    if not mask.any():
        return found, 1.0
    a, b = pair(pictures.K, poses, i, others)
    planes = planes_for(pictures.nearest[i][mask], pictures.farthest[i][mask], mask, a, b)
    cost = np.empty((*shape, len(planes)), np.float32)
    kernels.sweep(
        pictures.grey[i], mask, pictures.nearest[i], pictures.farthest[i], planes, pictures.grey[others], a, b, HALF,
        pictures.noise, cost,
    )  # fmt: skip
    total = np.zeros_like(cost)
    kernels.aggregate(cost, mask, np.float32(P1), np.float32(P2), total)
    kernels.winners(total, cost, mask, planes, found, score)
    return found, float(planes[1] - planes[0])


def planes_for(nearest: F32, farthest: F32, mask: Bool, a: F64, b: F64) -> F64:
    """Inverse depths (D,), ascending, whose images in the neighbour with the longest baseline are about 1 /
    PLANES_PER_PIXEL pixels apart at the middle of the mask (H, W)."""
    low, high = float(np.percentile(farthest, 0.5)), float(np.percentile(nearest, 99.5))
    rows, columns = np.nonzero(mask)
    middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
    ends = [a @ middle + w * b for w in (low, high)]
    first, last = (q[:, :2] / q[:, 2:] for q in ends)
    length = float(np.linalg.norm(last - first, axis=1).max())
    count = (
        int(np.clip(np.ceil(PLANES_PER_PIXEL * length), MIN_PLANES, MAX_PLANES)) if np.isfinite(length) else MAX_PLANES
    )
    return np.linspace(low, high, count)


def _enlarged(inverse: F32, K_small: F64, K_large: F64, mask: Bool) -> F32:
    """(H, W, 3) inverse depth and slopes at the pixels of a larger picture; NaN outside its mask (H, W)."""
    known = np.isfinite(inverse)
    filled = _filled(inverse, known)
    smooth = _smooth(filled, known, 2.0)
    gy, gx = np.gradient(smooth)
    h, w = mask.shape
    scale = K_small[0, 0] / K_large[0, 0], K_small[1, 1] / K_large[1, 1]
    x = (np.arange(w) + 0.5 - K_large[0, 2]) * scale[0] + K_small[0, 2] - 0.5
    y = (np.arange(h) + 0.5 - K_large[1, 2]) * scale[1] + K_small[1, 2] - 0.5
    map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    layers = [filled, gx.astype(np.float32) * scale[0], gy.astype(np.float32) * scale[1]]
    replicate = cv2.BORDER_REPLICATE
    parts = [cv2.remap(np.asarray(g, np.float32), map_x, map_y, cv2.INTER_LINEAR, borderMode=replicate) for g in layers]
    out = np.stack(parts, -1)
    out[~mask] = np.nan
    return np.asarray(out, np.float32)


def _filled(inverse: F32, known: Bool) -> F32:
    """Inverse depths (H, W), those of the nearest known pixel where there are none."""
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(inverse[tuple(nearest)], np.float32)


def _smooth(values: F32, known: Bool, sigma: float) -> F32:
    """Gaussian mean (H, W) of the known values, with a deviation of sigma pixels."""
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma) + np.float32(1e-6)
    inside = cv2.GaussianBlur(np.where(known, values, 0).astype(np.float32), (0, 0), sigma)
    return np.where(weight > 1e-3, inside / weight, values).astype(np.float32)


# ------------------------------------------------------------------ consistency
def _consistent(planes: F32, score: F32, neighbours: list[Ints], fine: Pictures, poses: F64) -> DepthMaps:
    """Only depths that at least AGREEING neighbours confirm; their weights grow with that number and the score."""
    inverse = np.where((score >= MIN_SCORE) & (cosines(planes, fine.K) > MIN_COSINE), planes[..., 0], np.nan)
    inverse = inverse.astype(np.float32)
    tolerance = SAME_DEPTH / fine.K[:, 0, 0]
    count = np.zeros(inverse.shape, np.int32)
    for i, others in enumerate(neighbours):
        if not len(others):
            continue
        a, b = pair(fine.K, poses, i, others)
        back = [pair(fine.K, poses, int(k), np.array([i])) for k in others]
        back_a, back_b = np.concatenate([p[0] for p in back]), np.concatenate([p[1] for p in back])
        agreeing(inverse[i], inverse[others], a, b, back_a, back_b, tolerance[i], SAME_PIXEL, count[i])
    good = np.where(count >= AGREEING, inverse, np.nan).astype(np.float32)
    inverse = np.stack([without_speckles(w, t) for w, t in zip(good, tolerance, strict=True)])
    weight = np.where(np.isfinite(inverse), np.clip(score, 0, 1) ** 2 * np.minimum(count / 4, 1), 0).astype(np.float32)
    return DepthMaps(inverse, planes[..., 1:], weight, fine.K, poses)


def cosines(planes: F32, K: F64) -> F32:
    """(V, H, W) cosine between each pixel's ray and the normal of its plane (V, H, W, 3).

    In camera coordinates the plane is m . X = 1 with m = K^T (slope x, slope y, inverse depth at the image's corner).
    """
    h, w = planes.shape[1:3]
    u, v = np.meshgrid(np.arange(w, dtype=np.float32) + 0.5, np.arange(h, dtype=np.float32) + 0.5)
    out = np.empty(planes.shape[:3], np.float32)
    for i, (plane, k) in enumerate(zip(planes, K.astype(np.float32), strict=True)):
        corner = plane[..., 0] - plane[..., 1] * u - plane[..., 2] * v
        m = np.stack([plane[..., 1], plane[..., 2], corner], -1) @ k
        ray = np.sqrt(1 + ((u - k[0, 2]) / k[0, 0]) ** 2 + ((v - k[1, 2]) / k[1, 1]) ** 2)
        out[i] = plane[..., 0] / np.maximum(np.linalg.norm(m, axis=-1) * ray, 1e-12)
    return out


def without_speckles(inverse: F32, tolerance: float) -> F32:
    """A depth map (H, W) without connected regions of at most SPECKLE pixels; they are wrong more often than right.

    tolerance: between neighbouring pixels of a region, as a share of the depth.
    """
    known = np.isfinite(inverse)
    if not known.any():
        return inverse
    low, high = float(inverse[known].min()), float(inverse[known].max())
    step = max((high - low) / 30_000, 1e-12)
    levels = np.where(known, (inverse - low) / step, -32_000).astype(np.int16)
    cv2.filterSpeckles(levels, -32_000, SPECKLE, tolerance * high / step)
    return np.where(levels > -32_000, inverse, np.nan).astype(np.float32)
