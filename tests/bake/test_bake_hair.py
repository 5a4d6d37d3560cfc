"""What the bake knows of hair that is a mesh of its own."""

from __future__ import annotations

import numpy as np
from support.ball_head import ball_scan

from pipeline.meshes import Mesh
from stages.bake.regions import unanimous
from stages.bake.stage import hair_of


def test_its_vertices_are_those_of_the_last_faces() -> None:
    a, b = ball_scan(0.1, 6), ball_scan(0.03, 4)
    mesh = Mesh(
        np.concatenate([a.vertices, b.vertices]), np.concatenate([a.normals, b.normals]),
        np.concatenate([a.faces, b.faces + len(a.vertices)]),
    )  # fmt: skip
    found = hair_of(mesh, len(b.faces))
    assert found is not None and (found == (np.arange(len(mesh.vertices)) >= len(a.vertices))).all()
    assert hair_of(mesh, 0) is None


def test_its_label_is_the_same_everywhere() -> None:
    votes = unanimous(4)
    assert (votes.winners(np.array([0, 77, 64 * 64 - 1]), 64) == 4).all()
