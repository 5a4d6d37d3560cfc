"""Even triangles: as many as asked for, alike, on the dense mesh, and through the whole way to charts."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline import meshes
from pipeline.errors import StageError
from pipeline.meshes import Mesh
from stages.surface.build import build as surface_build
from stages.surface.trim import cut
from stages.uv import decimate
from stages.uv.build import build
from stages.uv.config import Config
from stages.uv.remesh import remeshed
from tests.support.analytic_fields import AnalyticField, bumpy_head, sphere

pytest.importorskip("pymeshlab")


@pytest.fixture(scope="module")
def dense() -> Mesh:
    return surface_build(AnalyticField(bumpy_head(0.001, 60.0)), 80, lambda *_: None).mesh


def unevenness(mesh: Mesh) -> float:
    length = meshes.edge_lengths(mesh.vertices, mesh.faces)
    return float(length.std() / length.mean())


def regular(mesh: Mesh) -> float:
    return float((np.bincount(mesh.faces.ravel()) == 6).mean())


def test_edges_are_alike_and_vertices_have_six_neighbours(dense: Mesh) -> None:
    even, few = remeshed(dense, 5000), decimate.decimated(dense, 5000)
    assert abs(len(even.faces) - 5000) < 0.03 * 5000
    assert meshes.topology(even.faces, len(even.vertices)).manifold
    assert unevenness(even) < 0.2 < unevenness(few)
    assert regular(even) > 0.6 > regular(few)


@pytest.mark.slow
def test_it_lies_on_the_surface_and_keeps_the_cut_of_the_neck(dense: Mesh) -> None:
    even = remeshed(dense, 5000)
    edge = meshes.edge_lengths(even.vertices, even.faces).mean()
    away, nearest = cKDTree(dense.vertices).query(even.vertices)
    assert away.max() < edge
    assert decimate.deviation(dense, even).rms < 0.1 * edge
    assert even.vertices[:, 1].min() == pytest.approx(dense.vertices[:, 1].min(), abs=1e-4)
    assert ((even.normals * dense.normals[nearest]).sum(1) > 0.4).mean() > 0.99
    assert np.allclose(np.linalg.norm(even.normals, axis=1), 1, atol=1e-5)


def test_a_ball_keeps_its_radius() -> None:
    ball = surface_build(AnalyticField(sphere(0.1)), 64, lambda *_: None).mesh
    even = remeshed(ball, 3000)
    assert np.linalg.norm(even.vertices, axis=1) == pytest.approx(0.1, rel=2e-3)


def test_an_open_mesh_keeps_its_border(dense: Mesh) -> None:
    x = dense.vertices.astype(np.float64)
    ends, share, faces = cut(dense.faces, 0.5 + 20 * (x[:, 1] + 0.05))
    border = x[ends[:, 0]] + share[:, None] * (x[ends[:, 1]] - x[ends[:, 0]])
    vertices, faces, _ = meshes.compact(np.concatenate([x, border]), faces)
    whole = Mesh(vertices.astype(np.float32), meshes.vertex_normals(vertices, faces), faces)
    even = remeshed(whole, 4000)
    found = meshes.topology(even.faces, len(even.vertices))
    assert found.sound and found.boundary_edges > 20 and found.components == 1
    assert even.vertices[:, 1].min() == pytest.approx(-0.05, abs=1e-3)


def test_few_triangles_are_kept_and_twice_is_the_same(dense: Mesh) -> None:
    assert remeshed(dense, len(dense.faces)) is dense
    one, two = remeshed(dense, 3000), remeshed(dense, 3000)
    assert np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)


@pytest.mark.slow
def test_charts_on_even_triangles(dense: Mesh) -> None:
    made = build(
        dense,
        Config(target_faces=5000, proxy_faces=1000, texture_size=512, padding=4, remesh="uniform"),
        lambda *_: None,
    )
    assert unevenness(made.mesh) < 0.2 and made.quality.overlap == 0 and made.warnings == ()
    assert len(made.proxy.faces) <= 1200


def test_without_pymeshlab_that_is_said(dense: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)  # as if it were not installed
    with pytest.raises(StageError, match=r"uv\.remesh"):
        remeshed(dense, 3000)
