"""Repairs a mesh that marching cubes left open or non-manifold.

It is called only for a mesh that fails the check; a smooth field does not produce one. Without pymeshlab the stage
still works, and such a mesh is not repaired.
"""

from __future__ import annotations

from typing import Any

from pipeline.errors import StageError
from pipeline.meshes import F64, Faces, Topology
from pipeline.meshlab import filtered


def repaired(vertices: F64, faces: Faces, found: Topology) -> tuple[F64, Faces]:
    """A closed manifold near the given mesh. Raises StageError if pymeshlab is missing or can't repair it."""

    def refused(reason: str) -> StageError:
        return StageError(
            "the surface is not closed and can't be repaired",
            where="surface",
            value=f"{found}; {reason}",
            limit="a manifold mesh",
            remedy="change surface.resolution a little, fit longer, or install pymeshlab if it is missing",
        )

    return filtered(vertices, faces, _close, refused)


def _close(library: Any, work: Any) -> None:
    work.meshing_remove_duplicate_faces()
    work.meshing_repair_non_manifold_edges(method="Remove Faces")
    work.meshing_repair_non_manifold_vertices(vertdispratio=0.0)
    work.meshing_close_holes(maxholesize=1000, newfaceselected=False)
    work.meshing_re_orient_faces_coherently()
