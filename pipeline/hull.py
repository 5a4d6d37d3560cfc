"""Visual hull of silhouettes: the largest solid that is consistent with all masks.

Symbols
    alpha     (H, W) in [0, 1], 1 = subject; a pixel belongs to the subject where alpha >= 0.5
    level(p)  the (max_outside + 1)-largest, over the views that see p, of d_i(project_i(p)) * depth_z / focal:
              distance of p outside view i's silhouette (negative: inside), in asset units
    d_i       signed distance to the contour in view i, pixels (pipeline.silhouettes)

`level` is 1-Lipschitz up to perspective, so that coarse cells can be decided as a whole. Its zero set is the hull to a
fraction of a voxel. A view does not vote on points outside its frame.

Source: Laurentini, The visual hull concept for silhouette-based image understanding (1994).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.pieces import subject_pieces
from pipeline.silhouettes import Stack, lens_radius, silhouette, stack
from pipeline.transforms import inverse_rigid, matrix, project

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
S = TypeVar("S", bound=np.generic)

BAND_CELLS = 2.0  # `level` is exact within this many cells of the hull's surface and clamped beyond
CHUNK = 1 << 15  # points projected at a time: the temporary arrays fit in the processor's cache
MAX_VOXELS = 512**3


@dataclass(frozen=True, slots=True)
class Hull:
    """Voxels indexed [ix, iy, iz], centres at lo + (i + 0.5) * cell, asset coordinates.

    occupied: (X, Y, Z), conservative: level <= half a cell, which keeps parts thinner than a voxel.
    level: (X, Y, Z) asset units, negative inside, clamped to +-BAND_CELLS * cell; its zero set is the unbiased surface.
    seen: (X, Y, Z) number of views that see the voxel (counted until it is carved).
    """

    occupied: Bool
    level: F32
    seen: npt.NDArray[np.int16]
    lo: F64
    cell: float

    @property
    def hi(self) -> F64:
        """(3,) upper corner of the voxel grid."""
        out: F64 = self.lo + np.array(self.occupied.shape) * self.cell
        return out

    def centres(self, where: Bool) -> F64:
        """(N, 3) centres of the voxels where a mask (X, Y, Z) is True."""
        out: F64 = self.lo + (np.argwhere(where) + 0.5) * self.cell
        return out


# ------------------------------------------------------------------ the hull
def visual_hull(
    cameras: Sequence[Camera],
    alphas: Sequence[F32],
    lo: npt.ArrayLike,
    hi: npt.ArrayLike,
    cell: float,
    *,
    min_views: int = 3,
    max_outside: int = 0,
    outside_share: float = 1.0,
) -> Hull:
    """Carve the box [lo, hi] with silhouettes.

    Args:
        cameras, alphas: the views; an alpha (H, W) covers the camera's whole frame at any resolution.
        lo, hi: (3,) corners, asset units; the grid covers at least the box.
        cell: voxel edge, asset units.
        min_views: voxels that fewer views see are empty.
        max_outside: a voxel is carved if more views than this show it as background (0: the exact hull).
        outside_share: it is also carved if more than this share of the views that see it do so; this matters where
            only few views see a voxel.

    Raises:
        StageError: no views, an empty box, or too many voxels.
    """
    lo, hi = np.asarray(lo, np.float64), np.asarray(hi, np.float64)
    shape = _grid_shape(lo, hi, cell, len(cameras), len(alphas))
    views = stack([silhouette(c, a, 0.5 * (lo + hi), cell) for c, a in zip(cameras, alphas, strict=True)])
    band = BAND_CELLS * cell
    coarsest = 4 if min(shape) >= 16 else 1
    level: F32 = np.zeros(tuple(-(-n // coarsest) for n in shape), np.float32)
    seen = np.zeros(level.shape, np.int16)
    open_ = np.ones(level.shape, bool)
    factor = coarsest
    while True:
        index = np.argwhere(open_)
        points = lo + (index + 0.5) * (cell * factor)
        # 1.2: depth varies inside a coarse cell and lenses distort, so the Lipschitz constant is a little above 1
        reach = 0.0 if factor == 1 else 1.2 * np.sqrt(3) / 2 * cell * factor
        found, count, settled = _consult(views, points, reach, band, (min_views, max_outside, outside_share))
        at = tuple(index.T)
        level[at], seen[at], open_[at] = found, count, ~settled
        if factor == 1:
            break
        factor //= 2
        target = tuple(-(-n // factor) for n in shape)
        level, seen, open_ = _doubled(level, target), _doubled(seen, target), _doubled(open_, target)
    return Hull(level <= 0.5 * cell, level, seen, lo, float(cell))


def _grid_shape(lo: F64, hi: F64, cell: float, cameras: int, alphas: int) -> tuple[int, int, int]:
    if not cameras or cameras != alphas:
        raise StageError(
            "the visual hull has no silhouettes",
            where="hull",
            value=f"{cameras} cameras, {alphas} masks",
            limit="at least one view with a mask",
            remedy="check the masks and which views are held out",
        )
    if not (np.isfinite([*lo, *hi, cell]).all() and (hi > lo).all() and cell > 0):
        raise StageError(
            "the visual hull's box is empty",
            where="hull",
            value=f"{lo} to {hi}, cell {cell}",
            limit="lo < hi and cell > 0, all finite",
            remedy="check the region of interest",
        )
    shape = np.maximum(np.ceil((hi - lo) / cell - 1e-6), 1)
    if shape.prod() > MAX_VOXELS:
        raise StageError(
            "the visual hull has too many voxels",
            where="hull",
            value=f"{shape.prod():.3g}",
            limit=f"{MAX_VOXELS:.3g}",
            remedy="choose larger cells",
        )
    x, y, z = (int(n) for n in shape)
    return x, y, z


def _doubled(array: npt.NDArray[S], shape: tuple[int, ...]) -> npt.NDArray[S]:
    for axis in range(3):
        array = np.repeat(array, 2, axis)
    return np.ascontiguousarray(array[: shape[0], : shape[1], : shape[2]])


def _consult(
    views: Stack, points: F64, reach: float, band: float, rule: tuple[int, int, float]
) -> tuple[F32, npt.NDArray[np.int16], Bool]:
    """Level (N,) clamped to the band, number of views that see the point (N,), and whether the sign of the level holds
    for everything within `reach` (N,)."""
    parts = [_consult_chunk(views, points[i : i + CHUNK], reach, band, rule) for i in range(0, len(points), CHUNK)]
    if not parts:
        return np.zeros(0, np.float32), np.zeros(0, np.int16), np.zeros(0, bool)
    level, seen, settled = (np.concatenate(p) for p in zip(*parts, strict=True))
    return level, seen, settled


def _consult_chunk(
    views: Stack, points: F64, reach: float, band: float, rule: tuple[int, int, float]
) -> tuple[F32, npt.NDArray[np.int16], Bool]:
    from pipeline.silhouette_kernels import largest_outside

    min_views, max_outside, share = rule
    n, far = len(points), reach + band
    # largest levels first, over the views that see the whole neighbourhood, and over those that may see a part of it
    sure = np.full((max_outside + 1, n), -np.inf, np.float32)
    maybe = sure.copy() if reach else sure
    seen, glimpsed = np.zeros(n, np.int16), np.zeros(n, np.int16)
    largest_outside(points, views.views, views.shapes, views.starts, views.distances, reach, np.float32(far), sure,
                    maybe, seen, glimpsed)  # fmt: skip
    lenient, column = np.minimum(max_outside, (share * seen).astype(np.intp)), np.arange(n)
    level = sure[lenient, column]
    carved = sure[np.minimum(max_outside, (share * glimpsed).astype(np.intp)), column] > far
    unseen = (glimpsed < min_views) & ~carved
    inside = (maybe[lenient, column] < -far) & (seen >= min_views)
    clamped = np.where(unseen, band, level.clip(-band, band)).astype(np.float32)
    return clamped, seen, carved | unseen | inside


# ------------------------------------------------------------------ functions of a hull
def hull_bounds(
    cameras: Sequence[Camera],
    alphas: Sequence[F32],
    roi_radius: float,
    *,
    cells: int = 64,
    margin: float = 0.05,
    min_views: int = 3,
    max_outside: int = 0,
    keep: Callable[[Hull], Hull] = lambda hull: hull,
    reach: tuple[F64, F64] | None = None,
) -> tuple[F64, F64]:
    """(3,) lower and upper corner of the subject's bounding box in the cube of half-edge 1.6 * roi_radius. keep:
    selects the part of the hull that counts (pipeline.extent). reach: (3,) corners of a box that is searched as well,
    asset units, because an extent can be larger than the cube.

    `margin` is added on every side, as a fraction of the longest edge; the box stays inside the searched space.

    Raises:
        StageError: the visual hull is empty.
    """
    low, high = np.full(3, -1.6 * roi_radius), np.full(3, 1.6 * roi_radius)
    if reach is not None:
        low, high = np.minimum(low, reach[0]), np.maximum(high, reach[1])
    cell = float((high - low).max()) / cells
    hull = keep(visual_hull(cameras, alphas, low, high, cell, min_views=min_views, max_outside=max_outside))
    body = subject_pieces(hull.occupied, hull.lo + 0.5 * hull.cell, hull.cell)
    if not body.any():
        raise StageError(
            "the visual hull is empty: no part of space is inside all masks",
            where="visual hull",
            value="empty",
            limit=f"a solid that at least {min_views} views see",
            remedy="check the masks (is the subject white?), the poses, and the region of interest",
        )
    index = np.argwhere(body)
    lo, hi = hull.lo + index.min(0) * hull.cell, hull.lo + (index.max(0) + 1) * hull.cell
    room = margin * float((hi - lo).max())
    return np.maximum(lo - room, low), np.minimum(hi + room, high)


def hull_sdf(hull: Hull) -> F32:
    """(X, Y, Z) signed distance at voxel centres, asset units, negative inside.

    It is the distance to the surface point in the nearest voxel that the surface crosses. Near the surface it is
    `level` where that is smaller, because it is also exact between those points. An empty hull is positive everywhere
    (the grid's diagonal), a full one negative.
    """
    inside = hull.level <= 0
    diagonal = float(np.linalg.norm(hull.hi - hull.lo))
    if inside.all() or not inside.any():
        return np.full(inside.shape, -diagonal if inside.all() else diagonal, np.float32)
    crossing = _mean_crossings(hull)  # (X, Y, Z, 3), NaN where the surface does not pass
    nearest = ndimage.distance_transform_edt(np.isnan(crossing[..., 0]), return_distances=False, return_indices=True)
    centres = hull.centres(np.ones(inside.shape, bool)).reshape(*inside.shape, 3)
    distance = np.linalg.norm(crossing[tuple(nearest)] - centres, axis=-1)
    size = np.abs(hull.level)
    size = np.where(size < 0.95 * BAND_CELLS * hull.cell, np.minimum(size, distance), distance)
    return np.asarray(np.where(inside, -size, size), np.float32)


def _mean_crossings(hull: Hull) -> F64:
    """(X, Y, Z, 3) mean of the surface points in each voxel, NaN where there are none."""
    points = surface_points(hull)
    shape = hull.level.shape
    index = np.minimum(((points - hull.lo) / hull.cell).astype(np.intp), np.array(shape) - 1)
    flat = np.ravel_multi_index(tuple(index.T), shape)
    total = int(np.prod(shape))
    count = np.bincount(flat, minlength=total)
    sums = np.stack([np.bincount(flat, points[:, k], minlength=total) for k in range(3)], -1)
    out = np.full((total, 3), np.nan)
    out[count > 0] = sums[count > 0] / count[count > 0, None]
    return out.reshape(*shape, 3)


def surface_points(hull: Hull) -> F64:
    """(N, 3) points on the hull's surface: interpolated sign changes of `level` between neighbouring voxels."""
    found = []
    for axis in range(3):
        a = np.moveaxis(hull.level, axis, 0)
        first, second = a[:-1], a[1:]
        index = np.argwhere((first <= 0) != (second <= 0))
        v0, v1 = first[tuple(index.T)], second[tuple(index.T)]
        at = index.astype(np.float64)
        at[:, 0] += v0 / (v0 - v1)
        at = np.concatenate([at[:, 1 : axis + 1], at[:, :1], at[:, axis + 1 :]], 1)  # undo moveaxis
        found.append(hull.lo + (at + 0.5) * hull.cell)
    return np.concatenate(found)


@dataclass(frozen=True, slots=True)
class Cloud:
    """What `render_silhouette` projects: a hull as points, made once for all views.

    shell: (N, 3) points on the surface, and centres of the inside voxels at the surface or at the grid's border.
    inside: (M, 3) the same with all inside voxels, for the depth. cell: asset units.
    """

    shell: F64
    inside: F64
    cell: float


def cloud(hull: Hull) -> Cloud:
    """A hull as points. The shell lacks voxels deep inside: in every view a part of the surface lies before them."""
    inside = hull.level <= 0
    deep = ndimage.binary_erosion(inside)  # with its six neighbours inside; beyond the grid is outside
    surface = surface_points(hull)
    shell = np.concatenate([surface, hull.centres(inside & ~deep)])
    return Cloud(shell, np.concatenate([surface, hull.centres(inside)]), hull.cell)


def render_silhouette(points: Cloud, camera: Camera, height: int, width: int) -> F32:
    """(height, width) soft silhouette in [0, 1] of a hull in the camera's whole frame, distortion included.

    The shell is projected, and gaps between its points are filled by a morphological closing. It does not move the
    outermost points, so the outline is accurate to about a tenth of a voxel's footprint.
    """
    import cv2

    K, d = matrix(camera.K), np.array(camera.distortion, np.float64)
    cam_from_world = inverse_rigid(matrix(camera.world_from_cam))
    reach = lens_radius(camera) if np.any(d) else None
    depth = _middle_depth(points, cam_from_world, reach)
    if depth is None:
        return np.zeros((height, width), np.float32)
    footprint = points.cell * np.sqrt(K[0, 0] * K[1, 1]) / depth
    factor = float(np.clip(4.0 / footprint, 256 / max(camera.width, camera.height), 1.0))  # about 4 pixels a voxel
    w, h = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
    radius = int(np.ceil(1.2 * footprint * factor)) + 1
    pad = 2 * radius + 1
    canvas = np.zeros((h + 2 * pad, w + 2 * pad), np.uint8)
    for some in _chunks(points.shell):
        uv, z = project(K, cam_from_world, d, some)
        uv = uv[_before(some, z, cam_from_world, reach)]
        at = np.floor(uv * (w / camera.width, h / camera.height)).astype(np.int64) + pad
        at = at[(at >= 0).all(1) & (at[:, 0] < w + 2 * pad) & (at[:, 1] < h + 2 * pad)]
        canvas[at[:, 1], at[:, 0]] = 255
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    canvas = np.asarray(cv2.morphologyEx(canvas, cv2.MORPH_CLOSE, disc), np.uint8)[pad : pad + h, pad : pad + w]
    smooth = np.ascontiguousarray(canvas.astype(np.float32) / 255)
    mode = cv2.INTER_AREA if width <= w else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(smooth, (width, height), interpolation=mode), np.float32)


def _middle_depth(points: Cloud, cam_from_world: F64, reach: float | None) -> float | None:
    """Median depth_z of the hull's inside, asset units; None if the camera sees nothing of it."""
    found = []
    for some in _chunks(points.inside):
        z = some @ cam_from_world[2, :3] + cam_from_world[2, 3]
        found.append(z[_before(some, z, cam_from_world, reach)])
    depths = np.concatenate([*found, np.empty(0)])
    return float(np.median(depths)) if len(depths) else None


def _chunks(points: F64) -> Iterator[F64]:
    return (points[i : i + CHUNK] for i in range(0, len(points), CHUNK))


def _before(points: F64, z: F64, cam_from_world: F64, reach: float | None) -> Bool:
    """(N,) which points are in front of the camera and within `reach` of the axis on the z = 1 plane, where its lens
    model holds; None: everywhere."""
    good = z > 1e-9
    if reach is not None:
        x, y = (points @ m[:3] + m[3] for m in cam_from_world[:2])  # one by one: BLAS is slow for (N, 3) by (3, 2)
        good &= x * x + y * y < (reach * np.where(good, z, 0)) ** 2
    return np.asarray(good)
