"""Visual hull of silhouettes: the largest body that every photo's mask allows.

Symbols
    alpha     (H, W) in [0, 1], 1 = subject; a pixel belongs to the subject where alpha >= 0.5
    level(p)  the (max_outside + 1)-largest, over the views that see p, of d_i(project_i(p)) * depth_z / focal:
              how far p lies outside view i's silhouette (negative: inside), in asset units
    d_i       signed distance to the contour in view i, pixels, from the soft alpha (sub-pixel)

`level` is 1-Lipschitz up to perspective, which lets coarse cells be settled as a whole, and its zero set is the hull
to a fraction of a voxel. A view in whose frame a point does not fall has no opinion about that point.

Source: Laurentini, The visual hull concept for silhouette-based image understanding (1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.transforms import inverse_rigid, matrix, project, undistort

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
S = TypeVar("S", bound=np.generic)

BAND_CELLS = 2.0  # `level` is exact within this many cells of the hull's surface and clamped beyond
CHUNK = 1 << 15  # points projected at a time: their temporaries stay in the processor's cache
MAX_VOXELS = 512**3


@dataclass(frozen=True, slots=True)
class Hull:
    """Voxels indexed [ix, iy, iz], centres at lo + (i + 0.5) * cell, asset coordinates.

    occupied: (X, Y, Z), conservative: level <= half a cell, so that parts thinner than a voxel stay.
    level: (X, Y, Z) asset units, negative inside, clamped to +-BAND_CELLS * cell; its zero set is the unbiased surface.
    seen: (X, Y, Z) number of views that saw the voxel (until it was carved).
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
        """(N, 3) centres of the voxels where a (X, Y, Z) mask holds."""
        out: F64 = self.lo + (np.argwhere(where) + 0.5) * self.cell
        return out


@dataclass(frozen=True, slots=True)
class _Silhouette:
    """A view made ready for lookups. distance: (h, w) signed pixels of the photo, on a grid of size / (sx, sy)."""

    K: F64
    cam_from_world: F64
    distortion: F64
    focal: float
    width: int
    height: int
    radius: float  # on the z = 1 plane; beyond it the lens polynomial may fold back into the frame
    distance: F32


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
) -> Hull:
    """Carve the box [lo, hi] with silhouettes.

    Args:
        cameras, alphas: the voting views; an alpha (H, W) may have any size, it spans the camera's whole frame.
        lo, hi: (3,) corners, asset units; the grid covers at least the box.
        cell: voxel edge, asset units.
        min_views: voxels that fewer views see are empty.
        max_outside: how many views may call a voxel background before it is carved (0: the plain hull).

    Raises:
        StageError: no views, an empty box, or too many voxels.
    """
    lo, hi = np.asarray(lo, np.float64), np.asarray(hi, np.float64)
    shape = _grid_shape(lo, hi, cell, len(cameras), len(alphas))
    views = [_silhouette(c, a, 0.5 * (lo + hi), cell) for c, a in zip(cameras, alphas, strict=True)]
    band = BAND_CELLS * cell
    coarsest = 4 if min(shape) >= 16 else 1
    level: F32 = np.zeros(tuple(-(-n // coarsest) for n in shape), np.float32)
    seen = np.zeros(level.shape, np.int16)
    open_ = np.ones(level.shape, bool)
    factor = coarsest
    while True:
        index = np.argwhere(open_)
        points = lo + (index + 0.5) * (cell * factor)
        # 1.2: depth varies inside a coarse cell and lenses stretch, so the Lipschitz constant is a little above 1
        reach = 0.0 if factor == 1 else 1.2 * np.sqrt(3) / 2 * cell * factor
        found, count, settled = _consult(views, points, reach, band, min_views, max_outside)
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
    views: list[_Silhouette], points: F64, reach: float, band: float, min_views: int, max_outside: int
) -> tuple[F32, npt.NDArray[np.int16], Bool]:
    """Level (N,) clamped to the band, views that saw it (N,), and whether it holds for everything within `reach`."""
    parts = [
        _consult_chunk(views, points[i : i + CHUNK], reach, band, min_views, max_outside)
        for i in range(0, len(points), CHUNK)
    ]
    if not parts:
        return np.zeros(0, np.float32), np.zeros(0, np.int16), np.zeros(0, bool)
    level, seen, settled = (np.concatenate(p) for p in zip(*parts, strict=True))
    return level, seen, settled


def _consult_chunk(
    views: list[_Silhouette], points: F64, reach: float, band: float, min_views: int, max_outside: int
) -> tuple[F32, npt.NDArray[np.int16], Bool]:
    n, far = len(points), reach + band
    # largest levels first, over the views that see the whole neighbourhood and over those that may see some of it
    sure = np.full((max_outside + 1, n), -np.inf, np.float32)
    maybe = sure.copy() if reach else sure
    seen, glimpsed = np.zeros(n, np.int16), np.zeros(n, np.int16)
    live = np.arange(n)
    for i, view in enumerate(views):
        value, whole, part = _outside(view, points[live], reach)
        seen[live] += whole
        glimpsed[live] += part
        _insert(sure, live, np.where(whole, value, -np.inf))
        if reach:
            _insert(maybe, live, np.where(part, value, -np.inf))
        if i % 4 == 3:  # carved for good: no other view can bring it back
            live = live[sure[-1, live] <= far]
    carved = sure[-1] > far
    unseen = (glimpsed < min_views) & ~carved
    inside = (maybe[-1] < -far) & (seen >= min_views)
    level = np.where(unseen, band, sure[-1].clip(-band, band)).astype(np.float32)
    return level, seen, carved | unseen | inside


def _insert(top: F32, at: npt.NDArray[np.intp], value: npt.NDArray[np.floating]) -> None:
    """Keep rows of `top` sorted downwards while `value` goes in and the smallest falls out."""
    value = value.astype(np.float32)
    for row in top:
        old = row[at]
        row[at] = np.maximum(old, value)
        value = np.minimum(old, value)


# ------------------------------------------------------------------ one view
def _silhouette(camera: Camera, alpha: F32, about: F64, cell: float) -> _Silhouette:
    """Signed distances of one view, on a grid no finer than the voxels can use (a third of their footprint)."""
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
    return _Silhouette(
        K,
        cam_from_world,
        d,
        focal,
        camera.width,
        camera.height,
        _lens_radius(camera),
        signed_pixels(small) * np.float32(scale),
    )


def _lens_radius(camera: Camera) -> float:
    """Radius on the z = 1 plane that holds the whole frame, with a little room."""
    K, w, h = matrix(camera.K), camera.width, camera.height
    edge = np.array([(x, y) for x in (0, w / 2, w) for y in (0, h / 2, h)], np.float64)
    flat = np.asarray(np.linalg.solve(K[:2, :2], (edge - K[:2, 2]).T).T, np.float64)
    xy = undistort(flat, np.array(camera.distortion, np.float64))
    return 1.1 * float(np.linalg.norm(xy, axis=1).max())


def signed_pixels(alpha: F32) -> F32:
    """(H, W) distance to the contour alpha = 0.5 in pixels, negative inside the subject.

    From the nearest pixel on the other side, moved by that pixel's own alpha: one of 0.9 has the contour 0.4 pixels
    beyond its centre. Without any pixel on the other side the distance is the image's diagonal.
    """
    import cv2

    inside = alpha >= 0.5
    diagonal = float(np.hypot(*alpha.shape))
    if inside.all() or not inside.any():
        return np.full(alpha.shape, -diagonal if inside.all() else diagonal, np.float32)
    sides = []
    for other in (inside, ~inside):
        distance, label = cv2.distanceTransformWithLabels(
            np.where(other, 0, 1).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        alpha_of = np.zeros(int(label.max()) + 1, np.float32)
        alpha_of[label[other]] = alpha[other]
        sides.append(distance - np.abs(alpha_of[label] - 0.5))
    return np.asarray(np.where(inside, -np.maximum(sides[1], 0), np.maximum(sides[0], 0)), np.float32)


def _outside(view: _Silhouette, points: F64, reach: float) -> tuple[F32, Bool, Bool]:
    """How far points are outside the silhouette (N,), asset units; sees all within reach?; sees any of it?"""
    uv, z = project(view.K, view.cam_from_world, view.distortion, points)
    front = z > 1e-9
    uv = np.where(front[:, None], uv, -1e9)
    z = np.where(front, z, 1.0)
    if np.any(view.distortion):
        flat = points @ view.cam_from_world[:2, :3].T + view.cam_from_world[:2, 3]
        front &= np.hypot(flat[:, 0], flat[:, 1]) < view.radius * z + reach
    margin = reach * view.focal / z
    left = np.minimum(uv, np.array([view.width, view.height]) - uv).min(1)  # distance to the nearest edge of the frame
    value = _lookup(view.distance, uv / (view.width, view.height)) * (z / view.focal)
    return value.astype(np.float32), front & (left >= margin), front & (left > -margin if reach else left >= 0)


def _lookup(image: F32, at: F64) -> F32:
    """Bilinear values of (H, W) at (N, 2) positions in [0, 1] across and down, clamped to the outermost pixels."""
    h, w = image.shape
    x = (at[:, 0] * w - 0.5).clip(0, w - 1.001)
    y = (at[:, 1] * h - 0.5).clip(0, h - 1.001)
    c, r = x.astype(np.int32), y.astype(np.int32)
    fx, fy = (x - c).astype(np.float32), (y - r).astype(np.float32)
    flat, k = image.ravel(), r * w + c
    top = flat[k] * (1 - fx) + flat[k + 1] * fx
    return np.asarray(top * (1 - fy) + (flat[k + w] * (1 - fx) + flat[k + w + 1] * fx) * fy, np.float32)


# ------------------------------------------------------------------ what is done with a hull
def hull_bounds(
    cameras: Sequence[Camera],
    alphas: Sequence[F32],
    roi_radius: float,
    *,
    cells: int = 64,
    margin: float = 0.05,
    min_views: int = 3,
    max_outside: int = 0,
) -> tuple[F64, F64]:
    """(3,) lower and upper corner of the subject's largest piece in the cube of half-edge 1.6 * roi_radius.

    `margin` is added on every side, as a fraction of the longest edge; the box stays inside the cube.

    Raises:
        StageError: nothing is left of the subject.
    """
    edge = 1.6 * roi_radius
    hull = visual_hull(
        cameras, alphas, [-edge] * 3, [edge] * 3, 2 * edge / cells, min_views=min_views, max_outside=max_outside
    )
    body = largest_piece(hull.occupied)
    if not body.any():
        raise StageError(
            "no part of space is inside all silhouettes",
            where="visual hull",
            value="empty",
            limit=f"a body that at least {min_views} views see",
            remedy="check the masks (is the subject white?), the poses, and the region of interest",
        )
    index = np.argwhere(body)
    lo, hi = hull.lo + index.min(0) * hull.cell, hull.lo + (index.max(0) + 1) * hull.cell
    room = margin * float((hi - lo).max())
    return np.maximum(lo - room, -edge), np.minimum(hi + room, edge)


def largest_piece(occupied: Bool) -> Bool:
    """The largest 6-connected piece of a voxel mask."""
    label, count = ndimage.label(occupied)
    if count <= 1:
        return occupied.copy()
    sizes = np.bincount(label.ravel())
    sizes[0] = 0
    return np.asarray(label == sizes.argmax())


def hull_sdf(hull: Hull) -> F32:
    """(X, Y, Z) signed distance at voxel centres, asset units, negative inside.

    Near the surface it is `level` (sub-voxel); farther away the distance to the nearest voxel of that band plus the
    level there. An empty hull is positive everywhere (the grid's diagonal), a full one negative.
    """
    inside = hull.level <= 0
    diagonal = float(np.linalg.norm(hull.hi - hull.lo))
    if inside.all() or not inside.any():
        return np.full(inside.shape, -diagonal if inside.all() else diagonal, np.float32)
    out = np.zeros(inside.shape, np.float32)
    for side, sign in ((~inside, 1.0), (inside, -1.0)):
        edge = side & ndimage.binary_dilation(~side)  # voxels with a face on the surface
        far, nearest = ndimage.distance_transform_edt(~edge, sampling=hull.cell, return_indices=True)
        # a band clamped by a cut through unseen space says nothing about the surface: half a cell is the best guess
        near = np.abs(hull.level[tuple(nearest)])
        near = np.where(near < 1.5 * hull.cell, near, 0.5 * hull.cell)
        out[side] = sign * (far + near)[side]
    return out


def surface_points(hull: Hull) -> F64:
    """(N, 3) points on the hull's surface: where `level` changes sign between neighbouring voxels, interpolated."""
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


def render_silhouette(hull: Hull, camera: Camera, height: int, width: int) -> F32:
    """(height, width) soft silhouette in [0, 1] of the hull in the camera's whole frame, distortion included.

    Points on the surface and inside voxels are projected and the gaps between them closed. A closing leaves the
    outermost points where they are, so the outline is right to about a tenth of a voxel's footprint.
    """
    import cv2

    points = np.concatenate([surface_points(hull), hull.centres(hull.level <= 0)])
    K, d = matrix(camera.K), np.array(camera.distortion, np.float64)
    cam_from_world = inverse_rigid(matrix(camera.world_from_cam))
    uv, z = project(K, cam_from_world, d, points)
    good = z > 1e-9
    if np.any(d):
        flat = points @ cam_from_world[:2, :3].T + cam_from_world[:2, 3]
        good &= np.hypot(flat[:, 0], flat[:, 1]) < _lens_radius(camera) * np.where(good, z, 0)
    if not good.any():
        return np.zeros((height, width), np.float32)
    footprint = hull.cell * np.sqrt(K[0, 0] * K[1, 1]) / float(np.median(z[good]))
    factor = float(np.clip(4.0 / footprint, 256 / max(camera.width, camera.height), 1.0))  # about 4 pixels a voxel
    w, h = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
    radius = int(np.ceil(1.2 * footprint * factor)) + 1
    pad = 2 * radius + 1
    at = np.floor(uv[good] * (w / camera.width, h / camera.height)).astype(np.int64) + pad
    at = at[(at >= 0).all(1) & (at[:, 0] < w + 2 * pad) & (at[:, 1] < h + 2 * pad)]
    canvas = np.zeros((h + 2 * pad, w + 2 * pad), np.uint8)
    canvas[at[:, 1], at[:, 0]] = 255
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    canvas = np.asarray(cv2.morphologyEx(canvas, cv2.MORPH_CLOSE, disc), np.uint8)[pad : pad + h, pad : pad + w]
    smooth = np.ascontiguousarray(canvas.astype(np.float32) / 255)
    mode = cv2.INTER_AREA if width <= w else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(smooth, (width, height), interpolation=mode), np.float32)
