"""The dense mesh with fewer triangles."""

from __future__ import annotations

import numpy as np
import trimesh

from pipeline import meshes
from pipeline.decimation import largest_part
from stages.usd.write.dense import coarser
from stages.usd.write.mesh import UvSurface

RADIUS = 0.1


def ball(subdivisions: int = 5) -> UvSurface:
    made = trimesh.creation.icosphere(subdivisions, RADIUS)
    points = made.vertices.astype(np.float32)
    none = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.int32)
    return UvSurface(points, (points / RADIUS).astype(np.float32), made.faces.astype(np.int32), *none)


def test_it_has_fewer_triangles_of_the_same_surface() -> None:
    full = ball()
    made = coarser(full, 5_000)
    assert len(full.faces) == 20_480 and 4_500 < len(made.faces) <= 5_000
    assert meshes.topology(made.faces, len(made.vertices)).manifold
    middles = made.vertices[made.faces].mean(1)
    assert np.abs(np.linalg.norm(middles, axis=1) / RADIUS - 1).max() < 3e-3
    away = made.vertices / np.linalg.norm(made.vertices, axis=1, keepdims=True)
    assert (made.normals * away).sum(1).min() > 0.99


def test_a_bubble_on_an_edge_is_left_out() -> None:
    """Four faces meet at the edge of a tetrahedron that hangs on the ball."""
    full = ball(2)
    a, b = full.faces[7, :2]
    c, d = len(full.vertices), len(full.vertices) + 1
    bubble = np.array([[a, b, c], [b, a, d], [a, c, d], [b, d, c]], np.int32)
    faces = np.concatenate([bubble, full.faces])
    assert meshes.topology(faces, d + 1).crowded_edges == 1
    assert np.array_equal(largest_part(faces, d + 1), full.faces)


def test_a_small_mesh_and_one_that_would_break_stay_as_they_are(monkeypatch) -> None:
    full = ball(3)
    assert coarser(full, len(full.faces)) is full
    monkeypatch.setattr("fast_simplification.simplify", lambda p, f, target_count, agg: (p, f[: len(f) // 2]))
    assert coarser(full, 600) is full
