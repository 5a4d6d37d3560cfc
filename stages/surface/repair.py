"""Closing a mesh that marching cubes left open or pinched.

It is called only for a mesh that fails the check, which a smooth field does not produce. Without pymeshlab installed
the stage still works, and such a mesh is refused.
"""

from __future__ import annotations

from typing import Any

from pipeline.errors import StageError
from pipeline.meshes import F64, Faces, Topology
from pipeline.meshlab import filtered


def repaired(vertices: F64, faces: Faces, found: Topology) -> tuple[F64, Faces]:
    """A closed manifold mesh near the given one. Raises StageError where pymeshlab is missing or can't do it."""

    def refused(reason: str) -> StageError:
        return StageError(
            "the surface is not closed and can't be repaired",
            where="surface",
            value=f"{found}; {reason}",
            limit="a manifold mesh",
            remedy="change surface.resolution a little, fit for longer, or install pymeshlab where it is missing",
        )

    return filtered(vertices, faces, _close, refused)


def _close(library: Any, work: Any) -> None:
    work.meshing_remove_duplicate_faces()
    work.meshing_repair_non_manifold_edges(method="Remove Faces")
    work.meshing_repair_non_manifold_vertices(vertdispratio=0.0)
    work.meshing_close_holes(maxholesize=1000, newfaceselected=False)
    work.meshing_re_orient_faces_coherently()
