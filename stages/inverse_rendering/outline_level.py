"""The level of the fitted SDF whose outline is that of the photos' masks.

The fit sees an outline through a renderer whose surface is soft: its zero set ends up to a fifth of a pixel inside of
the masks. For pictures of the model that is nothing. A mesh of the zero set is too small all around, and there the
background is seen through it.

Symbols: d the SDF; m of a ray the least d along it, so that the surface d = l covers the ray where m <= l; a the share
of a tile's rays that the mask covers. The tile's level is the a-quantile of its m: at that level as many of its rays
are covered by the surface as by the mask. The median over the photos of the median over their tiles, x with standard
deviation s, is drawn to 0 as far as it may be chance: l = x max(0, 1 - s^2 / x^2). Tiles where the outline is
elsewhere, or where the mask is wrong, are in the tails of the medians.

Source: James and Stein, Estimation with quadratic loss (1961), for the factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf
from pipeline.maths.tracing import box_interval
from pipeline.meshes import F64, Indices, Mask
from pipeline.silhouettes import signed_pixels
from stages.inverse_rendering.dense_stereo import rays_at
from stages.inverse_rendering.ray_sampling import F32, PhotoView, evenly_spaced
from stages.inverse_rendering.stereo import reduced

SIDE, VIEWS = 512, 24  # pixels of a silhouette's longest side; photos, evenly spaced over the views
BAND = 2.0  # pixels on either side of the outline in which rays are cast, one a pixel
BORDER = 4  # pixels from the frame's border, and from what does not count
TILE, LEAST_RAYS = 16, 30  # pixels of a tile's side; rays in it
SHARE = 0.2  # of a tile's rays, least on either side of the outline
DEPTH, MOST = 0.5, 0.5  # cells: depth down to which m is known, and largest level
LEAST_VIEWS = 3
MEDIAN_DEVIATION = 1.4826 * np.sqrt(np.pi / 2)  # standard deviation of a median, of the median deviation over sqrt(n)


@dataclass(frozen=True, slots=True)
class OutlineLevel:
    """level: asset units, outward positive; found: before it was drawn to 0; deviation: of that; views, tiles: how many
    told it."""

    level: float
    found: float
    deviation: float
    views: int
    tiles: int

    def facts(self) -> dict[str, str | float | bool]:
        """For the report."""
        return {
            "level_mm": round(1e3 * self.level, 4),
            "found_mm": round(1e3 * self.found, 4),
            "deviation_mm": round(1e3 * self.deviation, 4),
            "views": float(self.views),
            "why": f"outlines of {self.tiles} places in {self.views} photos",
        }


def set_outline_level(model: FaceModel, views: Sequence[PhotoView]) -> dict[str, str | float | bool]:
    """Set the model's level; returns the facts for the report. The paper's geometries keep their zero set."""
    if not isinstance(model.geometry, GridSdf):
        return {"level_mm": 0.0, "why": "only for the grid"}
    found = outline_level(model.geometry.on_cpu(), views)
    model.level.fill_(found.level)
    return found.facts()


def outline_level(surface: GridSdf, views: Sequence[PhotoView]) -> OutlineLevel:
    """The level at which the surface covers as much of the photos as their masks; 0 if fewer than three show an
    outline."""
    random, of_view, tiles = np.random.default_rng(0), [], 0
    for i in evenly_spaced(len(views), min(VIEWS, len(views))):
        found = _levels(surface, views[i], random)
        tiles += len(found)
        of_view += [float(np.median(found))] if len(found) else []
    if len(of_view) < LEAST_VIEWS:
        return OutlineLevel(0.0, 0.0, 0.0, len(of_view), tiles)
    middle = float(np.median(of_view))
    deviation = float(MEDIAN_DEVIATION * np.median(np.abs(np.array(of_view) - middle)) / np.sqrt(len(of_view)))
    most = MOST * surface.cell
    level = float(np.clip(drawn(middle, deviation), -most, most))
    return OutlineLevel(level, middle, deviation, len(of_view), tiles)


def drawn(found: float, deviation: float) -> float:
    """What was found, drawn to 0 as far as its standard deviation says that it may be chance."""
    return found * max(0.0, 1 - (deviation / found) ** 2) if found else 0.0


def _levels(surface: GridSdf, view: PhotoView, random: np.random.Generator) -> F64:
    """(T,) levels of one photo's tiles."""
    K, alpha, use = _band(view)
    rows, columns = np.nonzero(use)
    if not len(rows):
        return np.zeros(0)
    at = np.stack([columns, rows], 1) + random.random((len(rows), 2))
    least = _least(surface, K, view.world_from_cam, at)
    across = -(-alpha.shape[1] // TILE)
    return _of_tiles(rows // TILE * across + columns // TILE, least, alpha[rows, columns].astype(np.float64))


def _of_tiles(tile: Indices, least: F64, alpha: F64) -> F64:
    """(T,) levels of the tiles that show both sides. tile (N,): number of each ray's; least (N,): m; alpha (N,)."""
    out = []
    order = np.argsort(tile, kind="stable")
    starts = np.flatnonzero(np.diff(tile[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        share = float(alpha[rows].mean())
        if len(rows) >= LEAST_RAYS and SHARE <= share <= 1 - SHARE:
            out.append(float(np.quantile(least[rows], share)))
    return np.array(out)


def _band(view: PhotoView) -> tuple[F64, F32, Mask]:
    """K, (h, w) alpha without distortion, and the pixels near the outline that count."""
    K, small = reduced(view, SIDE)
    alpha = small(view.alpha)
    wrong = np.zeros_like(alpha)
    if view.asked is not None:
        wrong = np.maximum(wrong, 1 - small(view.asked))
    if view.doubtful is not None:
        wrong = np.maximum(wrong, small(view.doubtful.astype(np.float32)))
    framed = np.pad((wrong > 0.01).astype(np.uint8), 1, constant_values=1)
    bad = np.asarray(cv2.dilate(framed, np.ones((2 * BORDER + 1,) * 2, np.uint8)))[1:-1, 1:-1] > 0
    return K, alpha, (np.abs(signed_pixels(alpha)) <= BAND) & ~bad


def _least(surface: GridSdf, K: F64, world_from_cam: F64, at: F64) -> F64:
    """(N,) the least SDF along the rays of places at (N, 2) in pixels, asset units; not below -DEPTH cells."""
    o, direction, _ = rays_at(K, world_from_cam, at)
    near, far = box_interval(o, direction, *surface.box())
    depth = DEPTH * surface.cell
    _, hit, closest = surface.trace(o, direction, near, far, depth)  # a ray that misses it tells how nearly
    return np.where(hit.numpy(), -depth, closest.numpy().astype(np.float64) - depth)
