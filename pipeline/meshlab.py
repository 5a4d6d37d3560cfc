"""The one place that uses pymeshlab (GPL-3): its filters on a mesh of ours. All else works without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline.errors import StageError
from pipeline.meshes import F64, Faces

Filters = Callable[[Any, Any], None]  # of the library and the MeshSet that is worked on


def filtered(vertices: F64, faces: Faces, filters: Filters, refused: Callable[[str], StageError]) -> tuple[F64, Faces]:
    """Vertices (V', 3) and faces (F', 3) after the filters. refused: the error to raise, from what went wrong: the
    library is missing, or a filter can't take the mesh."""
    try:
        import pymeshlab
    except ImportError as e:
        raise refused("pymeshlab (GPL-3) is not installed") from e
    try:
        work = pymeshlab.MeshSet(verbose=False)
        work.add_mesh(pymeshlab.Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32)))
        filters(pymeshlab, work)
        mesh = work.current_mesh()
    except pymeshlab.PyMeshLabException as e:
        raise refused(str(e)) from e
    return np.asarray(mesh.vertex_matrix(), np.float64), np.asarray(mesh.face_matrix(), np.int32)
