"""Patches of a mesh: they keep its area, stay connected, and do not join sheets that do not touch."""

from __future__ import annotations

import numpy as np
from support.ball_head import ball_scan

from pipeline.meshes import Mesh, areas
from pipeline.patches import patches_of

RADIUS = 0.1


def sheet(z: float, up: bool = True, n: int = 21, side: float = 0.02) -> Mesh:
    """A square of triangles around the origin at height z."""
    g = np.linspace(-side / 2, side / 2, n)
    x, y = np.meshgrid(g, g, indexing="ij")
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    normal = np.array([0, 0, 1.0 if up else -1.0], np.float32)
    points = np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], 1).astype(np.float32)
    return Mesh(points, np.tile(normal, (n * n, 1)), faces if up else faces[:, ::-1].copy())


def test_a_ball_in_patches() -> None:
    mesh = ball_scan(RADIUS)
    patches = patches_of(mesh, 0.012)
    assert np.isclose(patches.area.sum(), areas(mesh.vertices, mesh.faces).sum()) and patches.area.min() > 0
    assert 300 < len(patches.where) < 2500
    outward = patches.where / np.linalg.norm(patches.where, axis=1, keepdims=True)
    assert ((outward * patches.normals).sum(1) > 0.99).all()
    for patch in (0, len(patches.where) // 2):
        rows = np.flatnonzero(patches.of_vertex == patch)
        np.testing.assert_allclose(patches.where[patch], mesh.vertices[rows].astype(float).mean(0), atol=1e-7)
        assert np.ptp(mesh.vertices[rows], axis=0).max() <= 0.012
    assert (patches.a < patches.b).all()
    assert len(np.unique(np.stack([patches.a, patches.b], 1), axis=0)) == len(patches.a)


def test_each_patch_has_a_third_of_the_area_of_its_vertices_triangles() -> None:
    """Triangle by triangle, on a ball whose upper half is three times as wide."""
    ball = ball_scan(RADIUS)
    wide = np.where(ball.vertices[:, 1:2] > 0, np.float32([3, 1, 1]), np.float32([1, 1, 1]))
    mesh = Mesh(ball.vertices * wide, ball.normals, ball.faces)
    patches = patches_of(mesh, 0.012)
    wanted = np.zeros(len(patches.where))
    for face, area in zip(mesh.faces, areas(mesh.vertices, mesh.faces), strict=True):
        for corner in face:
            wanted[patches.of_vertex[corner]] += area / 3
    np.testing.assert_allclose(patches.area, wanted, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(patches.normals, axis=1), 1, rtol=1e-6)


def test_two_sheets_in_one_cell_are_two_patches() -> None:
    a, b = sheet(0.0), sheet(0.001, up=False)
    both = Mesh(
        np.concatenate([a.vertices, b.vertices]), np.concatenate([a.normals, b.normals]),
        np.concatenate([a.faces, b.faces + len(a.vertices)]),
    )  # fmt: skip
    patches = patches_of(both, 0.05)
    assert len(patches.where) == 2 and not len(patches.a)
    assert sorted(np.round(patches.normals[:, 2])) == [-1, 1]


def test_neighbours_of_some() -> None:
    patches = patches_of(sheet(0.0), 0.005)
    left = patches.where[:, 0] < 0
    rim = patches.beside(left)
    assert rim.any() and not (rim & left).any()
    touching = {int(q) for p, q in zip(patches.a, patches.b, strict=True) if left[p] and not left[q]}
    touching |= {int(p) for p, q in zip(patches.a, patches.b, strict=True) if left[q] and not left[p]}
    assert set(np.flatnonzero(rim)) == touching
    assert not patches.beside(np.ones(len(left), bool)).any() and not patches.beside(np.zeros(len(left), bool)).any()
