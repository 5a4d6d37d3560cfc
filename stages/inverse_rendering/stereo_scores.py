"""How well a start shows validation views: the photos of their neighbours, projected by its surface.

Photos of the neighbours are projected onto a start's surface and from there into a validation view, where windows of
both are compared by normalised cross-correlation, which does not depend on exposure. A pixel that no neighbour sees
scores 0, so that a surface cannot win by hiding what it shows wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.fields.geometry import GridSdf
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering.dense_stereo import Ints, Pictures, neighbours_of, pair, pictures_of, pixel_rays
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
SIDE = 240  # pixels of the subject's longest side in the comparison
WINDOW = 9  # pixels
COMPARED = 4  # neighbours of each validation view
HIDDEN = 0.02  # share of the depth by which a point may lie behind the surface that a neighbour sees


@dataclass(frozen=True, slots=True)
class Validation:
    """What starts are compared on. positions: of the validation views among all views; neighbours: of each view;
    pictures and poses (V, 4, 4): of all views."""

    positions: tuple[int, ...]
    neighbours: list[Ints]
    pictures: Pictures
    poses: F64


@dataclass(frozen=True, slots=True)
class Shown:
    """A validation view as a start shows it. view: its position; score (H, W): correlation, 0 outside of the subject;
    inverse (H, W): inverse depths of the start's surface, 0 where rays miss it."""

    view: int
    score: F32
    inverse: F32


def validation_of(hull: Start, views: list[PhotoView], positions: tuple[int, ...]) -> Validation:
    """The validation views at some positions."""
    poses = np.stack([v.world_from_cam for v in views])
    return Validation(positions, neighbours_of(hull, views, positions), pictures_of(views, None, SIDE), poses)


def shown_by(start: Start, views: Validation, check: Callable[[], None] = lambda: None) -> list[Shown]:
    """The validation views that have neighbours, as the start shows them: each pixel's score is the mean of the better
    half of the neighbours."""
    surface, pictures = start.surface("cpu"), views.pictures
    seen: dict[int, F32] = {}

    def depths(i: int) -> F32:
        if i not in seen:
            check()
            seen[i] = inverse_depths(surface, pictures.K[i], views.poses[i], pictures.usable[i])
        return seen[i]

    found = []
    for i in views.positions:
        others = views.neighbours[i][:COMPARED]
        if not len(others):
            continue
        a, b = pair(pictures.K, views.poses, i, others)
        there = [projected(depths(i), depths(int(k)), pictures.grey[k], a[n], b[n]) for n, k in enumerate(others)]
        mask = pictures.usable[i]
        scores = np.sort([windowed(pictures.grey[i], s, mask, pictures.noise) for s in there], 0)
        found.append(Shown(i, scores[-max(len(others) // 2, 1) :].mean(0), depths(i)))
    return found


def mean_score(shown: list[Shown], views: Validation) -> float:
    """Mean over the subject's pixels; 0 if there are none."""
    masks = [views.pictures.usable[s.view] for s in shown]
    total = sum(float(s.score[m].sum()) for s, m in zip(shown, masks, strict=True))
    return total / max(sum(int(m.sum()) for m in masks), 1)


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
