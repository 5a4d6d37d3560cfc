"""How much of a surface is flakes and needles: solid that is thinner than the lattice can show.

Symbols: h lattice cell; thickness of a place: way from it to the other side of the solid, against its normal.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Mesh
from pipeline.visibility import Occluder

THIN_CELLS = 2.0  # of h: marching cubes shows no sheet of less than one, and holes in one of less than two
START = 0.05  # of h: rays start this far inside
POINTS = 20_000  # at most, spread evenly over the faces


def thin_share(mesh: Mesh, h: float) -> float:
    """Share of the area where the solid is thinner than THIN_CELLS."""
    faces = mesh.faces[:: -(-len(mesh.faces) // POINTS)]
    area = meshes.areas(mesh.vertices, faces)
    thin = thickness(mesh, faces, START * h) < THIN_CELLS * h
    return float(area[thin].sum() / max(float(area.sum()), 1e-30))


def thickness(mesh: Mesh, faces: meshes.Faces, lift: float) -> F64:
    """(N,) of the solid under the middles of some faces (N, 3); infinite where a ray leaves an open mesh."""
    inward = -meshes.unit(meshes.area_vectors(mesh.vertices, faces))
    start = mesh.vertices.astype(np.float64)[faces].mean(1) + lift * inward
    return Occluder(mesh).distances(start, inward) + lift
