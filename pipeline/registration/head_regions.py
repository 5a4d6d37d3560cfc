"""Regions of a person, by the nearest region of the head template that was placed on the photos' face."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Indices, Mask
from pipeline.registration.identity_fit import PlacedHead
from pipeline.template.model import Template

Near = Callable[[F64], Mask]  # (N,) of points (N, 3): on a part of the head

# Metres from the head template within which a vertex belongs to its region: hair is thick; so is a collar.
NEAR = {"scalp": 0.04, "neck": 0.06, "ears": 0.02, "face": 0.02}
REGIONS = tuple(NEAR)
NECK = REGIONS.index("neck")
REST = len(REGIONS)
HAIR = REST + 1  # a mesh of its own; under it the scalp goes on in the colour of the face
PARTED = ("brows", "lids", "lips", "nose", "nostrils")  # what the face has besides cheeks, forehead and chin
CLEAR_OF = 0.008  # metres of the template between these and plain skin
FIRST_BAND, BANDS, BAND_HEIGHT = HAIR + 1, 32, 0.012  # codes of the neck's bands, the lowest first; metres of each
FIRST_BEHIND = FIRST_BAND + BANDS  # codes of the same bands where the neck does not face forwards
SIDE = 60.0  # degrees about the neck's middle, from the front, beyond which it counts as behind


def region_of(vertices: F64, template: Template, head: PlacedHead) -> Indices:
    """(V,) index into REGIONS of the nearest region of the placed template, for the neck the code of its band, in front
    or behind; REST far from the head and in all other regions (lids, lips), which photos of a face show."""
    quads = {name: template.quads[template.regions[name]] for name in REGIONS if name in template.regions}
    points = np.concatenate([head.vertices[q].mean(1) for q in quads.values()])
    names = np.concatenate([np.full(len(q), REGIONS.index(name)) for name, q in quads.items()])
    distance, nearest = cKDTree(points).query(vertices)
    reach = np.array(list(NEAR.values()))[names[nearest]] * head.scale
    found = np.where(distance <= reach, names[nearest], REST).astype(np.int64)
    up = head.world_from_template[:3, 1] / head.scale**2  # height in metres of the template
    lowest = float((points[names == NECK] @ up).min()) if NECK in names else 0.0
    band = np.floor((vertices @ up - lowest) / BAND_HEIGHT).clip(0, BANDS - 1).astype(np.int64)
    middle = points[names == NECK].mean(0) if NECK in names else np.zeros(3)
    first = np.where(_forwards(vertices - middle, head), FIRST_BAND, FIRST_BEHIND)
    return np.where(found == NECK, first + band, found)


def _forwards(out: F64, head: PlacedHead) -> Mask:
    """(V,) whether vectors out (V, 3) from the neck's middle point to where the face looks, within SIDE degrees."""
    across, _, ahead = (out @ head.world_from_template[:3, i] for i in range(3))
    return np.asarray(np.abs(np.arctan2(across, ahead)) <= np.radians(SIDE), np.bool_)


def near_head(template: Template, head: PlacedHead) -> Near:
    """The function that tells which points (N, 3) lie in any region of the placed template, as (N,)."""
    return lambda x: np.asarray(region_of(x, template, head) != REST, np.bool_)


def plain_face(template: Template, head: PlacedHead) -> Near:
    """The function that tells which points (N, 3) lie on cheeks, forehead or chin of the placed template, as (N,)."""
    parted = np.unique(template.quads[np.concatenate([template.regions[n] for n in PARTED if n in template.regions])])
    tree = cKDTree(head.vertices[parted])
    face = REGIONS.index("face")

    def of(x: F64) -> Mask:
        far = tree.query(x)[0] > CLEAR_OF * head.scale
        return np.asarray(far & (region_of(x, template, head) == face), np.bool_)

    return of
