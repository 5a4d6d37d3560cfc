"""The head template placed on the face's landmarks: regions of the surface, and the two sides of its skin."""

from __future__ import annotations

from functools import partial

import numpy as np

from pipeline.artifacts import Located, MaskSet
from pipeline.faces.landmarks3d import load_landmarks
from pipeline.meshes import Indices, Mesh
from pipeline.registration.head_regions import region_of
from pipeline.registration.identity_fit import placed_on_face
from pipeline.registration.other_side import other_side
from pipeline.template.load import load_template
from stages.bake.even_skin import Even, evening


def on_head(masks: Located[MaskSet], mesh: Mesh, part: float) -> tuple[Indices | None, Even | None]:
    """(V,) region of the head of each vertex, and what evens its skin by `part`; None without a face, and what evens
    also where part is 0."""
    found = masks.artifact.landmarks
    if found is None:
        return None, None
    template = load_template()
    head = placed_on_face(template, load_landmarks(masks.path(found)))
    if head is None:
        return None, None
    vertices = mesh.vertices.astype(np.float64)
    region = region_of(vertices, template, head)
    return region, partial(evening, mesh, other=other_side(vertices, template, head), part=part) if part else None
