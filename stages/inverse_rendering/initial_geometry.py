"""Initial geometry: the visual hull of the masks as a signed distance on the coarsest grid.

In a plain hull one wrong mask is enough: if it lacks the shirt, the body ends at the collar. So first a lenient hull is
carved, which tolerates a few wrong views. Where a mask clearly lacks what it shows, and that part is the subject
(pipeline.hull_needs; pipeline.needed_parts where more masks lack it), the mask is ignored. Everywhere else all masks
carve, because a lenient hull is too thick.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch

from pipeline.artifacts import Camera, Extent
from pipeline.errors import StageError
from pipeline.extent import GROWN, bounds, within
from pipeline.fields.geometry import GridSdf
from pipeline.hull import Cloud, Hull, cloud, hull_bounds, hull_sdf, render_silhouette, visual_hull
from pipeline.hull_needs import CUBE, MARGIN, clearly_lacking, is_subject, margin_of, voxels_at
from pipeline.needed_parts import needed_parts

F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
CELLS = 64  # voxels along the cube in which masks are compared
WRONG, WRONG_SHARE = 2, 0.1  # views that may be wrong about a voxel, and their share of the views that see it
SIDE = 320  # pixels: longest side at which masks are compared
MIN_VIEWS = 3  # that must see a voxel of a subject without extent; an extent ends what few photos show
MARGIN_CELLS = 4  # cells around the hull for the narrow band and the spline's border


@dataclass(frozen=True, slots=True)
class Start:
    """The initial geometry: SDF samples (X, Y, Z) at lo + i cell, asset units. lo: (3,)."""

    values: F32
    lo: F32
    cell: float

    def surface(self, device: str) -> GridSdf:
        """A copy of the samples as an SDF that can be traced."""
        values, lo = (torch.from_numpy(a.astype(np.float32)) for a in (self.values, self.lo))
        return GridSdf(values, lo, self.cell).to(device)


@dataclass(frozen=True, slots=True)
class Agreed:
    """Corrected masks. alphas: (h, w) per view, unchanged objects where nothing is wrong. doubtful: (h, w) by position
    of the view, where its mask lacks a part that the other views show; these pixels are not fitted."""

    alphas: list[F32]
    doubtful: dict[int, Bool]


def agreed(cameras: list[Camera], alphas: list[F32], roi_radius: float) -> Agreed:
    """Masks that do not carve where they lack a part of the subject.

    alphas: (H, W) each, in [0, 1]. roi_radius: asset units. Doubtful pixels have the size of the view's alpha.
    """
    edge = CUBE * roi_radius
    cell = 2 * edge / CELLS
    small = [_shrunk(a) for a in alphas]
    lenient = visual_hull(cameras, small, [-edge] * 3, [edge] * 3, cell, max_outside=WRONG, outside_share=WRONG_SHARE)
    points = cloud(lenient)
    out, doubtful = list(alphas), {}
    needed = needed_parts(cameras, small, [True] * len(small), roi_radius).parts
    for i, (camera, alpha) in enumerate(zip(cameras, small, strict=True)):
        lacks = [r for r in _lacks(points, camera, alpha)
                 if is_subject(lenient, voxels_at(lenient, camera, r), cameras, small)]  # fmt: skip
        lacks += [needed[i]] if i in needed else []
        if lacks:
            h, w = alphas[i].shape
            wrong = np.logical_or.reduce(lacks).astype(np.uint8)
            where = cv2.resize(wrong, (w, h), interpolation=cv2.INTER_NEAREST) > 0
            doubtful[i] = where
            out[i] = np.where(where, np.float32(1), alphas[i])
    return Agreed(out, doubtful)


def _shrunk(alpha: F32) -> F32:
    factor = SIDE / max(alpha.shape)
    if factor >= 1:
        return alpha
    size = (max(2, round(alpha.shape[1] * factor)), max(2, round(alpha.shape[0] * factor)))
    return np.asarray(cv2.resize(alpha, size, interpolation=cv2.INTER_AREA), np.float32)


def _lacks(lenient: Cloud, camera: Camera, alpha: F32) -> list[Bool]:
    """The regions (h, w) that the lenient hull clearly shows and a mask clearly lacks."""
    h, w = alpha.shape
    shown = render_silhouette(lenient, camera, h, w) >= 0.5
    return clearly_lacking(shown, alpha >= 0.5, margin_of(camera, w, lenient.cell, MARGIN))


def hull_start(
    cameras: list[Camera], alphas: list[F32], roi_radius: float, cells: int, levels: int, extent: Extent | None = None
) -> Start:
    """SDF samples of the hull, whose cell after `levels` - 1 halvings is 1 / `cells` of the hull's longest side.

    alphas: (H, W) each. extent: the part of the hull that is fitted, kept with a margin, so that the fit has no border
    where the mesh ends. Within it a single photo is enough: shoulders that most frames cut off belong to the bust.

    Raises StageError if the hull is empty.
    """

    def kept(hull: Hull) -> Hull:
        return hull if extent is None else within(hull, extent, GROWN * extent.head)

    reach = None if extent is None else bounds(extent, GROWN * extent.head)
    least = MIN_VIEWS if extent is None else 1
    lo, hi = hull_bounds(cameras, alphas, roi_radius, keep=kept, reach=reach, min_views=least)
    cell = float((hi - lo).max()) / cells * 2 ** (levels - 1)
    lo, hi = lo - MARGIN_CELLS * cell, hi + MARGIN_CELLS * cell
    hull = kept(visual_hull(cameras, alphas, lo, hi, cell, min_views=least))
    if not hull.occupied.any():
        raise StageError(
            "the visual hull of the masks is empty",
            where="inverse_rendering",
            value="an empty visual hull",
            limit="at least one voxel inside every view's silhouette",
            remedy="check the masks and the cameras: one of them is wrong, or the views show different subjects",
        )
    return Start(hull_sdf(hull).astype(np.float32), (hull.lo + 0.5 * cell).astype(np.float32), cell)
