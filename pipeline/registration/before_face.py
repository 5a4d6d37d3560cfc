"""The space before a face that photos see: it is empty, whatever the silhouettes leave there.

Hair that hangs beside a face closes the visual hull in front of it: no silhouette looks in between. But a photo
in which the face is detected looks through that space. So a template is placed on the face, and in each such photo

- the middle of the face is seen (below the brows, between the outer corners of the eyes: hardly any hair hangs there);
- and so is the skin of face and neck in pixels that have the colour of the middle and are connected with it.

What lies before that in at least two photos is empty.

Symbols: c the centre of a camera, t(d) the distance along the ray d of a pixel to the template; a place x is before the
face if |x - c| < t - margin on its ray; the margin is larger where the template is less certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from pipeline.meshes import F32, F64, Indices, Mask, area_vectors, triangles_of, unit
from pipeline.ray_casting import RayCaster
from pipeline.registration.identity_fit import PlacedHead
from pipeline.skin_colour import ALIKE, against_face
from pipeline.template.model import SKIN, Template
from pipeline.transforms import inverse_rigid, pixel_centres, project, rays

HALF_WIDTH, LOWEST, HIGHEST = 0.045, -0.085, 0.012  # metres on the average head: x to both sides, y of chin and lids
NONE, CENTRAL = 0, 1  # codes of quads: not asked, in the middle of the face; from 2 on: REACHED
# Metres of the template between the skin and what is cut away: stereo finds a surface inside of its start more easily
# than one outside, and a neck is placed by the face alone.
MARGIN, REACHED = 0.003, {"face": 0.005, "lids": 0.005, "lips": 0.005, "nose": 0.005, "nostrils": 0.005, "neck": 0.015}
FACING = 0.3  # least cosine between a normal and the direction to the camera
RIM = 1  # pixels at the border of what is seen that do not count
ROUNDS = 3  # each with the skin of the last as samples: a neck in the shadow is like a jaw, not like a cheek
LEAST = 50  # pixels of the middle of the face
PHOTOS = 2  # fewest that look through a place: one may have a hand before the face


@dataclass(frozen=True, slots=True)
class Sight:
    """A photo that shows the face, without distortion. K (3, 3) pixels; world_from_cam (4, 4); colour (h, w, 3) linear;
    subject (h, w): certain pixels of the subject."""

    K: F64
    world_from_cam: F64
    colour: F64
    subject: Mask


def space_before_face(
    template: Template, head: PlacedHead, sights: Sequence[Sight], inside: Mask, lo: F64, cell: float
) -> F32:  # fmt: skip
    """(X, Y, Z) signed distance from the space before the face, at lo + cell (i, j, k), world units: positive in it,
    -inf everywhere if there is none. inside (X, Y, Z): nodes that are asked."""
    skin = template.parts[SKIN]
    faces = triangles_of(template.quads[skin])
    caster = RayCaster(head.vertices, faces)
    code, normals = np.repeat(_codes(template)[skin], 2), unit(area_vectors(head.vertices, faces))
    index = np.argwhere(inside)
    points, seen = lo + cell * index, np.zeros(len(index), np.int32)
    for sight in sights:
        seen += _before(points, sight, _reach(sight, caster, code, normals, head.scale))
    before = np.zeros(inside.shape, np.bool_)
    before[tuple(index[seen >= PHOTOS].T)] = True
    if not before.any():
        return np.full(inside.shape, -np.inf, np.float32)
    signed = ndimage.distance_transform_edt(before) - ndimage.distance_transform_edt(~before)
    return np.asarray(cell * ndimage.gaussian_filter(signed, 1.0), np.float32)


def _codes(template: Template) -> Indices:
    """(Q,) NONE, CENTRAL, or 2 + the position in REACHED of the region."""
    x, y, z = template.vertices[template.quads].mean(1).T
    central = (np.abs(x) < HALF_WIDTH) & (y > LOWEST) & (y < HIGHEST) & (z > 0)
    out = np.zeros(len(template.quads), np.int64)
    for i, name in enumerate(REACHED):
        quads = template.regions.get(name, np.zeros(0, np.int64))
        out[quads] = np.where(central[quads] & (name != "neck"), CENTRAL, 2 + i)
    return out


def _reach(sight: Sight, caster: RayCaster, code: Indices, normals: F64, scale: float) -> F64:
    """(h, w) distance from the camera up to which the rays of a photo are free; -inf where it does not see the face."""
    h, w = sight.subject.shape
    centre, d = rays(sight.K, sight.world_from_cam, np.zeros(5), pixel_centres(w, h))
    far, face = caster.hits(np.broadcast_to(centre, d.shape).copy(), d)
    facing = (face >= 0) & (-(normals[face] * d).sum(1) > FACING)
    kind = np.where(facing, code[face], NONE).reshape(h, w)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM + 1, 2 * RIM + 1))

    def without_rim(mask: Mask) -> Mask:
        return np.asarray(cv2.erode(mask.astype(np.uint8), disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)) > 0

    middle = without_rim((kind == CENTRAL) & sight.subject)
    if middle.sum() < LEAST:
        return np.full((h, w), -np.inf)
    bare = middle
    for _ in range(ROUNDS):
        lit, off = against_face(sight.colour[bare], sight.colour.reshape(-1, 3))
        alike = middle | (lit & (off < ALIKE)).reshape(h, w) & sight.subject
        label = np.asarray(cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)[1])
        bare = without_rim(alike & np.isin(label, np.unique(label[middle])) & (kind != NONE)) | middle
    margins = np.array([0.0, MARGIN, *REACHED.values()])
    free = far.reshape(h, w) - margins[kind] * scale
    return np.where(bare, free, -np.inf)


def _before(points: F64, sight: Sight, reach: F64) -> Mask:
    """(N,) points (N, 3) that are nearer to the camera than the reach (h, w) of their pixels."""
    h, w = reach.shape
    uv, z = project(sight.K, inverse_rigid(sight.world_from_cam), np.zeros(5), points)
    at = np.floor(np.where((z > 0)[:, None] & np.isfinite(uv), uv, -1))
    shown = (at >= 0).all(1) & (at < (w, h)).all(1)
    out = np.zeros(len(points), np.bool_)
    column, row = at[shown].astype(np.intp).T
    out[shown] = np.linalg.norm(points[shown] - sight.world_from_cam[:3, 3], axis=1) < reach[row, column]
    return out
