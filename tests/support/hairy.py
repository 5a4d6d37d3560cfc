"""The template's own head with hair of known thickness on its upper scalp."""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, Mesh, triangles_of, vertex_normals
from pipeline.registration.head import limit_surface
from pipeline.registration.subdivision import subdivided
from tests.support import persons

SKIN, DARK = (0.45, 0.28, 0.2), (0.02, 0.015, 0.012)


BOB = -0.06  # height at which hair that hangs beside and behind the head ends


def hairy_head(thickness: float, hanging: float = 0.0, end: float = BOB) -> tuple[Mesh, F64]:
    """The skin of the template with hair of some thickness in metres, and share (V,) of it that each vertex has.
    hanging: thickness of the hair that hangs below it down to the height `end`, beside cheeks and behind the neck."""
    t = persons.template()
    skin = t.quads[t.parts["skin"]]
    points, normals, quads = limit_surface(t.vertices, subdivided(skin, len(t.vertices), 2))
    used, flat = np.unique(quads, return_inverse=True)
    points, normals, faces = points[used], normals[used], triangles_of(flat.reshape(-1, 4))
    share = np.clip((points[:, 1] - 0.03) / 0.01, 0, 1) * (points[:, 2] < 0.05)
    moved = points + thickness * share[:, None] * normals
    if hanging:
        below = np.clip((points[:, 1] - end) / 0.005, 0, 1) * np.clip((0.02 - points[:, 2]) / 0.01, 0, 1) * (1 - share)
        away = np.maximum(np.linalg.norm(normals[:, [0, 2]], axis=1, keepdims=True), 0.3)
        moved = moved + hanging * below[:, None] * normals * [1, 0, 1] / away
        share = np.maximum(share, below)
    return Mesh(moved.astype(np.float32), vertex_normals(moved, faces), faces), np.asarray(share, np.float64)
