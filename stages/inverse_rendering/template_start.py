"""Initial geometry of a person's head where the visual hull hides the face: the hull, cut by the head template.

Photos from one side leave a hull that reaches centimetres in front of and behind the face. No sweep along its normals
finds the nose in it. But the photos' face landmarks tell where the face is, and the template placed on them how it
goes on (pipeline.registration.carve). The hull remains the outer limit; the template only carves.

Few cameras all around leave a hull that has the face, but goes on behind the neck: such parts are cut off too.

Long hair hides the face from cameras all around as well: it closes the hull in front of the face. There the silhouettes
know the hair, and the template does not; so only the space through which photos see the face is cut away
(pipeline.registration.before_face).
"""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
import torch

from pipeline.meshes import F32, F64
from pipeline.registration.before_face import Sight, space_before_face
from pipeline.registration.carve import possible_space, space_near_head
from pipeline.registration.identity_fit import PlacedHead
from pipeline.template.model import Template
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.keep_silhouettes import bound_with_silhouettes
from stages.inverse_rendering.ray_sampling import WHOLE, PhotoView
from stages.inverse_rendering.signed_distance import distances
from stages.inverse_rendering.stereo import reduced
from stages.inverse_rendering.unseen_rods import RADIUS, without_unseen_rods

# Metres of the template: median distance of the landmarks from a surface that does not have the face. Measured: 1 to
# 3 mm on surfaces that are right, 6 to 45 mm where the hull hides the face.
FAR = 0.006
SIGHT = 240  # pixels of a photo's longest side, in which the face is seen
THICK = 0.012  # metres of the template: of hair that silhouettes show beyond its space
BEYOND_STEREO = 0.015  # the same before stereo: no sweep goes so far. 24 mm on arcs of photos


def landmarks_off(start: Start, landmarks: F64, unit: float) -> float:
    """Median distance of the landmarks (468, 3) from the zero set of the start, in metres of the template. unit: world
    units per metre of the template."""
    known = landmarks[np.isfinite(landmarks).all(1)]
    values, _ = start.surface("cpu")(torch.from_numpy(known.astype(np.float32)))
    return float(values.detach().abs().median()) / unit


def carved_by_template(
    start: Start,
    template: Template,
    head: PlacedHead,
    views: list[PhotoView],
    check: Callable[[], None] = lambda: None,
) -> Start:
    """The start without what no person with this head fills and no silhouette needs."""
    x, y, z = start.values.shape
    centres = np.stack([v.world_from_cam[:3, 3] for v in views])
    space = possible_space(template, head, centres, start.lo.astype(np.float64), start.cell, (x, y, z))
    cut = _cut(start, space, head, views, check, THICK)
    return without_unseen_rods(cut, views, RADIUS * head.scale, check)


def without_cover(
    start: Start, template: Template, head: PlacedHead, views: list[PhotoView], showing: Collection[int]
) -> Start:
    """The start without what lies before the face in the photos that show it. showing: indices of these photos."""
    sights = [_sight(v) for v in views if v.index in showing]
    lo = start.lo.astype(np.float64)
    space = space_before_face(template, head, sights, start.values < start.cell, lo, start.cell)
    if not (space > 0).any():
        return start
    return Start(distances(np.maximum(start.values, space), start.lo, start.cell), start.lo, start.cell)


def _sight(view: PhotoView) -> Sight:
    """A photo as the face's space asks it."""
    K, small = reduced(view, SIGHT)
    colour = np.stack([small(view.rgb[..., k]) for k in range(3)], -1)
    subject = (small(view.alpha) > WHOLE) & np.isfinite(colour).all(-1)
    return Sight(K, view.world_from_cam, np.nan_to_num(colour).astype(np.float64), subject)


def without_far_parts(
    start: Start, template: Template, head: PlacedHead, views: list[PhotoView], check: Callable[[], None] = lambda: None
) -> Start:
    """The start without what lies far before or behind the head and no silhouette needs; the same start if that is
    nothing."""
    x, y, z = start.values.shape
    space = space_near_head(template, head, start.lo.astype(np.float64), start.cell, (x, y, z))
    if not ((start.values < 0) & (space > 0)).any():
        return start
    return _cut(start, space, head, views, check)


def _cut(
    start: Start, space: F32, head: PlacedHead, views: list[PhotoView], check: Callable[[], None], thick: float = 0.0
) -> Start:
    """The start within a space (X, Y, Z), negative inside, and what else the silhouettes need of it. thick: metres of
    the template, of that."""
    front = head.world_from_template[:3, 2] / head.scale
    bound = bound_with_silhouettes(start, space, front, views, check, thick=thick * head.scale)
    return Start(distances(np.maximum(start.values, bound), start.lo, start.cell), start.lo, start.cell)
