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
from itertools import compress, islice

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.hull import Cloud, cloud, render_silhouette, visual_hull
from pipeline.hull_needs import CUBE, MARGIN, MASKS, clearly_lacking, margin_of, masks_in_need, voxels_at

F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
CELLS = 64  # voxels along the edge of the hull's cube
WRONG = 0.15  # share of the views of a voxel that may lack it


@dataclass(frozen=True, slots=True)
class Needed:
    """parts: by position of the view, (h, w) what its mask lacks and the others need. hull: the tolerant hull, None
    without votes."""

    hull: Cloud | None = None
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
    shown, missing = list[Bool](), dict[int, Bool]()
    for i, (camera, alpha) in enumerate(zip(cameras, alphas, strict=True)):
        shown.append(render_silhouette(points, camera, *alpha.shape) >= 0.5)
        lacks = clearly_lacking(shown[i], alpha >= 0.5, margin_of(camera, alpha.shape[1], hull.cell, MARGIN))
        if lacks:
            missing[i] = np.logical_or.reduce(lacks)
    others = [i for i in voters if i not in missing]
    asked = [cameras[i] for i in others], [alphas[i] for i in others], [shown[i] for i in others]
    least = max(MASKS, len(voters) - len(others) + 1)
    parts = {}
    for i, part in missing.items():
        need = masks_in_need(hull, voxels_at(hull, cameras[i], part), *asked)
        if len(others) >= least and len(list(islice(need, least))) == least:
            parts[i] = part
    return Needed(points, parts)
