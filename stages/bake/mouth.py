"""Colours of what a closed mouth hides: its inside, teeth and tongue of the template.

Without them an unseen place continues its surroundings, and an open mouth would be as bright inside as the lips. They
hold only where no photo shows the place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import tiles
from pipeline.artifacts import Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import F64, Charts, Mask, Mesh
from pipeline.registration.head import load_head, of_triangles
from pipeline.registration.quality import outer_quads

COLOURS = {  # linear reflectance; the inside is the throat's as a camera sees it, so that it is dark without shadows
    "mouth_inside": (0.10, 0.03, 0.03),
    "teeth": (0.55, 0.50, 0.42),
    "tongue": (0.30, 0.12, 0.11),
}


@dataclass(frozen=True, slots=True)
class Inside:
    """share (V,): how far a vertex belongs to the mouth's inside; colour (V, 3): there."""

    share: F64
    colour: F64

    def in_place_of(self, albedo: F64, unseen: Mask) -> F64:
        """(V, 3) albedo with these colours where no photo shows the vertex: unseen (V,)."""
        part = (self.share * unseen)[:, None]
        return np.asarray(albedo + part * (self.colour - albedo))


def inside_of(registered: Located[RegisteredHead], mesh: Mesh) -> Inside | None:
    """The inside of the mouth of the textured mesh, which begins with the head's quads; None without any."""
    names, ref = registered.artifact.regions, registered.artifact.head
    if ref is None or not set(COLOURS) & set(names):
        return None
    head = load_head(registered.path(ref))
    region = of_triangles(head, head.region, names)
    faces, count = mesh.faces[: len(region)], len(mesh.vertices)
    every = np.maximum(np.bincount(faces.ravel(), minlength=count), 1)
    share, colour = np.zeros(count), np.zeros((count, 3))
    for name, own in COLOURS.items():
        if name in names:
            mine = np.bincount(faces[region == names.index(name)].ravel(), minlength=count) / every
            share += mine
            colour += mine[:, None] * np.array(own)
    return Inside(share, colour / np.maximum(share, 1e-9)[:, None])


def hidden_tiles(registered: Located[RegisteredHead], charts: Charts) -> frozenset[int]:
    """Tiles with parts of the head, but none of the skin's outside: mouth, sockets, eyes. Photos show little of them,
    whatever is photographed."""
    if registered.artifact.head is None:
        return frozenset()
    head, names = load_head(registered.path(registered.artifact.head)), registered.artifact.regions
    outside = of_triangles(head, outer_quads(head.region, names).astype(np.int64), names) > 0
    tile = tiles.of_face(charts)[: len(outside)]
    return frozenset(np.setdiff1d(tile, tile[outside]).tolist())
