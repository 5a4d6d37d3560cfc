"""Meshes as a bad fit leaves them: closed manifolds, rough, with needles, flakes and faces without area."""

from __future__ import annotations

import numpy as np
import trimesh

from pipeline import meshes
from pipeline.meshes import Mesh

RADIUS = 0.1


def shredded(subdivisions: int, noise: float, seed: int = 0) -> Mesh:
    """A ball whose vertices are moved by `noise` of an edge at random; one in 40 is drawn out to a needle."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    rng = np.random.default_rng(seed)
    vertices = np.asarray(ball.vertices) + noise * ball.edges_unique_length.mean() * rng.normal(
        size=(ball.vertices.shape)
    )
    needles = rng.choice(len(vertices), len(vertices) // 40 if noise else 0, replace=False)
    vertices[needles] *= 1 + rng.uniform(0.05, 0.4, (len(needles), 1))
    return made(vertices, np.asarray(ball.faces, np.int32))


def with_worthless_faces(mesh: Mesh) -> Mesh:
    """Edges whose ends lie at one place, slivers, and a patch folded to a flake of no thickness."""
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    picked = faces[:: len(faces) // 12]
    for a, b, _ in picked.tolist():  # duplicate places: two faces without area beside each such edge
        vertices[b] = vertices[a]
    for a, b, c in faces[5 :: len(faces) // 10].tolist():  # a corner next to the middle of the other two
        vertices[c] = 0.5 * (vertices[a] + vertices[b]) + 1e-7
    tip = int(faces[len(faces) // 2, 0])
    around = np.unique(faces[(faces == tip).any(1)])
    vertices[around] = vertices[tip] + (vertices[around] - vertices[tip]) * [1, 1, 1e-6]
    return made(vertices, faces)


def made(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """With normals of its own."""
    return Mesh(vertices.astype(np.float32), meshes.vertex_normals(vertices, faces), faces)
