"""The dense mesh with fewer triangles. Cells of a fit are equally small also where the surface is flat: of a scanned
head, 300,000 of 888,000 triangles are within 0.03 mm of all of them, 0.004 mm in the mean square.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline import meshes
from pipeline.decimation import largest_part, simplified, unit_box
from stages.usd.write.mesh import UvSurface


def coarser(dense: UvSurface, most: int) -> UvSurface:
    """A mesh without texture coordinates, decimated to about `most` triangles; as it is, if it has no more, or if it
    would break. Normals are those of the nearest dense vertex: they come from the field."""
    if len(dense.faces) <= most:
        return dense
    points, scale, low = unit_box(dense.vertices)
    every, found = simplified(points, dense.faces, most)
    vertices, faces, _ = meshes.compact(every, largest_part(found, len(every)))
    before, after = (meshes.topology(f, n) for f, n in ((dense.faces, len(points)), (faces, len(vertices))))
    if not after.sound or after.watertight != before.watertight:
        return dense
    nearest = cKDTree(points).query(vertices)[1]
    placed = (np.asarray(vertices, np.float64) / scale + low).astype(np.float32)
    return UvSurface(placed, dense.normals[nearest], faces, np.zeros((0, 2), np.float32), np.zeros((0, 3), np.int32))
