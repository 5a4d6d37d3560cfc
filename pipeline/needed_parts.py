"""Parts that a mask lacks although most of the other masks need them: a shirt that is missing in three photos of 36.

The visual hull of all masks has no shirt then: one mask is enough to carve it away. Every other mask would be wrong
beside such a hull, and what it says would be lost. So before a hull may contradict the masks, they vote:

1. A hull is carved that tolerates WRONG of the views of a voxel.
2. What its silhouette clearly shows and a mask clearly lacks is a missing part.
3. The part is the subject's if the other masks need its voxels: without them the hull no longer covers what these
   masks show. Of the masks that could tell, more must need the part than lack it, and at least
   `hull_needs.MASKS`.

A part that a few photos rightly carve (a gap between chin and chest) is needed by none: in the other photos something
else lies on the same rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.hull import Cloud, Hull, cloud, render_silhouette, visual_hull
from pipeline.hull_needs import MASKS, clearly_lacking, margin_of, masks_in_need, voxels_at

F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
CELLS = 64  # voxels along the edge of the hull's cube
WRONG = 0.15  # share of the views of a voxel that may lack it
MISSING = 0.02  # of the hull's silhouette: smaller parts are noise of the outline, or the hull's excess
CUBE = 1.6  # half-edge of the hull's cube in radii of the region of interest


@dataclass(frozen=True, slots=True)
class Needed:
    """parts: by position of the view, (h, w) what its mask lacks and the others need. hull: the tolerant hull, None
    without votes."""

    hull: Hull | None = None
    parts: dict[int, Bool] = field(default_factory=dict)


def needed_parts(
    cameras: Sequence[Camera], alphas: Sequence[F32], votes: Sequence[bool], roi_radius: float
) -> Needed:  # fmt: skip
    """What the masks lack. alphas: (h, w) each, small. votes: which views carve; what the others lack is found, too."""
    voters = [i for i, vote in enumerate(votes) if vote]
    if len(voters) <= MASKS:
        return Needed()
    edge = CUBE * roi_radius
    carving = list(compress(cameras, votes)), list(compress(alphas, votes))
    hull = visual_hull(
        *carving, [-edge] * 3, [edge] * 3, 2 * edge / CELLS, max_outside=len(voters), outside_share=WRONG
    )
    if not (hull.level <= 0).any():
        return Needed()
    points = cloud(hull)
    missing = {i: found for i, (c, a) in enumerate(zip(cameras, alphas, strict=True))
               if (found := _missing(points, c, a, hull.cell)) is not None}  # fmt: skip
    lack = sum(i in missing for i in voters)
    parts = {}
    for i, part in missing.items():
        need = masks_in_need(hull, voxels_at(hull, cameras[i], part), *carving)
        if sum(voters[k] not in missing for k in need) >= max(MASKS, lack + 1):
            parts[i] = part
    return Needed(hull, parts)


def _missing(points: Cloud, camera: Camera, alpha: F32, cell: float) -> Bool | None:
    """(h, w) what the hull clearly shows and a mask clearly lacks, up to the mask; None if there is nothing."""
    h, w = alpha.shape
    shown, inside = render_silhouette(points, camera, h, w) >= 0.5, alpha >= 0.5
    found = clearly_lacking(shown, inside, margin_of(camera, w, cell, 1), MISSING)
    return np.logical_or.reduce(found) if found else None
