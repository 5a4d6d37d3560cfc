"""The dense mesh with fewer triangles. Cells of a fit are equally small also where the surface is flat: of a scanned
head, 300,000 of 888,000 triangles are within 0.03 mm of all of them, 0.004 mm in the mean square.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline import meshes
from pipeline.meshes import Faces
from stages.usd.write.mesh import UvSurface

UNIT = 1000.0  # the longest side of the box during decimation: its thresholds are absolute


def without_bubbles(faces: Faces) -> Faces:
    """The largest part of the faces (F, 3), parts being joined where two faces share an edge. Decimation pinches off
    bubbles of some triangles, which hang on an edge of four."""
    edges, index = np.unique(np.sort(meshes.edges(faces), 1), axis=0, return_inverse=True)
    order = np.argsort(index, kind="stable")
    start = np.searchsorted(index[order], np.flatnonzero(np.bincount(index, minlength=len(edges)) == 2))
    one, two = (order[start + k] % len(faces) for k in (0, 1))
    joined = coo_array((np.ones(len(one), np.bool_), (one, two)), shape=(len(faces), len(faces)))
    part = connected_components(joined, directed=False)[1]
    return np.asarray(faces[part == np.bincount(part).argmax()])


def coarser(dense: UvSurface, most: int) -> UvSurface:
    """A mesh without texture coordinates, decimated to about `most` triangles; as it is, if it has no more, or if it
    would break. Normals are those of the nearest dense vertex: they come from the field."""
    if len(dense.faces) <= most:
        return dense
    import fast_simplification

    low, high = dense.vertices.min(0).astype(np.float64), dense.vertices.max(0).astype(np.float64)
    scale = UNIT / max(float((high - low).max()), 1e-30)
    points = (dense.vertices.astype(np.float64) - low) * scale
    vertices, found = fast_simplification.simplify(points, dense.faces, target_count=most)
    vertices, faces, _ = meshes.compact(np.asarray(vertices, np.float64), without_bubbles(np.asarray(found, np.int32)))
    before, after = (meshes.topology(f, n) for f, n in ((dense.faces, len(points)), (faces, len(vertices))))
    if not after.sound or after.watertight != before.watertight:
        return dense
    nearest = cKDTree(points).query(vertices)[1]
    placed = (np.asarray(vertices, np.float64) / scale + low).astype(np.float32)
    return UvSurface(placed, dense.normals[nearest], faces, np.zeros((0, 2), np.float32), np.zeros((0, 3), np.int32))
