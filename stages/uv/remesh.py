"""Isotropic remeshing: triangles of one size and shape (by pymeshlab; Botsch and Kobbelt 2004).

For sculpting, subdivision and conversion to quads: all edges have about the same length and most vertices have six
neighbours. It uses as many triangles on a flat forehead as on an eyelid, so that at the same number of triangles it is
further from the dense mesh than decimation, which is the default.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pipeline import meshes
from pipeline.errors import StageError
from pipeline.meshes import F64, Faces, Mesh
from pipeline.meshlab import filtered
from stages.uv.decimate import normals_from

ITERATIONS = 10  # of splits, collapses, flips, smoothing and projection
PASSES = 3  # the edge length is corrected after each
NEARLY = 0.03  # accepted deviation from the target number of triangles
CREASE = 60.0  # degrees between two faces from which their edge is kept: the cut of the neck, not wrinkles


def remeshed(dense: Mesh, target: int) -> Mesh:
    """A manifold of about `target` equal triangles on the dense mesh, with its normals; closed if the dense mesh is.

    Raises:
        StageError: pymeshlab is missing, or its result is not a manifold.
    """
    if len(dense.faces) <= target:
        return dense
    closed = meshes.topology(dense.faces, len(dense.vertices)).watertight
    points = dense.vertices.astype(np.float64)
    area = float(meshes.areas(points, dense.faces).sum())
    edge = math.sqrt(area / target * 4 / math.sqrt(3))  # of an equilateral triangle with that share of the area
    best: tuple[F64, Faces] | None = None
    for _ in range(PASSES):
        vertices, faces = _even(points, dense.faces, edge)
        found = meshes.topology(faces, len(vertices))
        if found.manifold if closed else found.sound:
            off = abs(len(faces) / target - 1)
            if best is None or off < abs(len(best[1]) / target - 1):
                best = vertices, faces
            if off < NEARLY:
                break
        edge *= math.sqrt(len(faces) / target)
    if best is None:
        raise _refused(str(found))
    v = best[0].astype(np.float32)
    return Mesh(v, normals_from(dense, v, best[1]), best[1])


def _even(points: F64, faces: Faces, edge: float) -> tuple[F64, Faces]:
    def remesh(library: Any, work: Any) -> None:
        work.meshing_isotropic_explicit_remeshing(
            iterations=ITERATIONS, targetlen=library.PureValue(edge), featuredeg=CREASE, checksurfdist=False
        )

    v, f, _ = meshes.compact(*filtered(points, faces, remesh, _refused))
    return np.asarray(v, np.float64), f


def _refused(reason: str) -> StageError:
    return StageError(
        "isotropic remeshing failed",
        where="uv.remesh",
        value=reason,
        limit="a manifold, closed if the dense mesh is; pymeshlab installed",
        remedy="raise uv.target_faces, or set uv.remesh=adaptive",
    )
