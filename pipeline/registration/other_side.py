"""The other side of a head: where a place of the surface would be if the head were turned into its mirror image.

The head template knows the vertex on the other side of each of its own. A place keeps its offset from the nearest
vertex of the placed template, mirrored at the head's plane, so that the surface need not lie on the template and the
head need not be symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Mask
from pipeline.registration.identity_fit import PlacedHead
from pipeline.template.model import SKIN, Template

FAR = 0.02  # metres of the template: what is further off it is no part of the head
PLAIN = ("face", "nose", "ears", "scalp", "neck")  # regions whose skin is of one kind; lips, lids and nostrils are not


@dataclass(frozen=True, slots=True)
class OtherSide:
    """Of N places: where (N, 3) in the world they are on the other side; on_head (N,): within FAR of the template;
    plain (N,): not on lips, lids or other parts with a colour of their own."""

    where: F64
    on_head: Mask
    plain: Mask


def other_side(places: F64, template: Template, head: PlacedHead) -> OtherSide:
    """Of places (N, 3) in the world."""
    skin = np.unique(template.quads[template.parts[SKIN]])
    distance, nearest = cKDTree(head.vertices[skin]).query(places)
    vertex = skin[nearest]
    across = head.world_from_template[:3, 0] / head.scale
    offset = places - head.vertices[vertex]
    mirrored = offset - 2 * (offset @ across)[:, None] * across
    special = np.zeros(len(template.vertices), np.bool_)
    for name in set(template.regions) - set(PLAIN):
        special[template.quads[template.regions[name]]] = True
    on_head = distance <= FAR * head.scale
    return OtherSide(head.vertices[template.mirror[vertex]] + mirrored, on_head, ~(special[vertex] & on_head))
