"""The space that a person with a placed head can fill: what a visual hull of photos from one side must be cut by.

Such a hull reaches centimetres in front of the face and behind the head, but its sides are right: there the silhouettes
are. So how far a person may stand out of the template depends on how the cameras see the template there.

Symbols: T signed distance of the placed template's shell; c largest cosine between its normal and the direction to a
camera; a >= 0 metres that a person may stand out of it; S = T - a.

    a = region's allowance where cameras face the template (c = 1): hair, ears, a collar
    a = SIDE               there on the left and right where they see it from the side: silhouettes bound the hull
    a = HIDDEN             where no camera faces it (c < 0)

Below the chin a grows with the depth below it: shoulders are wider than any head.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.hull import BAND_CELLS, Hull
from pipeline.meshes import F32, F64, Mask, vertex_normals
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.shell import outer_shell, shell_distance
from pipeline.template.model import SKIN, Template

# Metres, by region. Everywhere a little: stereo finds a surface inside of its start more easily than one outside.
FACED: Mapping[str, float] = {"scalp": 0.045, "ears": 0.012, "neck": 0.015}
ELSEWHERE, SIDE, HIDDEN = 0.002, 0.08, 0.02
HAIR = 0.03  # metres over which that of the side ends on the face
FULLY_FACED, FULLY_SIDE = 0.75, 0.4  # c above which a is the region's, and below which it is SIDE
SIDEWAYS = 0.9  # part of a normal to the person's left or right from which it counts as the side: not the throat
WIDER, DEEPER = 3.0, 0.5  # growth of a below the chin, sideways and to the front, over the depth
BELOW = 0.01  # metres below the lowest landmark at which that begins
CHEST, BACK = 0.02, 0.06  # metres that anything may lie in front of the nose, and behind the back of the head
FAR = 0.08  # the same for both where the photos are from all around: only what few cameras leave, a tail behind a neck
SMOOTH_STEPS = 12  # of averaging over neighbours: a changes over about two centimetres
BLUR = 0.006  # metres: so that a has no steps where the nearest place of the template changes


def possible_space(
    template: Template, head: PlacedHead, centres: F64, lo: F64, cell: float, shape: tuple[int, int, int]
) -> F32:
    """(X, Y, Z) S at lo + cell (i, j, k), world units, negative inside. centres (N, 3): of the cameras."""
    shell = outer_shell(template)
    found = shell_distance(shell.vertices(head.vertices), shell.faces, np.asarray(lo, np.float64), cell, shape)
    allowed = np.concatenate([_allowance(template, head, centres), np.full(len(shell.loops), ELSEWHERE)])
    bound = allowed[shell.faces].mean(1)[found.face]
    node = [low + cell * np.arange(n) for low, n in zip(lo, shape, strict=True)]
    _, up, front = (head.world_from_template[:3, k] / head.scale for k in range(3))
    height, ahead = (_along(axis, node) for axis in (up, front))
    rim = head.vertices[shell.loops[0]]
    values = _prolonged(found.values, height - float((rim @ up).min()), up / cell)
    marks = template.landmark_points(head.vertices)
    below = np.maximum(float((marks @ up).min()) / head.scale - BELOW - height / head.scale, 0.0)
    bound = bound + below * np.where(ahead > float(rim.mean(0) @ front), DEEPER, WIDER)
    bound = head.scale * ndimage.gaussian_filter(bound, BLUR * head.scale / cell)
    return np.asarray(np.maximum(values - bound, _slab(template, head, ahead, CHEST, BACK)), np.float32)


def space_near_head(template: Template, head: PlacedHead, lo: F64, cell: float, shape: tuple[int, int, int]) -> F32:
    """(X, Y, Z) distance at lo + cell (i, j, k) from the space between FAR before the nose and FAR behind the back of
    the head, world units, negative inside. Few cameras all around leave a hull that goes on behind a neck where nothing
    is."""
    front = head.world_from_template[:3, 2] / head.scale
    ahead = _along(front, [low + cell * np.arange(n) for low, n in zip(lo, shape, strict=True)])
    return np.asarray(_slab(template, head, ahead, FAR, FAR), np.float32)


def _slab(template: Template, head: PlacedHead, ahead: F64, chest: float, back: float) -> F64:
    """(X, Y, Z) distance from the space between `chest` before the nose and `back` behind the head, metres of the
    template. ahead (X, Y, Z): coordinate of the nodes to the front."""
    front = head.world_from_template[:3, 2] / head.scale
    reach = head.vertices[template.quads[template.parts[SKIN]]] @ front
    nose, behind = float(reach.max()) + chest * head.scale, float(reach.min()) - back * head.scale
    return np.maximum(ahead - nose, behind - ahead)


def _prolonged(values: F32, height: F64, up: F64) -> F32:
    """values (X, Y, Z) with the column of the neck going on below its end: nodes of negative height (X, Y, Z) take the
    value straight above them, at the end. up (3,): in nodes per unit of height."""
    below = np.nonzero(height < 0)
    out = values.copy()
    if len(below[0]):
        at = np.stack(below).astype(np.float64) - height[below] * up[:, None]
        out[below] = ndimage.map_coordinates(values, at, order=1, mode="nearest")
    return out


def carved_hull(hull: Hull, template: Template, head: PlacedHead, centres: F64) -> Hull:
    """A hull without what no person with this head fills. centres (N, 3): of the cameras."""
    x, y, z = hull.level.shape
    space = possible_space(template, head, centres, hull.lo + 0.5 * hull.cell, hull.cell, (x, y, z))
    band = np.float32(BAND_CELLS * hull.cell)
    level = np.maximum(hull.level, space.clip(-band, band))
    return replace(hull, level=level, occupied=hull.occupied & (space <= 0.5 * hull.cell))


def _along(axis: F64, node: list[F64]) -> F64:
    """(X, Y, Z) coordinate of the nodes of a grid along a direction (3,)."""
    x, y, z = (a * n for a, n in zip(axis, node, strict=True))
    return np.asarray(x[:, None, None] + y[None, :, None] + z[None, None, :], np.float64)


def _allowance(template: Template, head: PlacedHead, centres: F64) -> F64:
    """(V,) a, smooth over the skin."""
    normals = vertex_normals(head.vertices, template.triangles()).astype(np.float64)
    cosine, near = _faced(head, normals, centres), _near_hair(template)
    side = np.clip((FULLY_FACED - cosine) / (FULLY_FACED - FULLY_SIDE), 0.0, 1.0)
    side *= np.clip(np.abs(normals @ head.world_from_template[:3, 0]) / head.scale / SIDEWAYS, 0.0, 1.0) ** 2
    base = np.full(len(template.vertices), ELSEWHERE)
    for name, metres in FACED.items():
        if name in template.regions:
            here = np.where(cosine < 0, HIDDEN, metres + side * (SIDE - metres))
            base = np.maximum(base, here * template.region_weights(name))
    base = np.maximum(base, near * side * SIDE * (cosine >= 0))
    # smaller values stay: the face is not widened by its border
    return np.asarray(np.minimum(base, _smoothed(base, template)), np.float64)


def _near_hair(template: Template) -> F64:
    """(V,) 1 at the scalp and the ears, 0 from HAIR metres on: hair may hang over the jaw's side."""
    names = [name for name in ("scalp", "ears") if name in template.regions]
    if not names:
        return np.zeros(len(template.vertices))
    held = np.unique(template.quads[np.concatenate([template.regions[n] for n in names])])
    distance, _ = cKDTree(template.vertices[held]).query(template.vertices)
    return np.asarray(np.clip(1 - distance / HAIR, 0.0, 1.0), np.float64)


def _faced(head: PlacedHead, normals: F64, centres: F64) -> F64:
    """(V,) c for normals (V, 3)."""
    out = np.full(len(normals), -1.0)
    for centre in centres:
        away = centre - head.vertices
        out = np.maximum(out, (away * normals).sum(1) / np.linalg.norm(away, axis=1))
    return out


def _smoothed(values: F64, template: Template) -> F64:
    """(V,) values after averaging over neighbours on the skin."""
    quads = template.quads[template.parts[SKIN]]
    a, b = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    count = np.bincount(a, minlength=len(values)) + np.bincount(b, minlength=len(values))
    inside: Mask = count > 0
    for _ in range(SMOOTH_STEPS):
        sums = np.bincount(a, values[b], len(values)) + np.bincount(b, values[a], len(values))
        values = np.where(inside, 0.5 * values + 0.5 * sums / np.maximum(count, 1), values)
    return np.asarray(values, np.float64)
