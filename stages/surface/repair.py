"""Closing a mesh that marching cubes left open or pinched, by pymeshlab (GPL-3; used here and in stages.uv.remesh).

It is called only for a mesh that fails the check, which a smooth field does not produce. Without pymeshlab installed
the stage still works, and such a mesh is refused.
"""

from __future__ import annotations

import numpy as np

from pipeline.errors import StageError
from pipeline.meshes import F64, Faces, Topology


def repaired(vertices: F64, faces: Faces, found: Topology) -> tuple[F64, Faces]:
    """A closed manifold mesh near the given one. Raises StageError where pymeshlab is missing or can't do it."""
    try:
        import pymeshlab
    except ImportError as e:
        raise StageError(
            "the surface is not closed and can't be repaired",
            where="surface",
            value=found,
            limit="a manifold mesh",
            remedy="change surface.resolution a little, or install pymeshlab (GPL-3)",
        ) from e
    try:
        work = pymeshlab.MeshSet(verbose=False)
        work.add_mesh(pymeshlab.Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32)))
        work.meshing_remove_duplicate_faces()
        work.meshing_repair_non_manifold_edges(method="Remove Faces")
        work.meshing_repair_non_manifold_vertices(vertdispratio=0.0)
        work.meshing_close_holes(maxholesize=1000, newfaceselected=False)
        work.meshing_re_orient_faces_coherently()
        mesh = work.current_mesh()
    except pymeshlab.PyMeshLabException as e:
        raise StageError(
            "the surface can't be repaired",
            where="surface",
            value=f"{found}; {e}",
            limit="a manifold mesh",
            remedy="change surface.resolution a little, or fit for longer",
        ) from e
    return np.asarray(mesh.vertex_matrix(), np.float64), np.asarray(mesh.face_matrix(), np.int32)
