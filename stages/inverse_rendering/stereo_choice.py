"""Which of several starts shows the photos best? Decided before the fit, on validation views.

Photos of the neighbours are projected onto a candidate's surface and from there into a validation view, where windows
of both are compared by normalised cross-correlation, which does not depend on exposure. A pixel that no neighbour sees
scores 0, so that a surface cannot win by hiding what it shows wrong. Depth maps are fused without the validation
views for this comparison.

Depth maps take most of the time, and where the sweep is right they are not used. So small ones are compared first.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.fields.geometry import GridSdf
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering.dense_stereo import (
    DepthMaps,
    Ints,
    Pictures,
    depth_maps,
    neighbours_of,
    pair,
    pictures_of,
    pixel_rays,
)
from stages.inverse_rendering.depth_fusion import fused
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView, evenly_spaced
from stages.inverse_rendering.stereo import SWEEPS, Sweep, start_from_photos

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Facts = dict[str, str | float | bool]
log = logging.getLogger("neuface.inverse_rendering")
SIDE = 240  # pixels of the subject's longest side in the comparison
WINDOW = 9  # pixels
COMPARED = 4  # neighbours of each validation view
VALIDATION, MIN_VIEWS = 6, 8  # validation views; with fewer views than MIN_VIEWS there is no choice: the sweep
HIDDEN = 0.02  # share of the depth by which a point may lie behind the surface that a neighbour sees
GAIN = (
    0.01  # by how much the mean correlation of dense stereo must be higher: below, the sweep's finer steps are better
)


QUICK, FINER = 0.6, 0.015  # scale of the small depth maps; by how much the whole ones may be better (docs/model.md)


def stereo_start(
    hull: Start,
    views: list[PhotoView],
    kind: str,
    device: str,
    check: Callable[[], None] = lambda: None,
    sweeps: tuple[Sweep, ...] = SWEEPS,
) -> tuple[Start, Facts]:
    """The start from stereo, and the figures of the choice. kind: auto, sweep or dense. sweeps: those of the sweep.

    The sweep has read the validation views, too, so that the comparison favours it a little.
    """
    if kind == "sweep" or (kind == "auto" and len(views) < MIN_VIEWS):
        why = "setting" if kind == "sweep" else f"fewer than {MIN_VIEWS} views"
        return start_from_photos(hull, views, device, check, sweeps), {"start": "sweep", "why": why}

    def dense_start(maps: DepthMaps, seen: list[PhotoView]) -> Start:
        """The fused surface; the short sweeps along its normals, which are right by now, add what fusion smoothed."""
        return start_from_photos(fused(hull, maps, check), seen, device, check, SWEEPS[1:])

    if kind == "dense":
        return dense_start(depth_maps(hull, views, check), views), {"start": "dense", "why": "setting"}
    waiting = validation_views(len(views))
    seen = [v for n, v in enumerate(views) if n not in waiting]
    known = pictures_of(views, None, SIDE)
    neighbours = neighbours_of(hull, views, waiting)
    poses = np.stack([v.world_from_cam for v in views])

    def score(start: Start) -> float:
        return correlation(start, known, poses, waiting, neighbours, check)

    def dense_score(maps: DepthMaps) -> float:
        return score(dense_start(without(maps, waiting), seen))

    start = start_from_photos(hull, views, device, check, sweeps)
    swept = score(start)
    least = swept + GAIN
    found, sized, name = dense_score(depth_maps(hull, views, check, waiting, QUICK)), "small ", "sweep"
    maps = depth_maps(hull, views, check, waiting) if found > least - FINER else None
    if maps is not None and found <= least:
        found, sized = dense_score(maps), ""
    if maps is not None and found > least:
        start, name = dense_start(maps, views), "dense"
    facts: Facts = {"start": name, "sweep_correlation": round(swept, 4), "dense_correlation": round(found, 4)}
    log.info("start from stereo: %s", facts)
    return start, {**facts, "why": f"correlation of the {sized}photos on validation views"}


def validation_views(views: int) -> tuple[int, ...]:
    """Positions of the validation views, evenly spaced."""
    return evenly_spaced(views, min(VALIDATION, views // 4))


def without(maps: DepthMaps, left_out: tuple[int, ...]) -> DepthMaps:
    """The same maps, some of which get no vote."""
    weight = maps.weight.copy()
    weight[list(left_out)] = 0
    return replace(maps, weight=weight)


def correlation(
    start: Start,
    pictures: Pictures,
    poses: F64,
    waiting: tuple[int, ...],
    neighbours: list[Ints],
    check: Callable[[], None] = lambda: None,
) -> float:
    """Mean over the subject's pixels of the validation views of the correlation with the photos of their neighbours,
    projected by the surface; 0 if there are no such pixels."""
    surface = start.surface("cpu")
    seen: dict[int, F32] = {}

    def depths(i: int) -> F32:
        if i not in seen:
            check()
            seen[i] = inverse_depths(surface, pictures.K[i], poses[i], pictures.usable[i])
        return seen[i]

    total, count = 0.0, 0
    for i in waiting:
        others = neighbours[i][:COMPARED]
        if not len(others):
            continue
        a, b = pair(pictures.K, poses, i, others)
        shown = [projected(depths(i), depths(int(k)), pictures.grey[k], a[n], b[n]) for n, k in enumerate(others)]
        mask = pictures.usable[i]
        scores = np.sort([windowed(pictures.grey[i], s, mask, pictures.noise) for s in shown], 0)
        best = scores[-max(len(others) // 2, 1) :].mean(0)
        total, count = total + float(best[mask].sum()), count + int(mask.sum())
    return total / max(count, 1)


def inverse_depths(surface: GridSdf, K: F64, world_from_cam: F64, mask: Bool) -> F32:
    """(H, W) inverse depths of the surface at a mask's pixels, 0 where rays miss it and outside."""
    rows, columns = np.nonzero(mask)
    out = np.zeros(mask.shape, np.float32)
    if not len(rows):
        return out
    o, d, length = pixel_rays(K, world_from_cam, rows, columns)
    t, hit, _ = surface.trace(o, d, *box_interval(o, d, *surface.box()))
    out[rows, columns] = np.where(hit.numpy(), length / np.maximum(t.numpy(), 1e-9), 0)
    return out


def projected(inverse: F32, there: F32, grey: F32, a: F64, b: F64) -> F32:
    """(H, W) a neighbour's photo as seen through the surface by a view; NaN where the neighbour does not see it.

    inverse, there: (H, W) inverse depths of the surface in the view and in the neighbour, 0 where it is missed.
    """
    h, w = inverse.shape
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    q = a @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1) + b[:, None] * inverse.ravel()
    z = np.where(q[2] > 1e-9, q[2], np.nan)
    x, y = ((q[k] / z - 0.5).reshape(h, w).astype(np.float32) for k in (0, 1))
    x, y = (np.where((inverse > 0) & np.isfinite(p), p, -10).astype(np.float32) for p in (x, y))
    shown, first = (
        np.asarray(cv2.remap(g, x, y, mode, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")), np.float32)
        for g, mode in ((grey, cv2.INTER_LINEAR), (there, cv2.INTER_NEAREST))
    )
    visible = (inverse.ravel() / z).reshape(h, w) > (1 - HIDDEN) * first
    return np.where(visible & (first > 0), shown, np.nan).astype(np.float32)


def windowed(one: F32, two: F32, mask: Bool, floor: float) -> F32:
    """(H, W) normalised cross-correlation of two pictures in windows; 0 where `two` is NaN and outside the mask.

    floor: standard deviation of the noise.
    """
    both = mask & np.isfinite(two) & np.isfinite(one)
    a, b = (np.where(both, p, 0).astype(np.float64) for p in (one, two))
    n, sa, sb, saa, sbb, sab = (_sums(x) for x in (both.astype(np.float64), a, b, a * a, b * b, a * b))
    n = np.maximum(n, 1)
    flat = floor * np.sqrt(n)
    lengths = [np.sqrt(np.maximum(ss - s * s / n, 0)) + flat for s, ss in ((sa, saa), (sb, sbb))]
    return np.where(both, (sab - sa * sb / n) / (lengths[0] * lengths[1]), 0).astype(np.float32)


def _sums(x: F64) -> F64:
    return np.asarray(cv2.boxFilter(x, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT))
