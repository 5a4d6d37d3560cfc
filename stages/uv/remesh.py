"""Triangles of one size and shape: isotropic remeshing (pymeshlab, GPL-3; Botsch and Kobbelt 2004).

For sculpting, subdivision and pairing to quads: every edge is about as long as the others and most vertices have six
neighbours, which decimation does not give. It spends as many triangles on a flat forehead as on an eyelid, and so lies
further from the dense mesh at the same number; decimation is the default for that.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline import meshes
from pipeline.errors import StageError
from pipeline.meshes import F64, Faces, Mesh
from stages.uv.decimate import normals_from

ITERATIONS = 10  # of splits, collapses, flips, smoothing and projection
PASSES = 3  # with the edge's length mended after each
NEARLY = 0.03  # of the wished number of triangles
CREASE = 60.0  # degrees between two faces from which their edge is kept: the cut of the neck, no wrinkle


def remeshed(dense: Mesh, target: int) -> Mesh:
    """A manifold of about `target` even triangles on the dense mesh, with its normals; closed if the dense mesh is.

    Raises:
        StageError: pymeshlab is missing, or what it makes is no manifold.
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
        raise StageError(
            "the mesh can't be remeshed evenly",
            where="uv.remesh",
            value=found,
            limit="a manifold, closed if the dense mesh is",
            remedy="choose more target_faces, or uv.remesh=adaptive",
        )
    v = best[0].astype(np.float32)
    return Mesh(v, normals_from(dense, v, best[1]), best[1])


def _even(points: F64, faces: Faces, edge: float) -> tuple[F64, Faces]:
    try:
        import pymeshlab
    except ImportError as e:
        raise StageError(
            "even triangles need pymeshlab",
            where="uv.remesh",
            value="not installed",
            limit="pymeshlab (GPL-3)",
            remedy="install pymeshlab, or choose uv.remesh=adaptive",
        ) from e
    work = pymeshlab.MeshSet(verbose=False)
    work.add_mesh(pymeshlab.Mesh(points, np.asarray(faces, np.int32)))
    work.meshing_isotropic_explicit_remeshing(
        iterations=ITERATIONS,
        targetlen=pymeshlab.PureValue(edge),
        featuredeg=CREASE,
        checksurfdist=False,
    )
    mesh = work.current_mesh()
    v, f, _ = meshes.compact(np.asarray(mesh.vertex_matrix(), np.float64), np.asarray(mesh.face_matrix(), np.int32))
    return np.asarray(v, np.float64), f
