"""What a start must not lose, because silhouettes show it: hair beyond the template's space, the tip of a nose.

Depth maps, fused on a coarse grid, end short of what is thin and pointed. Where they leave a ray of a silhouette empty
although the hull does not, the place on that ray that is nearest to their surface is kept (`start_with_silhouettes`).

Long hair, a hat or headphones stand further out of the template than is allowed. The space that a person with a placed
head can fill (pipeline.registration.carve) is a guess. Where it leaves a ray of a silhouette empty although the hull
does not, the guess is wrong, and a place on that ray is kept: within the hull, near the template, rather beside or
behind it than in front, because hair hangs there. Stereo and the fit move it.

Symbols: S the signed bound of the possible space, negative inside; u metres ahead of the head, along the direction that
the face looks to; p the point of a lost ray within the hull at which S + BEHIND u is least, and the points at which it
is at most `thick` larger while S is not: the least jumps from ray to ray, and one point on each made rags of hair that
hangs beside a face. The bound becomes min(S, |x - p| - radius) over all p, smoothed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.fields.geometry import GridSdf
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering.dense_stereo import pixel_rays
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import WHOLE, PhotoView, evenly_spaced
from stages.inverse_rendering.signed_distance import distances
from stages.inverse_rendering.stereo import reduced

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
BEHIND = 0.5  # metres from the template that count like a metre further to the front
BLUR = 0.7  # cells; smoothing of what is kept, because every view has its own p


@dataclass(frozen=True, slots=True)
class Detail:
    """views: silhouettes, evenly spaced over all; side: pixels of their longest side; border: pixels inside of their
    outlines that need not be kept, because the hull itself is uncertain there; radius: cells that are kept around p."""

    views: int
    side: int
    border: int
    radius: float


HAIR = Detail(32, 160, 2, 1.5)
POINTED = Detail(48, 320, 0, 1.25)


def bound_with_silhouettes(
    hull: Start,
    bound: F32,
    front: F64,
    views: list[PhotoView],
    check: Callable[[], None] = lambda: None,
    detail: Detail = HAIR,
    thick: float = 0.0,
) -> F32:
    """The bound S (X, Y, Z) on the hull's grid, widened where it would empty rays of the silhouettes. front (3,): unit
    direction that the face looks to; zero where no direction is better. thick: world units of S + BEHIND u."""
    cut = Start(distances(np.maximum(hull.values, bound), hull.lo, hull.cell), hull.lo, hull.cell)
    whole, left = hull.surface("cpu"), cut.surface("cpu")
    free = np.ones(bound.shape, bool)
    axes = [BEHIND * hull.cell * f * np.arange(n) for f, n in zip(front, bound.shape, strict=True)]
    cost = bound + axes[0][:, None, None] + axes[1][None, :, None] + axes[2][None, None, :]
    for i in evenly_spaced(len(views), min(detail.views, len(views))):
        check()
        points = _lost(whole, left, hull, bound, cost, views[i], detail, thick)
        free[tuple(np.rint((points - hull.lo) / hull.cell).astype(np.intp).T)] = False
    if free.all():
        return bound
    near = ndimage.gaussian_filter(ndimage.distance_transform_edt(free), BLUR) - detail.radius
    return np.asarray(np.minimum(bound, near * hull.cell), np.float32)


def start_with_silhouettes(
    hull: Start, start: Start, views: list[PhotoView], check: Callable[[], None] = lambda: None
) -> Start:
    """A start on the hull's grid, with the places that it must have to fill the silhouettes that the hull fills."""
    kept = bound_with_silhouettes(hull, start.values, np.zeros(3), views, check, POINTED)
    if kept is start.values:
        return start
    return Start(distances(np.maximum(kept, hull.values), hull.lo, hull.cell), hull.lo, hull.cell)


def _lost(
    whole: GridSdf, left: GridSdf, hull: Start, bound: F32, cost: F64, view: PhotoView, detail: Detail, thick: float
) -> F64:  # fmt: skip
    """Points (N, 3) in the hull, on the rays of a view that meet `whole` but not `left`, at which `cost` is least on
    the ray, or exceeds that by at most `thick` with no larger `bound`."""
    K, shown = _silhouette(view, detail)
    rows, columns = np.nonzero(shown)
    o, d, _ = pixel_rays(K, view.world_from_cam, rows, columns)
    near, far = box_interval(o, d, *left.box())
    lost = ~left.trace(o, d, near, far)[1]
    o, d, near, far = (x[lost].contiguous() for x in (o, d, near, far))
    t, hit, _ = whole.trace(o, d, near, far)
    origin, direction, first, last = (x[hit].double().numpy() for x in (o, d, t, far))
    steps = np.arange(0.0, float((last - first).max(initial=0.0)), 0.5 * hull.cell)

    def on_rays(at: float) -> tuple[F64, F64, F64]:
        x = origin + (first + at)[:, None] * direction
        node = ((x - hull.lo) / hull.cell).T
        inside = (first + at < last) & (ndimage.map_coordinates(hull.values, node, order=1, mode="nearest") < 0)
        value, off = (ndimage.map_coordinates(g, node, order=1, mode="nearest") for g in (cost, bound))
        return x, np.where(inside, value, np.inf), off

    least, away, place = np.full(len(first), np.inf), np.zeros(len(first)), np.zeros((len(first), 3))
    for at in steps:
        x, value, off = on_rays(at)
        better = value < least
        least[better], away[better], place[better] = value[better], off[better], x[better]
    if not thick:
        return np.asarray(place[np.isfinite(least)])
    kept = [np.zeros((0, 3))]
    for at in steps:
        x, value, off = on_rays(at)
        kept.append(x[np.isfinite(value) & (value <= least + thick) & (off <= away)])
    return np.concatenate(kept)


def _silhouette(view: PhotoView, detail: Detail) -> tuple[F64, Bool]:
    """K and (h, w) certain pixels of the subject within its extent, without distortion."""
    K, small = reduced(view, detail.side)
    certain = view.alpha.astype(np.float32)
    if view.asked is not None:
        certain = certain * (view.asked > WHOLE)
    if view.doubtful is not None:
        certain = certain * ~view.doubtful
    full = (small(certain) > WHOLE).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * detail.border + 1,) * 2)
    return K, np.asarray(cv2.erode(full, disc, borderValue=1)) > 0
