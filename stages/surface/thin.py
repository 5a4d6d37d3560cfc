"""Share of a surface on flakes and needles: solid that is thinner than the lattice can represent.

Symbols: h lattice cell; thickness at a point: distance to the other side of the solid, against the normal.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Mesh
from pipeline.visibility import Occluder

THIN_CELLS = 2.0  # of h: marching cubes loses sheets thinner than one cell and leaves holes in those thinner than two
START = 0.05  # of h: rays start this far inside
POINTS = 20_000  # at most, spread evenly over the faces


def thin_share(mesh: Mesh, h: float) -> float:
    """Share of the area where the solid is thinner than THIN_CELLS."""
    faces = mesh.faces[:: -(-len(mesh.faces) // POINTS)]
    area = meshes.areas(mesh.vertices, faces)
    thin = thickness(mesh, faces, START * h) < THIN_CELLS * h
    return float(area[thin].sum() / max(float(area.sum()), 1e-30))


def thickness(mesh: Mesh, faces: meshes.Faces, lift: float) -> F64:
    """(N,) thickness of the solid at the centroids of faces (N, 3); infinite where a ray leaves an open mesh. lift: the
    rays start this far inside. All in the mesh's unit."""
    inward = -meshes.unit(meshes.area_vectors(mesh.vertices, faces))
    start = mesh.vertices.astype(np.float64)[faces].mean(1) + lift * inward
    return Occluder(mesh).distances(start, inward) + lift
