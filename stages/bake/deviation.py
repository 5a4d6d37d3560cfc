"""Distance of a mesh from the zero set of the field.

    |d(x)| / |grad d(x)|    first-order distance of x from the zero set

at four points of every triangle, weighted by area. The cap, where the field's box cuts the solid, is left out.
"""

from __future__ import annotations

import numpy as np

from pipeline import meshes
from pipeline.fields.protocol import Field
from pipeline.meshes import F32, Faces, Mesh

INSIDE = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]], np.float64)
BLOCK = 65_536  # faces at once: 100 MB
WALL_CELLS = 1.5  # cells of the field: points nearer to the box belong to the cap


def zero_set_rms(field: Field, mesh: Mesh) -> float:
    """Root mean square distance (m); 0 for a mesh that is only cap."""
    blocks = range(0, len(mesh.faces), BLOCK)
    square, area = np.sum([_sums(field, mesh.vertices, mesh.faces[i : i + BLOCK]) for i in blocks] or [(0.0, 0.0)], 0)
    return float(np.sqrt(square / area)) if area > 0 else 0.0


def _sums(field: Field, vertices: F32, faces: Faces) -> tuple[float, float]:
    """The squared distances at some faces, weighted by area, and the sum of the weights."""
    weights = INSIDE / INSIDE.sum(1, keepdims=True)
    points = np.einsum("sc,fcx->fsx", weights, vertices[faces].astype(np.float64)).reshape(-1, 3)
    area = np.repeat(meshes.areas(vertices, faces), len(INSIDE))
    low, high = (np.asarray(b, np.float64) for b in field.bounds)
    wall = np.minimum(points - low, high - points).min(1)
    use = np.flatnonzero((wall > WALL_CELLS * field.cell) & (area > 0))
    if not len(use):
        return 0.0, 0.0
    value, gradient = field.sdf_and_gradient(points[use].astype(np.float32))
    distance = value.astype(np.float64) / np.maximum(np.linalg.norm(gradient, axis=1), 0.1)
    return float((distance**2 * area[use]).sum()), float(area[use].sum())
