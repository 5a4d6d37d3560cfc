"""The only module that uses pymeshlab (GPL-3): it runs its filters on a mesh. All other modules work without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline.errors import StageError
from pipeline.meshes import F64, Faces

Filters = Callable[[Any, Any], None]  # arguments: the library, and the MeshSet to change


def filtered(vertices: F64, faces: Faces, filters: Filters, refused: Callable[[str], StageError]) -> tuple[F64, Faces]:
    """Vertices (V', 3) and faces (F', 3) after the filters. refused: returns the error to raise, given the reason: the
    library is missing, or a filter failed."""
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
