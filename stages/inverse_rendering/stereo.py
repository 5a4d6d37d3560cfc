"""Refinement of the initial geometry by plane-sweep stereo along the hull's normals.

A hull fills concavities that no silhouette shows: beside the neck, behind the ears, above the collar bones. Rendering
losses act only near the surface and can't remove such a fill. A sweep moves a patch inwards along the normal, compares
it between the photos that see it, and so finds the true depth directly (measured in docs/benchmarks.md).

Symbols: points P (N, 3) on the start's zero set with unit normals (N, 3), asset units; a sweep's offsets (J,) along the
normals, positive outwards; scores (N, J) of pipeline.maths.correlation.agreement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline import transforms
from pipeline.colour import srgb_from_linear
from pipeline.fields.geometry import GridSdf
from pipeline.fields.kernels import look_up
from pipeline.images import shrink_whole
from pipeline.maths.correlation import FLOOR, agreement
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import WHOLE, PhotoView, factor_for
from stages.inverse_rendering.signed_distance import distances

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
SIDE = 512  # pixels of the photos' longest side: a patch then covers about 4 mm of a head
HALF, SPACING = 2, 2.0  # a patch has (2 HALF + 1)^2 samples; SPACING: their distance in pixels
BLUR = 0.7  # pixels: against aliasing of samples two pixels apart, and against noise
VIEWS = 6  # number of views, those nearest to a point's normal, that are compared
MIN_COSINE = 0.25  # between a normal and the direction to a camera
POINTS = 12_000  # surface points of one sweep
CERTAIN = 4e-3  # squared confidence, mean over the neighbours, at which a point moves half way: noise reaches 6e-2
# Grey for the correlation of photos only, in which any smooth weights and encoding serve. Not those of
# pipeline.colour: with them the scanned head loses 0.2 dB of albedo (docs/benchmarks.md).
GREY, ENCODING = np.array([0.3, 0.6, 0.1], np.float32), np.float32(1 / 2.2)
LAPLACIAN: F32 = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
INSIDE, MIN_PIXELS = 0.99, 500  # smallest alpha and number of pixels for the noise estimate


@dataclass(frozen=True, slots=True)
class Sweep:
    """Range outwards and inwards as shares of the subject's longest side; step in pixels; points that vote on an
    offset.

    inward_clean: inwards if the photos' noise is below FLOOR: on noisy skin the best of many depths is random.
    """

    outward: float
    inward: float
    inward_clean: float
    step: float
    voters: int


SWEEPS = (
    Sweep(0.006, 0.04, 0.08, 1.1, 42),
    Sweep(0.012, 0.016, 0.016, 0.75, 36),
    Sweep(0.006, 0.006, 0.006, 0.5, 24),
)


@dataclass(frozen=True, slots=True)
class Photos:
    """Grey photos without distortion, concatenated in `grey`; `first` (V,) offsets, `width` and `height` (V,) pixels.

    image_from_world (V, 3, 4); centre (V, 3). noise: standard deviation of the noise after the blur.
    """

    grey: Tensor
    first: Tensor
    width: Tensor
    height: Tensor
    image_from_world: Tensor
    centre: Tensor
    noise: float


def start_from_photos(
    hull: Start,
    views: list[PhotoView],
    device: str,
    check: Callable[[], None] = lambda: None,
    sweeps: tuple[Sweep, ...] | None = None,
) -> Start:
    """The hull's SDF moved to where the photos agree; unchanged where they do not determine depth, as on smooth skin.

    check: called about every second; it raises if the run was cancelled. sweeps: all of SWEEPS if None.
    """
    photos = photos_of(views, device)
    values, side = hull.values, hull.cell * max(np.ptp(np.argwhere(hull.values < 0), axis=0), default=1)
    for sweep in SWEEPS if sweeps is None else sweeps:
        check()
        points, normals = surface_points(values, hull.lo, hull.cell)
        order, seen, pixel = best_views(points, normals, Start(values, hull.lo, hull.cell), photos)
        inward = sweep.inward_clean if photos.noise < FLOOR else sweep.inward
        offsets = np.arange(sweep.outward * side, -inward * side, -sweep.step * pixel)
        scores = sweep_scores(points, normals, offsets, order, seen, pixel, photos, check)
        kept = scores.max(1) > -1
        if kept.sum() < sweep.voters:
            break
        points, normals, scores = points[kept], normals[kept], scores[kept]
        offset, confidence = vote(points, normals, scores, offsets, sweep.voters)
        reach = max(sweep.outward, inward) * side
        values = moved(Start(values, hull.lo, hull.cell), points, offset, confidence, reach)
    return Start(values, hull.lo, hull.cell)


def photos_of(views: list[PhotoView], device: str) -> Photos:
    """Grey photos of at most SIDE pixels, gamma-encoded, so that equal steps are about equally visible in light and
    shade."""
    grey, matrices, sizes, noise = [], [], [], []
    for view in views:
        f = factor_for(view.size, SIDE)
        image = np.clip(shrink_whole(view.rgb, f) @ GREY, 0, None) ** ENCODING
        K = view.K.copy()
        K[:2] /= f
        noise.append(noise_of(image, shrink_whole(view.alpha, f) > INSIDE))
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), np.float32)
        grey.append(without_distortion(image, K, view.distortion).ravel())
        sizes.append(image.shape)
        matrices.append(K @ transforms.inverse_rigid(view.world_from_cam)[:3])
    height, width = np.array(sizes).T
    first = np.concatenate([[0], np.cumsum(height * width)[:-1]])
    centre = np.stack([v.world_from_cam[:3, 3] for v in views]).astype(np.float32)
    level = max(float(np.median(noise)) / (2 * np.sqrt(np.pi) * BLUR), FLOOR / 3)
    return Photos(
        torch.from_numpy(np.concatenate(grey)).to(device),
        torch.from_numpy(first).to(device),
        torch.from_numpy(width).to(device),
        torch.from_numpy(height).to(device),
        torch.from_numpy(np.stack(matrices).astype(np.float32)).to(device),
        torch.from_numpy(centre).to(device),
        level,
    )


def noise_of(image: F32, inside: npt.NDArray[np.bool_]) -> float:
    """Standard deviation of the noise of a picture (H, W) within `inside` (H, W), in its unit; 0 if too little is
    inside.

    From a double Laplacian, which does not respond to smooth shading. Source: Immerkaer, Fast noise variance estimation
    (1996), with the median absolute deviation instead of the mean.
    """
    inner = cv2.erode(inside.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    if inner.sum() < MIN_PIXELS:
        return 0.0
    answer = cv2.filter2D(image, -1, LAPLACIAN)[inner]
    return float(1.4826 * np.median(np.abs(answer)) / np.sqrt((LAPLACIAN**2).sum()))


def photo_noise(view: PhotoView, side: int) -> float:
    """Standard deviation of the noise of a photo's green channel within its subject, sRGB, at the size of the fit."""
    f = factor_for(view.size, side)
    green = srgb_from_linear(shrink_whole(np.ascontiguousarray(view.rgb[..., 1]), f)).astype(np.float32)
    return noise_of(green, shrink_whole(view.alpha, f) > WHOLE)


def without_distortion(image: F32, K: F64, distortion: F64) -> F32:
    """A photo (H, W), undistorted by bilinear resampling. Only for the initial geometry; the fit uses the photos
    without resampling."""
    if not np.any(distortion):
        return image
    h, w = image.shape
    xy: F64 = np.asarray(np.linalg.solve(K[:2, :2], (transforms.pixel_centres(w, h) - K[:2, 2]).T).T, np.float64)
    uv = transforms.distort(xy, distortion) @ K[:2, :2].T + K[:2, 2] - 0.5
    x, y = (uv[:, i].reshape(h, w).astype(np.float32) for i in (0, 1))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def reduced(view: PhotoView, side: int) -> tuple[F64, Callable[[F32], F32]]:
    """K of a view of at most `side` pixels, and what makes a picture (H, W) of the whole photo so small, without
    distortion."""
    scale = min(1.0, side / max(view.size))
    size = (max(round(view.size[0] * scale), 2), max(round(view.size[1] * scale), 2))
    K = view.K.copy()
    K[:2] *= np.array([[size[0] / view.size[0]], [size[1] / view.size[1]]])

    def small(image: F32) -> F32:
        resized = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return without_distortion(np.asarray(resized, np.float32), K, view.distortion)

    return K, small


def surface_points(values: F32, lo: F32, cell: float) -> tuple[F64, F64]:
    """Up to POINTS random points (N, 3) of the zero set of the SDF (X, Y, Z), smoothed over one cell, and their normals
    (N, 3)."""
    smooth = ndimage.gaussian_filter(values, 1.0)
    node = np.argwhere(np.abs(smooth[1:-1, 1:-1, 1:-1]) < 0.6 * cell) + 1
    at = tuple(node.T)
    gradient = np.stack([_difference(smooth, at, axis) / (2 * cell) for axis in range(3)], -1).astype(np.float64)
    square = (gradient**2).sum(1)
    keep = np.flatnonzero(square > 0.04)
    if len(keep) > POINTS:
        keep = np.sort(np.random.default_rng(0).choice(keep, POINTS, replace=False))
    g = gradient[keep]
    points = lo + cell * node[keep] - (smooth[at][keep] / square[keep])[:, None] * g
    return points, g / np.sqrt(square[keep])[:, None]


def _difference(values: F32, at: tuple[npt.NDArray[np.intp], ...], axis: int) -> F32:
    ahead, behind = list(at), list(at)
    ahead[axis], behind[axis] = at[axis] + 1, at[axis] - 1
    return np.asarray(values[tuple(ahead)] - values[tuple(behind)])


def best_views(points: F64, normals: F64, start: Start, photos: Photos) -> tuple[Tensor, Tensor, float]:
    """The VIEWS views nearest to each point's normal (N, VIEWS), which of them see the point (N, VIEWS), and the median
    size of a pixel on the surface, asset units. points, normals: (N, 3)."""
    device = photos.grey.device
    p, n = (torch.from_numpy(x.astype(np.float32)).to(device) for x in (points, normals))
    geometry = start.surface(str(device))
    cosines, sizes = [], []
    for k in range(len(photos.centre)):
        way = photos.centre[k] - p
        distance = way.norm(dim=-1)
        way = way / distance[:, None]
        cosine = (way * n).sum(-1)
        q = p @ photos.image_from_world[k, :, :3].T + photos.image_from_world[k, :, 3]
        uv = q[:, :2] / q[:, 2:].clamp(min=1e-9)
        room = torch.minimum(uv.amin(-1), torch.minimum(photos.width[k] - uv[:, 0], photos.height[k] - uv[:, 1]))
        ok = (cosine > MIN_COSINE) & (q[:, 2] > 0) & (room > 2 * HALF * SPACING)
        candidate = torch.nonzero(ok).squeeze(-1)
        hidden = _hidden(geometry, p[candidate], distance[candidate], photos.centre[k])
        ok[candidate[hidden]] = False
        cosines.append(torch.where(ok, cosine, torch.full_like(cosine, -1.0)))
        sizes.append(torch.where(ok, distance / photos.image_from_world[k, :2, :3].norm(dim=-1).amax(), torch.nan))
    table = torch.stack(cosines, 1)
    order = table.argsort(dim=1, descending=True, stable=True)[:, :VIEWS]
    pixel = float(torch.stack(sizes).nanmedian())
    return order, table.gather(1, order) > 0, pixel if np.isfinite(pixel) else start.cell


def _hidden(geometry: GridSdf, p: Tensor, distance: Tensor, centre: Tensor) -> Tensor:
    """(N,) whether a ray from the camera hits the surface more than two cells before the point."""
    d = (p - centre) / distance[:, None]
    o = centre.expand_as(d).contiguous()
    near, far = box_interval(o, d, *geometry.box())
    t, hit, _ = geometry.trace(o, d, near, far)
    return hit & (t < distance - 2 * geometry.cell)


def sweep_scores(
    points: F64,
    normals: F64,
    offsets: F64,
    order: Tensor,
    seen: Tensor,
    pixel: float,
    photos: Photos,
    check: Callable[[], None] = lambda: None,
) -> F32:
    """(N, J) agreement of the photos on the patch around each point, moved along its normal by each offset (J,)."""
    device = photos.grey.device
    n = torch.from_numpy(normals.astype(np.float32)).to(device)
    p = torch.from_numpy(points.astype(np.float32)).to(device)
    u, v = _tangents(n)
    m = photos.image_from_world[order]
    turn = m[..., :3]
    steps = torch.arange(-HALF, HALF + 1, device=device, dtype=torch.float32) * SPACING * pixel
    along_u, along_v, along_n = ((turn @ x[:, None, :, None]).squeeze(-1) for x in (u, v, n))
    centre = (turn @ p[:, None, :, None]).squeeze(-1) + m[..., 3]
    grid = along_u[..., None, None] * steps[:, None] + along_v[..., None, None] * steps  # (N, V, 3, 5, 5)
    grid = grid.flatten(3)
    out = []
    for offset in offsets:
        check()
        q = grid + (centre + float(offset) * along_n)[..., None]
        patches = look_up(photos.grey, photos.first, photos.width, photos.height, order, q)
        out.append(agreement(patches, seen, photos.noise))
    return torch.stack(out, 1).cpu().numpy()


def _tangents(n: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (N, 3) perpendicular to each unit normal."""
    helper = torch.zeros_like(n)
    helper.scatter_(1, n.abs().argmin(1, keepdim=True), 1.0)
    u = torch.nn.functional.normalize(torch.linalg.cross(n, helper), dim=-1)
    return u, torch.linalg.cross(n, u)


def vote(points: F64, normals: F64, scores: F32, offsets: F64, voters: int) -> tuple[F64, F64]:
    """Offset (N,) from the scores of a point and its neighbours with similar normals, and its confidence (N,) >= 0.

    A peak is refined by a parabola. A peak at an end of the sweep means that the surface is beyond: confidence 0. A
    sweep of one or two offsets has only ends, so its confidence is 0 too; it occurs with very coarse photos.
    """
    if len(offsets) < 3:
        return np.zeros(len(points)), np.zeros(len(points))
    voters = min(voters, len(points))
    distance, near = (a.reshape(-1, voters) for a in cKDTree(points).query(points, voters, workers=-1))
    facing = np.clip((normals[near] * normals[:, None]).sum(2), 0, None) ** 2
    weight = facing * np.exp(-((distance / np.maximum(distance[:, -1:], 1e-12)) ** 2))
    score = np.einsum("nk,nkj->nj", weight, scores[near]) / weight.sum(1, keepdims=True)
    best = score.argmax(1)
    inner = best.clip(1, len(offsets) - 2)
    before, peak, after = (score[np.arange(len(score)), inner + i] for i in (-1, 0, 1))
    bend = np.minimum(before - 2 * peak + after, -1e-9)
    whole = best == inner
    shift = np.where(whole, np.clip(0.5 * (before - after) / bend, -0.5, 0.5), 0.0)
    confidence = np.where(whole, score.max(1) - np.median(score, 1), 0.0)
    return offsets[best] + shift * (offsets[1] - offsets[0]), np.clip(confidence, 0, None)


def moved(start: Start, points: F64, offset: F64, confidence: F64, reach: float) -> F32:
    """The SDF with its zero set moved along the normals: the weighted offsets of nearby points are subtracted from its
    values, which are then made distances again. offset, confidence: (N,) of points (N, 3); reach: asset units."""
    cell = start.cell
    node = np.argwhere(np.abs(start.values) < reach + 3 * cell)
    distance, near = cKDTree(points).query(start.lo + cell * node, min(24, len(points)), workers=-1)
    width = np.maximum(1.2 * cell, distance[:, :1] + 0.5 * cell)
    kernel = np.exp(-0.5 * (distance / width) ** 2)
    weight = kernel * confidence[near] ** 2
    shift = -(weight * offset[near]).sum(1) / np.maximum(weight.sum(1) + CERTAIN * kernel.sum(1), 1e-12)
    values = start.values.astype(np.float64)
    values[tuple(node.T)] += shift
    return distances(values, start.lo, cell)
