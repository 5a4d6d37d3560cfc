"""Consistency of the masks: each is compared with the visual hull of all masks.

The hull is carved by the voting views and tolerates a few wrong views. Where a mask and the hull's silhouette differ by
more than the hull's resolution, the mask (or the camera) is wrong.

A hull is an upper limit of the subject, so that a mask may rightly lack what the hull has. Not so deep inside: a ray
through the core of a hull, which views from around the subject carved, meets the subject. The core is carved with more
tolerance, because the same part often lacks in several masks: where its colour is that of the background. What a mask
lacks of it is the subject's only if the other views say so (pipeline.hull_needs): beside shoulders that leave most
frames a hull is deep where there is nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import cv2
import numpy as np
from scipy import ndimage

from pipeline.artifacts import Camera
from pipeline.directions import from_around
from pipeline.hull import BAND_CELLS, Cloud, Hull, cloud, render_silhouette, visual_hull
from pipeline.hull_needs import CUBE as CUBE
from pipeline.hull_needs import is_subject, regions, voxels_at
from pipeline.support import Support
from pipeline.transforms import matrix
from stages.masks.region import F32, Bool, dilated, eroded, region

POSSIBLE = 1.4  # radii within which empty space of the hull is trusted
MARGIN = 1.0  # cells of tolerance for the hull
WRONG_SHARE = 0.1  # share of the views of a voxel that may be wrong
CORE = 0.15  # depth of the core below the hull's surface, radii of the region of interest
CORE_SHARE, CORE_LEAST = 0.06, 2  # share and least number of the views that may be wrong about a voxel of the core
KNOWN = 0.5  # share of the views with a voxel of the core in their frame
NEED = 0.002  # of a mask: smallest region that it lacks of which is asked whether it is the subject
SPREADS = 6.0  # robust standard deviations below the median for an outlier


@dataclass(frozen=True, slots=True)
class Opinion:
    """The hull seen from one view, (h, w) at the size of its small alpha.

    silhouette: of the hull. core: of its core. possible: where the subject may be, including space that few views see.
    here: the region of interest. margin: tolerance in pixels. iou: of the view's mask and the silhouette within the
    region of interest, None if that is outside of the picture.
    """

    silhouette: Bool
    possible: Bool
    here: Bool
    margin: int
    iou: float | None
    core: Bool

    def at_size(self, width: int, height: int) -> Opinion:
        """The same for a picture of another size."""
        factor = width / self.silhouette.shape[1]

        def scaled(a: Bool) -> Bool:
            return np.asarray(cv2.resize(a.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)) >= 0.5

        margin = max(1, round(self.margin * factor))
        return Opinion(
            scaled(self.silhouette), scaled(self.possible), scaled(self.here), margin, self.iou, scaled(self.core)
        )


def tolerated(votes: int) -> int:
    """Number of voting views that may be wrong about a voxel."""
    return 0 if votes < 5 else max(1, votes // 40)


def opinions(
    cameras: Sequence[Camera], alphas: Sequence[F32], votes: Sequence[bool], roi_radius: float, cells: int,
    support: Support | None = None,
) -> list[Opinion]:  # fmt: skip
    """The hull seen from each view. alphas: (h, w) each, small. votes: which views carve the hull (not held-out and
    dropped ones). roi_radius: asset units. cells: voxels per edge. support: the subject is above this plane."""
    carving = list(compress(cameras, votes)), list(compress(alphas, votes))
    count = len(carving[0])
    lenient, edge = tolerated(count), CUBE * roi_radius
    cell = 2 * edge / cells
    sure, possible = (above(support, h) for h in (
        visual_hull(*carving, [-edge] * 3, [edge] * 3, cell,
                    min_views=least, max_outside=lenient, outside_share=WRONG_SHARE)
        for least in (min(3, count), 0)
    ))  # fmt: skip
    hull, may_be = cloud(sure), cloud(possible)
    inner = _core(*carving, edge, cell, support, CORE * roi_radius)
    out = []
    for camera, alpha in zip(cameras, alphas, strict=True):
        h, w = alpha.shape
        disc = region(camera, roi_radius)
        if disc is None:
            nowhere = np.zeros((h, w), bool)
            out.append(Opinion(nowhere, ~nowhere, nowhere, 1, None, nowhere))
            continue
        disc = disc.scaled(w / camera.width)
        silhouette = render_silhouette(hull, camera, h, w) >= 0.5
        may = (render_silhouette(may_be, camera, h, w) >= 0.5) | ~disc.covers(h, w, POSSIBLE)
        here = disc.covers(h, w)
        margin = max(1, round(MARGIN * disc.radius * cell / roi_radius))
        core = np.zeros((h, w), bool) if inner is None else render_silhouette(inner, camera, h, w) >= 0.5
        inside = alpha >= 0.5
        found = Opinion(silhouette, may, here, margin, _iou(inside, silhouette, here), core & silhouette)
        out.append(_without_empty(found, inside, camera, sure, carving))
    return out


def _without_empty(
    opinion: Opinion, inside: Bool, camera: Camera, hull: Hull, carving: tuple[list[Camera], list[F32]]
) -> Opinion:
    """The opinion with a core that does not have what the mask lacks and the other views do not show. carving: cameras
    and masks that carved the hull."""
    core = opinion.core
    for region_ in regions(_lacks(inside, opinion), NEED * inside.sum()):
        if not is_subject(hull, voxels_at(hull, camera, region_), *carving):
            core = core & ~dilated(region_, opinion.margin)
    return opinion if core is opinion.core else replace(opinion, core=core)


def _core(
    cameras: Sequence[Camera], alphas: Sequence[F32], edge: float, cell: float, support: Support | None, depth: float
) -> Cloud | None:
    """The part of the tolerant hull that is deeper than `depth` (asset units) and in the frame of most views; None if
    there is none, or if the cameras are on one side: the hull is then deep wherever no camera looks from the side."""
    centres = np.array([matrix(c.world_from_cam)[:3, 3] for c in cameras])
    if not from_around(centres):
        return None
    wrong = max(CORE_LEAST, round(CORE_SHARE * len(cameras)))
    hull = above(support, visual_hull(cameras, alphas, [-edge] * 3, [edge] * 3, cell, max_outside=wrong,
                                       outside_share=WRONG_SHARE))  # fmt: skip
    known = hull.seen >= KNOWN * len(cameras)
    level = (depth - cell * ndimage.distance_transform_edt((hull.level <= 0) & known)).astype(np.float32)
    if not (level <= 0).any():
        return None
    return cloud(replace(hull, level=level.clip(-BAND_CELLS * cell, BAND_CELLS * cell), occupied=level <= 0.5 * cell))


def above(support: Support | None, hull: Hull) -> Hull:
    """The part of a hull that is above the support."""
    if support is None:
        return hull
    centres = hull.centres(np.ones(hull.level.shape, bool)).reshape(*hull.level.shape, 3)
    beneath = np.asarray(support.offset - centres @ support.normal, np.float32)
    level = np.maximum(hull.level, beneath.clip(-BAND_CELLS * hull.cell, BAND_CELLS * hull.cell))
    return replace(hull, level=level, occupied=hull.occupied & (beneath <= 0.5 * hull.cell))


def _iou(a: Bool, b: Bool, where: Bool) -> float | None:
    union = int(((a | b) & where).sum())
    return float((a & b & where).sum() / union) if union else None


def contradiction(inside: Bool, opinion: Opinion, *, filled: bool) -> float:
    """Area that the hull contradicts beyond its resolution, as a share of the mask's: what lies in empty space, what
    the mask lacks of the core, and, if `filled`, of the hull. A hull is an upper limit of the subject: what few views
    see, it makes too large, so that only of a mask that is an outlier all missing parts are believed. inside: (h, w).
    """
    extra = inside & ~dilated(opinion.possible, opinion.margin)
    extra |= inside & ~dilated(opinion.silhouette, opinion.margin) & opinion.here
    missing = eroded(opinion.silhouette, opinion.margin) & ~inside & opinion.here if filled else _lacks(inside, opinion)
    return float(missing.sum() + extra.sum()) / max(1, int(inside.sum()))


def lacking(inside: Bool, opinion: Opinion) -> float:
    """Area of the core that the mask lacks, as a share of the mask's. inside: (h, w)."""
    return float(_lacks(inside, opinion).sum()) / max(1, int(inside.sum()))


def _lacks(inside: Bool, opinion: Opinion) -> Bool:
    return np.asarray(eroded(opinion.core, opinion.margin) & ~inside & opinion.here)


def hole(inside: Bool, opinion: Opinion) -> float:
    """Area of the mask's holes where the hull clearly is, as a share of the mask's. inside: (h, w)."""
    enclosed = ndimage.binary_fill_holes(inside) & ~inside
    return float((enclosed & eroded(opinion.silhouette, opinion.margin)).sum()) / max(1, int(inside.sum()))


def trimap(inside: Bool, opinion: Opinion, *, filled: bool) -> np.typing.NDArray[np.uint8]:
    """Trimap (h, w) for GrabCut when a view is segmented again: from the hull where it is clear, else from the mask
    `inside` (h, w). filled: the hull's inside is the subject's; else only its core, and where the mask has holes."""
    out = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    near = dilated(inside, opinion.margin) & ~eroded(inside, opinion.margin)
    out[eroded(inside, opinion.margin)] = cv2.GC_FGD
    out[~inside & ~near] = cv2.GC_BGD
    clear = eroded(opinion.silhouette, opinion.margin)
    if not filled:
        clear &= ndimage.binary_fill_holes(inside) | opinion.core
    empty = ~dilated(opinion.silhouette, opinion.margin)
    # a mask without most of the subject is not used outside of the region of interest either
    lost = (inside & opinion.silhouette).sum() < 0.3 * opinion.silhouette.sum()
    here = np.ones_like(inside) if lost else opinion.here
    full = opinion.silhouette if filled else opinion.silhouette & inside
    out[here & ~clear & ~empty] = np.where(full, cv2.GC_PR_FGD, cv2.GC_PR_BGD)[here & ~clear & ~empty]
    agreed = here & ~clear & ~empty & near  # undecided by both: the view's own contour is the better start
    out[agreed] = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD)[agreed]
    out[here & clear] = cv2.GC_FGD
    out[here & empty] = cv2.GC_BGD
    out[~dilated(opinion.possible, opinion.margin)] = cv2.GC_BGD
    return out


def outliers(ious: Sequence[float | None], least: float, deviation: float) -> list[bool]:
    """Which views are outliers: IoU below `least`, or below the median by `deviation` and by SPREADS sigma.

    If the median itself is below `least`, no view is an outlier: then the cameras or all masks are wrong.
    """
    known = np.array([v for v in ious if v is not None])
    if not len(known) or np.median(known) < least:
        return [False] * len(ious)
    median = float(np.median(known))
    spread = 1.4826 * float(np.median(np.abs(known - median)))
    limit = max(least, median - max(deviation, SPREADS * spread))
    return [v is not None and v < limit for v in ious]
